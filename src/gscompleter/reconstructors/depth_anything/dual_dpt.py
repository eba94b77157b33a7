"""The head of the any-view networks: depth, and the ray of each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.reconstructors.depth_anything.dpt import (
    HIDDEN,
    Dpt,
    ImageScratch,
    with_position,
)
from gscompleter.reconstructors.feed_forward.dpt import Coarsest, Fusion, fused
from gscompleter.reconstructors.feed_forward.resampling import resized

LEVELS = 4
"""Levels of the pyramid. Those of rays end in layers of their own, of which the last count."""
NORM = 2
"""Place of the normalisation among the last layers of rays."""

Pyramid = Sequence[Float[Tensor, "n _ _ _"]]


class ChannelNorm(nn.LayerNorm):
    """Normalises the channels of each pixel."""

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return super().forward(x.movedim(1, -1)).movedim(-1, 1)


def five_convolutions(features: int) -> nn.Sequential:
    """Convolutions in a row, with nothing between."""
    widths = pairwise([features, features // 2] * 3)
    return nn.Sequential(*(nn.Conv2d(a, b, 3, 1, 1) for a, b in widths))


class RayLayers(nn.Sequential):
    """The last layers of a level. The authors' four levels share one normalisation, so that files
    hold it once, at the first."""

    def __init__(self, channels: int, level: int) -> None:
        first, last = nn.Conv2d(channels, HIDDEN, 3, 1, 1), nn.Conv2d(HIDDEN, 7, 1)
        norm = nn.Identity() if level else ChannelNorm(HIDDEN)
        super().__init__(first, nn.Identity(), norm, nn.Identity(), nn.ReLU(), last)

    def through(self, x: Float[Tensor, "n c h w"], norm: nn.Module) -> Float[Tensor, "n 7 h w"]:
        """`x` through these layers with the normalisation of another level."""
        first, _, _, _, relu, last = self
        return last(relu(norm(first(x))))


class DualScratch(ImageScratch):
    """Fuses the levels twice, for depth and for rays."""

    def __init__(self, widths: Sequence[int], features: int) -> None:
        super().__init__(widths, features, out=2)
        self.refinenet1_aux = Fusion(features)
        self.refinenet2_aux = Fusion(features)
        self.refinenet3_aux = Fusion(features)
        self.refinenet4_aux = Coarsest(features)
        self.output_conv1_aux = nn.ModuleList(five_convolutions(features) for _ in range(LEVELS))
        last = [RayLayers(features // 2, level) for level in range(LEVELS)]
        self.output_conv2_aux = nn.ModuleList(last)

    def rays(self, pyramid: Pyramid, aspect: float) -> Float[Tensor, "n 7 h w"]:
        """What the second fusion ends in, through the layers of the last level.

        Args:
            pyramid: The four maps, finest first.
            aspect: Width of the image over its height.
        """
        fusions = (self.refinenet1_aux, self.refinenet2_aux, self.refinenet3_aux)
        x = fused(self.levels(pyramid), *fusions, self.refinenet4_aux)
        x = with_position(self.output_conv1_aux[-1](x), aspect)
        shared, last = self.output_conv2_aux[0], self.output_conv2_aux[-1]
        assert isinstance(shared, RayLayers)
        assert isinstance(last, RayLayers)
        return last.through(x, shared[NORM])


class DualDpt(Dpt):
    """Depth at the resolution of the image, rays at four sevenths of it."""

    scratch: DualScratch

    def __init__(self, channels: int, widths: Sequence[int], features: int) -> None:
        super().__init__(channels, widths, coded=True)
        self.norm = nn.LayerNorm(channels)
        self.scratch = DualScratch(widths, features)

    def normed(self, patches: Float[Tensor, "b v p c"]) -> Float[Tensor, "b v p c"]:
        return self.norm(patches)

    def depth(
        self, pyramid: Pyramid, size: tuple[int, int]
    ) -> tuple[Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
        """Depth in a unit of the network's own, and how sure it is of it, from 1 upwards."""
        x = resized(self.scratch.output_conv1(self.scratch(pyramid)), size)
        raw = self.scratch.output_conv2(with_position(x, size[1] / size[0]))
        return raw[:, 0].exp(), 1 + raw[:, 1].exp()

    def rays(
        self, pyramid: Pyramid, size: tuple[int, int]
    ) -> tuple[Float[Tensor, "n p q 6"], Float[Tensor, "n p q"]]:
        """Direction and camera centre of each ray, and how sure the network is of it.

        They tell the cameras where poses are not known. A reconstruction, whose cameras are, needs
        none of them.
        """
        raw = self.scratch.rays(pyramid, size[1] / size[0])
        return raw[:, :6].movedim(1, -1), 1 + raw[:, 6].exp()
