"""A local origin for scenes with large coordinates, such as those of maps.

At 5,000,000 m float32 has steps of half a metre, which hides a stereo baseline. Poses are read in
float64, so the origin can move before rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.data.limits import require
from gscompleter.types import Camera, Gaussians

MAX_REMOTENESS = 1e3
"""Ratio of the largest coordinate to the camera spread above which a local origin is used."""
MAX_CAMERA_STEP = 1e-3
"""Coarsest float32 step of coordinates, relative to the camera spread."""


def choose_local_origin(poses: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "3"]:
    """Choose the coordinate origin: zero, or the first camera centre for remote cameras.

    `poses` are camera-to-world, in the photographs' frame.
    """
    if not poses:
        return np.zeros(3)
    centers = np.stack([pose[:3, 3] for pose in poses])
    spread = np.abs(centers - centers[0]).max()
    # Where cameras are far from zero, relative to their distances, float32 loses the baselines.
    is_remote = spread > 0 and np.abs(centers).max() > MAX_REMOTENESS * spread
    return centers[0] if is_remote else np.zeros(3)


def is_near(middle: Float[np.ndarray, "3"], origin: Float[np.ndarray, "3"]) -> bool:
    """Return True if coordinates lie nearer to an origin than half-way to zero."""
    return bool(np.abs(middle - origin).max() < 0.5 * np.abs(origin).max())


def compute_frame_from_photographs(origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Build the transform from the photographs' frame to the frame with zero at `origin`."""
    transform = np.eye(4)
    transform[:3, 3] -= origin
    return transform


def choose_scene_origin(scene: Gaussians, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Choose a scene's origin: `origin`, that of the photographs, if the scene lies near it.

    Otherwise it is zero: a given splat may have been exported at a local origin already.
    """
    if len(scene) == 0 or not origin.any():
        return origin
    # The median ignores floaters.
    middle = scene.means.median(dim=0).values.double().cpu().numpy()
    return origin if is_near(middle, origin) else np.zeros(3)


def shift_to_origin(
    origin: Float[np.ndarray, "3"], scene: Gaussians, cameras: Sequence[Camera]
) -> Gaussians:
    """Express a scene relative to `origin`, in scene units; refuse too coarse float32 steps.

    The means of a given scene are float32 already, and what was rounded there cannot be restored.
    """
    if not origin.any():
        return scene
    # Distance to the next float32 at the largest coordinate.
    step = float(np.spacing(np.float32(np.abs(origin).max())))
    centers = torch.stack([camera.center.cpu() for camera in cameras])
    spread = (centers - centers[0]).norm(dim=-1).max().item()
    require(
        step <= MAX_CAMERA_STEP * spread,
        f"The scene lies {np.abs(origin).max():g} units from its origin, where float32 has steps "
        f"of {step:g}, and its cameras are {spread:g} apart; export the scene and its photographs "
        "relative to a local origin.",
    )
    # In float64: the difference of two large coordinates is small.
    means = scene.means.double() - torch.from_numpy(origin).to(scene.means.device)
    return replace(scene, means=means.float())
