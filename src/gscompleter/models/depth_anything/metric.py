"""The metric network: depth in metres and sky of single views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from gscompleter.models.depth_anything.config import MetricDepthConfig
from gscompleter.models.depth_anything.dpt import Dpt, ImageScratch, create_output_layers
from gscompleter.models.depth_anything.vit import AnyViewVit
from gscompleter.models.feed_forward.cameras import disable_autocast
from gscompleter.models.feed_forward.dino import PATCH
from gscompleter.models.feed_forward.resampling import resize_bilinear

METRIC_FOCAL = 300.0
"""Focal length in pixels for which the network predicts metres."""
MIN_SKY = 0.3
"""Smallest sky output of a pixel that counts as sky."""
MIN_PIXELS = 10
"""Pixels beyond which a sky, or a foreground, is more than chance."""
FAR_QUANTILE = 0.99
"""Quantile of the foreground depth at which the sky is placed."""


@dataclass(frozen=True)
class MetricDepth:
    """Depth and sky of a batch of views."""

    depth: Float[Tensor, "b v h w"]
    """z-depth in metres at a focal length of 300 pixels; undefined in the sky."""
    sky: Float[Tensor, "b v h w"]
    """How much it looks like sky, from 0 upwards."""

    @property
    def solid_mask(self) -> Bool[Tensor, "b v h w"]:
        """True outside the sky."""
        return self.sky < MIN_SKY

    def convert_to_metres(self, K: Float[Tensor, "b v 3 3"]) -> Float[Tensor, "b v h w"]:
        """Compute z-depth in metres for intrinsics in pixels."""
        # Depth is proportional to the focal length: a longer lens shows the same image of what is
        # farther.
        focal = (K[..., 0, 0] + K[..., 1, 1]) / 2
        return self.depth * (focal / METRIC_FOCAL)[..., None, None]


class SkyScratch(ImageScratch):
    """Fusion with outputs for depth and sky."""

    def __init__(self, widths: Sequence[int], features: int) -> None:
        super().__init__(widths, features, out=1)
        self.sky_output_conv2 = create_output_layers(features // 2, 1)


class MetricDpt(Dpt):
    """Head for depth and sky."""

    scratch: SkyScratch

    def __init__(self, channels: int, widths: Sequence[int], features: int) -> None:
        super().__init__(channels, widths, has_positions=False)
        self.scratch = SkyScratch(widths, features)


class MetricDepthAnything(nn.Module):
    """The metric network: 334 M parameters, one view at a time."""

    def __init__(self, config: MetricDepthConfig = MetricDepthConfig()) -> None:
        super().__init__()
        self.config = config
        self.backbone = nn.ModuleDict({"pretrained": AnyViewVit(config.vit)})
        self.head = MetricDpt(config.vit.num_output_channels, config.widths, config.features)

    def forward(self, images: Float[Tensor, "b v 3 h w"]) -> MetricDepth:
        """Predict depth and sky of normalised images with sides divisible by 14."""
        views = images.shape[:2]
        size = (images.shape[3], images.shape[4])
        tokens = [tokens.float() for tokens in self.backbone["pretrained"](images)]
        with disable_autocast(images):
            scratch = self.head.scratch
            pyramid = self.head.compute_pyramid(tokens, size[0] // PATCH, size[1] // PATCH)
            x = resize_bilinear(scratch.output_conv1(scratch(pyramid)), size)
            # Two outputs of one fused map: log depth, and a sky score that is not negative.
            depth = scratch.output_conv2(x)[:, 0].exp()
            sky = scratch.sky_output_conv2(x)[:, 0].relu()
        return MetricDepth(depth.unflatten(0, views), sky.unflatten(0, views))


def set_sky_depth(
    depth: Float[Tensor, "b v h w"], solid: Bool[Tensor, "b v h w"], max_depth: float = torch.inf
) -> Float[Tensor, "b v h w"]:
    """Set the sky to the depth of the far foreground of all views, at most `max_depth`.

    So do the authors.
    """
    # Of a few pixels neither a quantile nor a sky is certain.
    if min(int(solid.sum()), int((~solid).sum())) <= MIN_PIXELS:
        return depth
    far = interpolate_quantile(depth[solid], FAR_QUANTILE).clamp_max(max_depth)
    return torch.where(solid, depth, far)


def interpolate_quantile(values: Float[Tensor, "n"], share: float) -> Float[Tensor, ""]:
    """Compute a quantile; `torch.quantile` is limited to 16 million values."""
    place = share * (len(values) - 1)
    ordered = values.sort().values
    below = ordered[int(place)]
    above = ordered[min(int(place) + 1, len(values) - 1)]
    return below + (above - below) * (place - int(place))
