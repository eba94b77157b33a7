"""Sizes of the Depth Anything 3 networks, as the authors published them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class VitConfig:
    """Size of the vision transformer."""

    channels: int = 384
    """Channels of a token."""
    heads: int = 6
    blocks: int = 12
    output_block_ids: tuple[int, int, int, int] = (5, 7, 9, 11)
    """Indices of the blocks that output tokens."""
    first_multi_view_block: int | None = 4
    """Index of the first multi-view block, or None for a network of single views."""
    is_gated: bool = False
    """True to use SwiGLU in the MLPs."""

    @property
    def num_output_channels(self) -> int:
        """Number of output channels per patch.

        With multi-view blocks there are two sets side by side (`AnyViewVit.join_tokens`).
        """
        return self.channels if self.first_multi_view_block is None else 2 * self.channels


@dataclass(frozen=True)
class DepthAnythingConfig:
    """Size of a network for any number of views, with or without poses."""

    vit: VitConfig = VitConfig()
    features: int = 64
    """Channels of the map that the levels are fused to."""
    widths: tuple[int, int, int, int] = (48, 96, 192, 384)
    """Channels of the four levels, finest first."""
    has_gaussian_head: bool = False
    image_size: tuple[int, int] = (504, 504)
    """Height and width of the training images, in pixels, as in the list of published weights;
    images of other sizes are taken, too."""


@dataclass(frozen=True)
class MetricDepthConfig:
    """Size of the network for metric depth of single views."""

    vit: VitConfig = VitConfig(1024, 16, 24, (4, 11, 17, 23), None)
    features: int = 256
    """As of `DepthAnythingConfig`."""
    widths: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    """As of `DepthAnythingConfig`."""
    image_size: tuple[int, int] = (504, 504)
    """As of `DepthAnythingConfig`."""


@dataclass(frozen=True)
class NestedConfig:
    """Sizes of both networks of a nested one."""

    any_view: DepthAnythingConfig
    metric: MetricDepthConfig = MetricDepthConfig()

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of the training images, as of `DepthAnythingConfig`."""
        return self.any_view.image_size


WIDE = (256, 512, 1024, 1024)
"""Widths of the large networks."""
GIANT = DepthAnythingConfig(
    VitConfig(1536, 24, 40, (19, 27, 33, 39), 13, is_gated=True), 256, WIDE, has_gaussian_head=True
)

VARIANTS: Mapping[str, DepthAnythingConfig | MetricDepthConfig | NestedConfig] = {
    "da3-small": DepthAnythingConfig(),
    "da3-base": DepthAnythingConfig(VitConfig(768, 12), 128, (96, 192, 384, 768)),
    "da3-large": DepthAnythingConfig(VitConfig(1024, 16, 24, (11, 15, 19, 23), 8), 256, WIDE),
    "da3-giant": GIANT,
    "da3-metric-large": MetricDepthConfig(),
    # Its published configuration is the same; it was trained for relative depth.
    "da3-mono-large": MetricDepthConfig(),
    "da3-nested-giant-large": NestedConfig(GIANT),
}
"""Published variants by name."""
