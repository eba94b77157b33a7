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
"""Coarsest float32 step of coordinates, relative to the camera spread. For poses in one place, of
whose scene nothing tells the size, it is in scene units."""
MAX_SEEN_STEP = 1e-4
"""Coarsest step relative to the distance of what the cameras see, if that allows a coarser one: a
tenth of a pixel at a focal length of 1000 pixels."""


def choose_local_origin(poses: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "3"]:
    """Choose the coordinate origin: zero, or the first camera centre for remote cameras.

    `poses` are camera-to-world, in the photographs' frame.
    """
    if not poses:
        return np.zeros(3)
    centers = np.stack([pose[:3, 3] for pose in poses])
    spread = np.abs(centers - centers[0]).max()
    farthest = np.abs(centers).max()
    if spread > 0:
        # Far from zero, relative to the distances between cameras, float32 loses the baselines.
        is_remote = farthest > MAX_REMOTENESS * spread
    else:
        # Without a baseline, as of a single photograph, it still rounds what is seen from there.
        is_remote = compute_step(farthest) > MAX_CAMERA_STEP
    return centers[0] if is_remote else np.zeros(3)


def compute_step(coordinate: float) -> float:
    """Compute the distance from a coordinate, in scene units, to the next one of float32."""
    return float(np.spacing(np.float32(coordinate)))


def is_near(middle: Float[np.ndarray, "3"], origin: Float[np.ndarray, "3"]) -> bool:
    """Return True if a place is less far from an origin than half as far as that is from zero.

    Both distances are those along the axis on which they are largest.
    """
    return bool(np.abs(middle - origin).max() < 0.5 * np.abs(origin).max())


def compute_frame_from_photographs(origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Compute the transform from the photographs' frame to the frame with zero at `origin`."""
    transform = np.eye(4)
    transform[:3, 3] -= origin
    return transform


def choose_scene_origin(scene: Gaussians, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Choose a scene's origin: `origin`, that of the photographs, if the scene lies near it.

    Otherwise it is zero: a given splat may have been exported at a local origin already. It has a
    Gaussian at least, as every splat that is read.
    """
    if not origin.any():
        return origin
    # The median ignores floaters.
    middle = scene.means.median(dim=0).values.double().cpu().numpy()
    return origin if is_near(middle, origin) else np.zeros(3)


def shift_to_origin(
    origin: Float[np.ndarray, "3"], scene: Gaussians, cameras: Sequence[Camera]
) -> Gaussians:
    """Express a scene relative to `origin`, in scene units.

    `cameras`, one at least, are relative to it already. The means of a scene were rounded to
    float32 in its file, which cannot be undone: raise InputError if the steps there are too coarse
    for the cameras.
    """
    if not origin.any():
        return scene
    # In float64: the difference of two large coordinates is small.
    means = scene.means.double() - torch.from_numpy(origin).to(scene.means.device)

    farthest = np.abs(origin).max()
    step = compute_step(farthest)
    centers = torch.stack([camera.center.cpu() for camera in cameras]).double()
    spread = (centers - centers[0]).norm(dim=-1).max().item()
    # Cameras in one place, or one alone, have no spread. What they see tells how much a step shows.
    distance = (means.cpu() - centers[0]).norm(dim=-1).median().item()
    require(
        step <= max(MAX_CAMERA_STEP * spread, MAX_SEEN_STEP * distance),
        f"The scene lies {farthest:g} units from its origin, where float32 has steps of {step:g}, "
        f"and its cameras are {spread:g} apart and {distance:g} from it; export the scene and its "
        "photographs relative to a local origin.",
    )
    return replace(scene, means=means.float())
