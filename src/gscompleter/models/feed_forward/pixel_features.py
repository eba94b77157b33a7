"""Depth and features per pixel, which DepthSplat and VolSplat share."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.models.feed_forward.cameras import Cameras
from gscompleter.models.feed_forward.depth_predictor import (
    VITS,
    DepthConfig,
    MultiViewDepth,
    create_dpt_head,
)
from gscompleter.models.feed_forward.unet import create_conv_block

NUM_REGRESSED = 64
"""Number of channels that `gaussian_regressor` makes, which come first in the features."""
COLOR_CHANNELS = slice(NUM_REGRESSED, NUM_REGRESSED + 3)
"""Channels of the colour of the pixel, in [0, 1]."""


class PixelFeatures(nn.Module):
    """Base of both networks: predicts depth and features at full resolution.

    Attributes are named as the keys of the published weights.
    """

    def __init__(self, config: DepthConfig) -> None:
        super().__init__()
        features = VITS[config.vit].gaussian_features
        # Regressed ones, the colour, fused features, and the certainty of the depth.
        self.channels = NUM_REGRESSED + 3 + features + 1
        self.depth_predictor = MultiViewDepth(config)
        self.feature_upsampler = create_dpt_head(config, features, with_disparity=False)
        # From colour, depth, certainty and fused features.
        self.gaussian_regressor = create_conv_block(
            3 + 1 + 1 + features, NUM_REGRESSED, NUM_REGRESSED
        )

    def compute_pixel_features(
        self, images: Float[Tensor, "b v 3 h w"], cameras: Cameras
    ) -> tuple[Float[Tensor, "n 1 h w"], Float[Tensor, "n c h w"]]:
        """Compute z-depth in scene units and c = `channels` features of n = b v views.

        For images in [0, 1], with sides divisible by the `patch` of the config; scene by scene.
        """
        known = self.depth_predictor(images, cameras)
        features = self.feature_upsampler(known.vit_maps, known.maps)
        # The nearest value, as the authors' code does, and the order that their weights expect.
        certainty = F.interpolate(known.certainty, size=images.shape[-2:])
        flat = images.flatten(0, 1)
        regressed = self.gaussian_regressor(torch.cat([flat, known.depth, certainty, features], 1))
        return known.depth, torch.cat([regressed, flat, features, certainty], 1)
