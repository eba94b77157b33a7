"""What the sizes of Depth Anything 3 differ in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gscompleter.reconstructors.feed_forward.dino import PATCH


@dataclass(frozen=True)
class VitConfig:
    """A vision transformer."""

    channels: int = 384
    heads: int = 6
    blocks: int = 12
    outputs: tuple[int, int, int, int] = (5, 7, 9, 11)
    """Blocks after which tokens are handed on, from 0 on."""
    alternates_from: int | None = 4
    """The first block that knows of other views; None where each view is seen alone."""
    gated: bool = False
    """Whether the layers between are gated (SwiGLU)."""

    @property
    def described(self) -> int:
        """Channels of what is handed on of each patch."""
        return self.channels if self.alternates_from is None else 2 * self.channels


@dataclass(frozen=True)
class DepthAnythingConfig:
    """Any number of views, with or without poses."""

    vit: VitConfig = VitConfig()
    features: int = 64
    """Channels of the fused maps."""
    widths: tuple[int, int, int, int] = (48, 96, 192, 384)
    """Channels of the four levels, finest first."""
    gaussians: bool = False
    """Whether there is a head for Gaussians."""
    image_size: tuple[int, int] = (504, 504)
    """Height and width it was trained at, in pixels; the longer side matters."""

    @property
    def patch(self) -> int:
        """Sides of the images must be multiples of it, in pixels."""
        return PATCH


@dataclass(frozen=True)
class MetricDepthConfig:
    """One view at a time, depth in metres."""

    vit: VitConfig = VitConfig(1024, 16, 24, (4, 11, 17, 23), None)
    features: int = 256
    widths: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    image_size: tuple[int, int] = (504, 504)


@dataclass(frozen=True)
class NestedConfig:
    """Any number of views, in metres."""

    any_view: DepthAnythingConfig
    metric: MetricDepthConfig = MetricDepthConfig()

    @property
    def image_size(self) -> tuple[int, int]:
        return self.any_view.image_size


WIDE = (256, 512, 1024, 1024)
GIANT = DepthAnythingConfig(
    VitConfig(1536, 24, 40, (19, 27, 33, 39), 13, gated=True), 256, WIDE, gaussians=True
)

VARIANTS: Mapping[str, DepthAnythingConfig | MetricDepthConfig | NestedConfig] = {
    "da3-small": DepthAnythingConfig(),
    "da3-base": DepthAnythingConfig(VitConfig(768, 12), 128, (96, 192, 384, 768)),
    "da3-large": DepthAnythingConfig(VitConfig(1024, 16, 24, (11, 15, 19, 23), 8), 256, WIDE),
    "da3-giant": GIANT,
    "da3-metric-large": MetricDepthConfig(),
    "da3-nested-giant-large": NestedConfig(GIANT),
}
"""The published ones."""
