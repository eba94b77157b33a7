"""How much a render of a splat looks like a photograph that somebody took there.

Where nobody stood, a splat is mist: a pixel mixes Gaussians of many depths. And what is too near is
large: one Gaussian fills much of the image. True cameras of trained splats are better by both than
random ones that are covered and clear (AUC 0.93 to 1.00, decision 053).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import compute_z_depths
from gscompleter.render.protocols import FrozenScene
from gscompleter.types import Camera, Gaussians

HALF_MIST = 0.1
"""Mist at which the quality is halved."""
HALF_FOOTPRINT = 0.05
"""Footprint at which the quality is halved."""
NEAREST_SURFACE_QUANTILE = 0.05
"""Quantile of the depths that counts as the nearest surface."""


@dataclass(frozen=True)
class CameraQuality:
    """Quality of a camera."""

    covered: float
    """Share of the image that shows the splat."""
    mist: float
    """Mean spread of depth within a pixel, relative to its depth."""
    footprint: float
    """Median size of what a pixel shows, relative to the image."""
    nearest: float
    """z-depth of the nearest surface, in scene units."""

    @property
    def score(self) -> float:
        """Score in [0, 1]."""
        clear = 1 / (1 + self.mist / HALF_MIST) / (1 + self.footprint / HALF_FOOTPRINT)
        return self.covered**2 * clear


NOTHING = CameraQuality(0.0, 1.0, 1.0, 0.0)
"""Quality of a camera that sees nothing."""


def measure_camera_quality(scene: Gaussians, camera: Camera, frozen: FrozenScene) -> CameraQuality:
    """Measure the quality of a camera; `frozen` is the scene there."""
    render = frozen.render
    covered = render.alpha >= COVERED
    if not covered.any():
        return NOTHING
    weight = render.alpha[covered]
    z = compute_z_depths(scene.means, camera).clamp_min(0)
    # The splatted values are sums over compositing weights, whose own sum is alpha.
    mean = frozen.splat(z)[covered] / weight
    square = frozen.splat(z * z)[covered] / weight
    spread = (square - mean**2).clamp_min(0).sqrt() / mean.clamp_min(1e-30)

    distance = (scene.means - camera.center).norm(dim=1).clamp_min(1e-30)
    size = scene.scales.amax(dim=1) / distance * camera.K[0, 0] / camera.width
    footprint = frozen.splat(size.clamp(0, 1e3))[covered] / weight
    return CameraQuality(
        covered.float().mean().item(),
        spread.mean().item(),
        footprint.median().item(),
        torch.quantile(render.depth[covered], NEAREST_SURFACE_QUANTILE).item(),
    )
