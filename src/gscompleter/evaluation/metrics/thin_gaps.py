"""Thin gaps: cracks between surfaces, which open as soon as the camera leaves the target.

A hole counts from alpha 0.5 down. Gaps of parallax and of depth edges are mostly more opaque than
that, so that no score of holes tells of them, and they are seen as dark lines all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.geometry import measure_baseline
from gscompleter.numerics.image_ops import keep_thin
from gscompleter.planning.candidates import interpolate_camera
from gscompleter.render.protocols import Renderer
from gscompleter.types import Camera, Gaussians

OPAQUE = 0.85
"""Alpha below which black is seen through a surface."""
FLIGHT_SHARES = (0.2, 0.4, 0.6, 0.8)
"""Places of the cameras of a flight, as shares of the way to the target."""


def find_thin_gaps(alpha: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """Find the pixels below `OPAQUE` in structures thinner than 5 pixels."""
    return keep_thin(alpha < OPAQUE)


def measure_thin_gaps(alpha: Float[Tensor, "h w"]) -> float:
    """Compute the share of an image that is thin gaps."""
    return find_thin_gaps(alpha).float().mean().item()


def plan_flight(photographs: Sequence[Camera], target: Camera) -> list[Camera]:
    """Place cameras between the nearest photograph and the target, with the lens of the target."""
    nearest = min(photographs, key=lambda camera: measure_baseline(camera, target))
    # Seen from the target, since its image size and intrinsics are kept.
    return [interpolate_camera(target, nearest, 1 - share) for share in FLIGHT_SHARES]


def measure_flight(
    scene: Gaussians, photographs: Sequence[Camera], target: Camera, renderer: Renderer
) -> float:
    """Compute the mean share of thin gaps on the way from the nearest photograph to the target."""
    cameras = plan_flight(photographs, target)
    return fmean(measure_thin_gaps(renderer.render(scene, camera).alpha) for camera in cameras)
