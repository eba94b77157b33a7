"""The metric network: the depth of one view in metres, and where the sky is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from gscompleter.reconstructors.depth_anything.config import MetricDepthConfig
from gscompleter.reconstructors.depth_anything.dpt import Dpt, ImageScratch, last_convolutions
from gscompleter.reconstructors.depth_anything.vit import AnyViewVit
from gscompleter.reconstructors.feed_forward.cameras import full_precision
from gscompleter.reconstructors.feed_forward.dino import PATCH
from gscompleter.reconstructors.feed_forward.resampling import resized

FOCAL = 300.0
"""Focal length, in pixels, of the camera whose metres the network tells."""
MAX_SKY = 0.3
"""What the network says of the sky, under which a pixel is none."""
MIN_PIXELS = 10
"""There is a sky, and something before it, where more pixels than this show each."""
FAR_QUANTILE = 0.99
"""Share of what is no sky that lies nearer than the sky is put."""


@dataclass(frozen=True)
class MetricDepth:
    """What the network makes of views."""

    depth: Float[Tensor, "b v h w"]
    """z-depth in metres, for a focal length of 300 pixels; not known of the sky."""
    sky: Float[Tensor, "b v h w"]
    """How much the pixel looks like the sky, from 0 upwards."""

    @property
    def solid(self) -> Bool[Tensor, "b v h w"]:
        """Where there is no sky."""
        return self.sky < MAX_SKY

    def in_metres(self, K: Float[Tensor, "b v 3 3"]) -> Float[Tensor, "b v h w"]:
        """z-depth in metres as cameras of these intrinsics, in pixels, see it."""
        focal = (K[..., 0, 0] + K[..., 1, 1]) / 2
        return self.depth * (focal / FOCAL)[..., None, None]


class SkyScratch(ImageScratch):
    """Ends in depth and in sky."""

    def __init__(self, widths: Sequence[int], features: int) -> None:
        super().__init__(widths, features, out=1)
        self.sky_output_conv2 = last_convolutions(features // 2, 1)


class MetricDpt(Dpt):
    """The head."""

    scratch: SkyScratch

    def __init__(self, channels: int, widths: Sequence[int], features: int) -> None:
        super().__init__(channels, widths, coded=False)
        self.scratch = SkyScratch(widths, features)


class MetricDepthAnything(nn.Module):
    """The whole network: 334 M parameters. Every view is seen alone."""

    def __init__(self, config: MetricDepthConfig = MetricDepthConfig()) -> None:
        super().__init__()
        self.config = config
        self.backbone = nn.ModuleDict({"pretrained": AnyViewVit(config.vit)})
        self.head = MetricDpt(config.vit.described, config.widths, config.features)

    def forward(self, images: Float[Tensor, "b v 3 h w"]) -> MetricDepth:
        """Depth and sky of normalised images, their sides multiples of 14."""
        size = (images.shape[3], images.shape[4])
        tokens = [tokens.float() for tokens in self.backbone["pretrained"](images)]
        with full_precision(images):
            scratch = self.head.scratch
            pyramid = self.head.pyramid(tokens, size[0] // PATCH, size[1] // PATCH)
            x = resized(scratch.output_conv1(scratch(pyramid)), size)
            depth = scratch.output_conv2(x)[:, 0].exp()
            sky = scratch.sky_output_conv2(x)[:, 0].relu()
        views = images.shape[:2]
        return MetricDepth(depth.unflatten(0, views), sky.unflatten(0, views))


def with_far_sky(
    depth: Float[Tensor, "b v h w"], solid: Bool[Tensor, "b v h w"], farthest: float = torch.inf
) -> Float[Tensor, "b v h w"]:
    """Depth whose sky lies behind nearly all that is solid, as the authors put it, and at most as
    far as `farthest`. Where nearly all or nearly nothing is sky, it is left as it is."""
    if min(int(solid.sum()), int((~solid).sum())) <= MIN_PIXELS:
        return depth
    far = quantile(depth[solid], FAR_QUANTILE).clamp_max(farthest)
    return torch.where(solid, depth, far)


def quantile(values: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """Between the two values that lie next to it (`torch.quantile` takes no more than 16 million
    values)."""
    place = share * (len(values) - 1)
    ordered = values.sort().values
    below, above = ordered[int(place)], ordered[min(int(place) + 1, len(values) - 1)]
    return below + (above - below) * (place - int(place))
