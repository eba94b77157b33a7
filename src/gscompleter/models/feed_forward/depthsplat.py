"""DepthSplat (Xu et al., CVPR 2025): Gaussians from cost volumes and monocular features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gscompleter.models.feed_forward.cameras import Cameras
from gscompleter.models.feed_forward.depth_predictor import DepthConfig
from gscompleter.models.feed_forward.dpt import create_padded_conv_block
from gscompleter.models.feed_forward.gaussian_adapter import (
    DEPTHSPLAT_CHANNELS,
    PixelGaussians,
    create_depthsplat_gaussians,
)
from gscompleter.models.feed_forward.pixel_features import PixelFeatures


@dataclass(frozen=True)
class DepthSplatConfig:
    """Architecture of DepthSplat."""

    depth: DepthConfig = DepthConfig()
    image_size: tuple[int, int] = (256, 256)
    """Height and width of the training images, in pixels; other sizes work too."""
    gaussian_scale_max: float = 3.0
    """Largest standard deviation of a Gaussian, in scene units."""

    @property
    def patch(self) -> int:
        """Side lengths of the images must be multiples of this, in pixels."""
        return self.depth.patch


SMALL = DepthConfig("vits", 1, 4, 4)
BASE = DepthConfig("vitb", 2, 2, 4)
LARGE = DepthConfig("vitl", 2, 2, 4)
BASE_WIDE = DepthConfig("vitb", 2, 4, 8)
SMALL_WIDE = DepthConfig("vits", 1, 8, 8)

VARIANTS: Mapping[str, DepthSplatConfig] = {
    "small-re10k-256x256": DepthSplatConfig(SMALL),
    "base-re10k-256x256": DepthSplatConfig(BASE),
    "large-re10k-256x256": DepthSplatConfig(LARGE),
    "base-re10k-256x448": DepthSplatConfig(BASE_WIDE, (256, 448)),
    "base-dl3dv-256x448": DepthSplatConfig(BASE_WIDE, (256, 448)),
    "small-re10kdl3dv-448x768": DepthSplatConfig(SMALL_WIDE, (448, 768), 0.1),
    "base-re10kdl3dv-448x768": DepthSplatConfig(BASE_WIDE, (448, 768), 0.1),
}
"""Published variants by size, data and resolution."""


class DepthSplat(PixelFeatures):
    """The DepthSplat network: 38 M (small), 121 M (base) or 354 M (large) parameters."""

    def __init__(self, config: DepthSplatConfig = DepthSplatConfig()) -> None:
        super().__init__(config.depth)
        self.config = config
        self.gaussian_head = create_padded_conv_block(
            self.channels, DEPTHSPLAT_CHANNELS, DEPTHSPLAT_CHANNELS
        )

    def forward(self, images: Float[Tensor, "b v 3 h w"], cameras: Cameras) -> PixelGaussians:
        """Predict a Gaussian for each pixel; see `MultiViewDepth` for the images."""
        depth, features = self.compute_pixel_features(images, cameras)
        raw = self.gaussian_head(features)
        flat = images.flatten(0, 1)
        return create_depthsplat_gaussians(
            raw, depth, flat, cameras, self.config.gaussian_scale_max
        )
