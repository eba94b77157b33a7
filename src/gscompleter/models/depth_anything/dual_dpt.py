"""The head of the any-view networks for depth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.depth_anything.dpt import HIDDEN, Dpt, ImageScratch, add_position_encoding
from gscompleter.models.feed_forward.dpt import Coarsest, Fusion
from gscompleter.models.feed_forward.resampling import resize_bilinear

NUM_LEVELS = 4
"""Number of pyramid levels."""

Pyramid = Sequence[Float[Tensor, "n _ _ _"]]


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of each pixel."""

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Normalise the channels."""
        return super().forward(x.movedim(1, -1)).movedim(-1, 1)


def create_five_convolutions(features: int) -> nn.Sequential:
    """Create five convolutions in a row, to half of the channels and back in turn."""
    widths = pairwise([features, features // 2] * 3)
    return nn.Sequential(*(nn.Conv2d(before, after, 3, 1, 1) for before, after in widths))


class RayLayers(nn.Sequential):
    """Output layers of a level: six numbers of the ray of each pixel, and their confidence.

    The four levels share one norm, which files store at the first. As these layers never run, an
    identity stands for it at the others, and for the authors' permutations around it.
    """

    def __init__(self, channels: int, level: int) -> None:
        first = nn.Conv2d(channels, HIDDEN, 3, 1, 1)
        last = nn.Conv2d(HIDDEN, 7, 1)
        norm = nn.Identity() if level else ChannelNorm(HIDDEN)
        super().__init__(first, nn.Identity(), norm, nn.Identity(), nn.ReLU(), last)


class DualScratch(ImageScratch):
    """Two fusions of the levels: for depth, and for rays, which given cameras make needless.

    The layers for rays, with `aux` in their names, are there because files of weights hold them.
    """

    def __init__(self, widths: Sequence[int], features: int) -> None:
        super().__init__(widths, features, out=2)
        self.refinenet1_aux = Fusion(features)
        self.refinenet2_aux = Fusion(features)
        self.refinenet3_aux = Fusion(features)
        self.refinenet4_aux = Coarsest(features)
        self.output_conv1_aux = nn.ModuleList(
            create_five_convolutions(features) for _ in range(NUM_LEVELS)
        )
        last = [RayLayers(features // 2, level) for level in range(NUM_LEVELS)]
        self.output_conv2_aux = nn.ModuleList(last)


class DualDpt(Dpt):
    """Head for depth at image resolution."""

    scratch: DualScratch

    def __init__(self, channels: int, widths: Sequence[int], features: int) -> None:
        super().__init__(channels, widths, has_positions=True)
        self.norm = nn.LayerNorm(channels)
        self.scratch = DualScratch(widths, features)

    def normalize_patches(self, patches: Float[Tensor, "b v p c"]) -> Float[Tensor, "b v p c"]:
        """Normalise the patches."""
        return self.norm(patches)

    def predict_depth(
        self, pyramid: Pyramid, size: tuple[int, int]
    ) -> tuple[Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
        """Predict depth up to scale, and its confidence from 1 upwards; `size` is height, width."""
        x = resize_bilinear(self.scratch.output_conv1(self.scratch(pyramid)), size)
        raw = self.scratch.output_conv2(add_position_encoding(x, size[1] / size[0]))
        # Positive depth, and a confidence above 1, as the authors trained them.
        return raw[:, 0].exp(), 1 + raw[:, 1].exp()
