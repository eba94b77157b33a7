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
"""Number of channels regressed from all others; they come first."""
COLOR_CHANNELS = slice(NUM_REGRESSED, NUM_REGRESSED + 3)
"""The colour channels of the pixel."""


class PixelFeatures(nn.Module):
    """Network part that predicts depth and features at full resolution."""

    def __init__(self, config: DepthConfig) -> None:
        super().__init__()
        features = VITS[config.vit].gaussian_features
        self.channels = NUM_REGRESSED + 3 + features + 1
        self.depth_predictor = MultiViewDepth(config)
        self.feature_upsampler = create_dpt_head(config, features, with_disparity=False)
        self.gaussian_regressor = create_conv_block(features + 5, NUM_REGRESSED, NUM_REGRESSED)

    def compute_pixel_features(
        self, images: Float[Tensor, "b v 3 h w"], cameras: Cameras
    ) -> tuple[Float[Tensor, "n 1 h w"], Float[Tensor, "n c h w"]]:
        """Compute z-depth in scene units and `channels` features of n = b v views."""
        known = self.depth_predictor(images, cameras)
        features = self.feature_upsampler(known.vit_maps, known.maps)
        certainty = F.interpolate(known.certainty, size=images.shape[-2:])
        flat = images.flatten(0, 1)
        # The head gets what depth was found and how certainly, beside colours and fused features.
        regressed = self.gaussian_regressor(torch.cat([flat, known.depth, certainty, features], 1))
        return known.depth, torch.cat([regressed, flat, features, certainty], 1)
