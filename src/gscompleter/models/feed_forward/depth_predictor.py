"""The depth predictor that DepthSplat and VolSplat share: matching and monocular features.

Attributes of modules are named as the keys of the published weights. Disparity is inverse z-depth,
in 1 / scene units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gscompleter.models.feed_forward.cameras import Cameras, find_nearest_views, list_other_views
from gscompleter.models.feed_forward.cnn import ImageEncoder, normalize_images
from gscompleter.models.feed_forward.cost_volume import compute_cost_volume, space_evenly
from gscompleter.models.feed_forward.dino import PATCH, DinoV2
from gscompleter.models.feed_forward.dpt import (
    CHANNELS,
    DptHead,
    Layout,
    create_padded_conv3x3,
    create_padded_conv_block,
)
from gscompleter.models.feed_forward.resampling import enlarge, resize_bilinear
from gscompleter.models.feed_forward.transformer import MultiViewTransformer
from gscompleter.models.feed_forward.unet import UNet, create_conv3x3, create_refiner

MAX_SOURCES = 2
"""Most source views that a view is matched with: the nearest ones."""


@dataclass(frozen=True)
class VitSizes:
    """Sizes that depend on the vision transformer, and channels of its two DPT heads."""

    channels: int
    """Channels of its tokens."""
    num_blocks: int
    heads: int
    """Attention heads of a block."""
    feature_blocks: tuple[int, int, int, int]
    """Indices of the blocks that provide features."""
    widths: tuple[int, int, int, int]
    """Channels of the four levels of the DPT heads, finest first."""
    depth_features: int
    """Channels of the DPT head that corrects the disparity."""
    gaussian_features: int
    """Channels of the DPT head that `PixelFeatures` makes Gaussians of."""


VITS = {
    "vits": VitSizes(384, 12, 6, (2, 5, 8, 11), (48, 96, 192, 384), 32, 64),
    "vitb": VitSizes(768, 12, 12, (2, 5, 8, 11), (96, 192, 384, 768), 48, 96),
    "vitl": VitSizes(1024, 24, 16, (4, 11, 17, 23), (128, 256, 512, 1024), 64, 128),
}
"""Sizes of DINOv2 and of what the authors built on it, by the name of the transformer."""

LAYOUTS: Mapping[tuple[int, int], Layout] = {
    (4, 1): (("cnn0", "cnn1", "vit"), ("cnn2", "vit", "matching0", "disparity"), ("vit",)),
    (2, 2): (
        ("cnn0", "cnn1", "matching1", "disparity", "vit"),
        ("cnn2", "vit", "matching0"),
        ("vit",),
    ),
    (4, 2): (
        ("cnn0", "vit"),
        ("cnn1", "vit", "matching1", "disparity"),
        ("cnn2", "vit", "matching0"),
    ),
    (8, 1): (("cnn0", "vit"), ("cnn1", "vit"), ("cnn2", "vit", "matching0", "disparity")),
}
"""Names of the maps that a DPT head joins at 1/2, 1/4 and 1/8 resolution, by upsampling factor and
number of scales. No published variant has another combination."""


@dataclass(frozen=True)
class DepthConfig:
    """Architecture of the depth predictor; `LAYOUTS` has the combinations that exist."""

    vit: Literal["vits", "vitb", "vitl"] = "vits"
    num_scales: Literal[1, 2] = 1
    """Number of matching resolutions; each is twice the one before."""
    upsample_factor: Literal[2, 4, 8] = 4
    """Full resolution divided by the finest matching resolution."""
    lowest_feature_resolution: Literal[4, 8] = 4
    """Full resolution divided by that of the coarsest features."""
    num_candidates: int = 128
    """Number of disparities to try at the coarsest resolution; the next one has a quarter of it."""
    depth_chunk: int = 16
    """Number of candidates that are matched at a time; smaller values need less memory."""

    @property
    def patch(self) -> int:
        """Side lengths of the images must be multiples of this, in pixels, as the authors' are."""
        return 16 if self.lowest_feature_resolution == 4 else 64


@dataclass(frozen=True)
class DepthPrediction:
    """z-depth and features of n = b v views, the v views of a scene one after the other."""

    depth: Float[Tensor, "n 1 h w"]
    """In scene units, between near and far of the camera."""
    certainty: Float[Tensor, "n 1 p q"]
    """Probability of the best candidate, at the finest matching resolution."""
    maps: Mapping[str, Float[Tensor, "n _ _ _"]]
    """Maps of the encoder and of matching, by the names in `CHANNELS` of `dpt.py`."""
    vit_maps: list[Float[Tensor, "n _ _ _"]]
    """Maps of the four `feature_blocks` of the vision transformer, at 1/8 resolution."""


class Pyramid(nn.Module):
    """A feature map and, for two scales, one of twice the resolution with half the channels."""

    def __init__(self, channels: int, num_scales: int) -> None:
        super().__init__()
        self.stages = nn.ModuleList([nn.Identity()])
        if num_scales == 2:
            half = channels // 2
            upsampling = nn.ConvTranspose2d(channels, half, 2, 2)
            self.stages.append(nn.Sequential(upsampling, nn.GELU(), create_conv3x3(half, half)))

    def forward(self, x: Float[Tensor, "n c h w"]) -> list[Float[Tensor, "n _ _ _"]]:
        """Compute the maps, coarsest first."""
        return [stage(x) for stage in self.stages]


class MultiViewDepth(nn.Module):
    """Depth from cost volumes and monocular features, coarse to fine."""

    def __init__(self, config: DepthConfig) -> None:
        super().__init__()
        self.config = config
        self.vit = VITS[config.vit]
        self.backbone = ImageEncoder(1 if config.lowest_feature_resolution == 4 else 2, 2)
        self.transformer = MultiViewTransformer()
        self.pretrained = DinoV2(self.vit.channels, self.vit.num_blocks, self.vit.heads)
        self.mv_pyramid = Pyramid(128, config.num_scales)
        self.mono_pyramid = Pyramid(self.vit.channels, config.num_scales)
        self.regressor = nn.ModuleList()
        self.regressor_residual = nn.ModuleList()
        self.depth_head = nn.ModuleList()
        for scale in range(config.num_scales):
            self.add_scale(scale)
        features = self.vit.depth_features
        self.upsampler = create_dpt_head(
            config, features, with_disparity=True, out=create_residual_layers(features)
        )

    def add_scale(self, scale: int) -> None:
        """Add the layers from the cost volume of `scale` (0 is coarsest) to probabilities."""
        width = 128 // 2**scale
        candidates = self.config.num_candidates // 4**scale
        image_channels = CHANNELS[f"cnn{2 - scale}"]
        vit_channels = self.vit.channels // 2**scale
        channels = candidates + image_channels + width + vit_channels
        unet = UNet(width, levels=3 + scale, attention_level=2 + scale, pre_norm=True)
        self.regressor.append(create_refiner(channels, width, unet))
        self.regressor_residual.append(nn.Conv2d(channels, width, 1))
        self.depth_head.append(create_padded_conv_block(width, 2 * width, candidates))

    def forward(self, images: Float[Tensor, "b v 3 h w"], cameras: Cameras) -> DepthPrediction:
        """Predict depth for at least two images in [0, 1], with sides divisible by `patch`."""
        b, v = images.shape[:2]
        if v <= MAX_SOURCES + 1:
            sources = list_other_views(b, v, images.device)
        else:
            sources = find_nearest_views(cameras, MAX_SOURCES)

        # Three kinds of features per scale: of the encoder, after attention to the sources, and of
        # the vision transformer, which sees one view alone.
        flat = normalize_images(images.flatten(0, 1))
        encoded = self.backbone(flat)
        matching = self.mv_pyramid(self.transformer(encoded[-1], sources))
        vit_maps = self.compute_vit_features(flat)
        deepest = resize_bilinear(vit_maps[-1], encoded[-1].shape[2:])
        contexts = list(zip(encoded[::-1], matching, self.mono_pyramid(deepest), strict=False))

        # Candidates over the whole range, evenly in disparity. The finer scale searches around what
        # the coarser one found, at half its spacing.
        low, high = cameras.compute_inverse_range()
        candidates = space_evenly(low, high, self.config.num_candidates)
        disparity, probability = self.match_sources(0, contexts[0], cameras, sources, candidates)
        for scale in range(1, self.config.num_scales):
            number = self.config.num_candidates // 4**scale
            interval = (high - low) / (self.config.num_candidates - 1) / 2**scale
            candidates = sample_candidates(enlarge(disparity, 2), interval, number, low, high)
            disparity, probability = self.match_sources(
                scale, contexts[scale], cameras, sources, candidates
            )

        # Up to full resolution, with a correction from all features.
        maps = {f"cnn{i}": x for i, x in enumerate(encoded)}
        maps |= {f"matching{i}": x for i, x in enumerate(matching)}
        residual = self.upsampler(vit_maps, {**maps, "disparity": disparity})
        full = enlarge(disparity, self.config.upsample_factor) + residual
        certainty = probability.amax(1, keepdim=True)
        return DepthPrediction(1 / full.clamp(low, high), certainty, maps, vit_maps)

    def compute_vit_features(
        self, images: Float[Tensor, "n 3 h w"]
    ) -> list[Float[Tensor, "n c p q"]]:
        """Compute four feature maps of the vision transformer at 1/8 resolution.

        `images` are normalised. They are made smaller to whole patches of the transformer.
        """
        h, w = images.shape[2:]
        patches = resize_bilinear(images, (h // PATCH * PATCH, w // PATCH * PATCH))
        return [
            resize_bilinear(x, (h // 8, w // 8))
            for x in self.pretrained(patches, self.vit.feature_blocks)
        ]

    def match_sources(
        self,
        scale: int,
        context: tuple[Float[Tensor, "n _ h w"], ...],
        cameras: Cameras,
        sources: Int[Tensor, "b v s"],
        candidates: Float[Tensor, "n d _ _"],
    ) -> tuple[Float[Tensor, "n 1 h w"], Float[Tensor, "n d h w"]]:
        """Estimate the disparity and the probability of each candidate, at one scale.

        Args:
            scale: 0 for the coarsest.
            context: Features at its resolution: of the encoder, after attention to the sources (the
                ones that are matched), and of the vision transformer.
            cameras: Cameras of the views.
            sources: Indices of source views within their scene.
            candidates: Disparities, for each view or each pixel.
        """
        _, to_match, _ = context
        costs = compute_cost_volume(to_match, cameras, sources, candidates, self.config.depth_chunk)
        joined = torch.cat([costs, *context], 1)
        refined = self.regressor[scale](joined, sources.shape[1])
        logits = self.depth_head[scale](refined + self.regressor_residual[scale](joined))
        probability = logits.softmax(1)
        # The expectation over the candidates is finer than their spacing.
        return (probability * candidates).sum(1, keepdim=True), probability


def create_dpt_head(
    config: DepthConfig, features: int, with_disparity: bool, out: nn.Module | None = None
) -> DptHead:
    """Create a DPT head that fuses the maps of a `DepthPrediction` into `features` channels.

    `out` are layers after them. Without `with_disparity` it leaves the disparity out.
    """
    vit = VITS[config.vit]
    levels = LAYOUTS[config.upsample_factor, config.num_scales]
    layout = [[name for name in names if with_disparity or name != "disparity"] for names in levels]
    return DptHead(vit.channels, vit.widths, features, layout, out)


def create_residual_layers(features: int) -> nn.Sequential:
    """Create the layers that map fused features to a correction of the disparity."""
    return nn.Sequential(
        create_padded_conv3x3(features, features // 2),
        nn.GELU(),
        create_padded_conv3x3(features // 2, 16),
        nn.GELU(),
        nn.Conv2d(16, 1, 1),
    )


def sample_candidates(
    disparity: Float[Tensor, "n 1 h w"],
    interval: Float[Tensor, "n 1 1 1"],
    number: int,
    low: Float[Tensor, "n 1 1 1"],
    high: Float[Tensor, "n 1 1 1"],
) -> Float[Tensor, "n {number} h w"]:
    """Sample disparities around `disparity`, spaced evenly by `interval`.

    Only both ends are clamped to [`low`, `high`]: beside these the samples lie closer together.
    """
    start = (disparity - number // 2 * interval).clamp(low, high)
    stop = (disparity + (number // 2 - 1) * interval).clamp(low, high)
    return space_evenly(start, stop, number)
