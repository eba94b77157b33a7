"""A local origin for scenes whose coordinates are large, as those of maps are.

At 5,000,000 m float32 has steps of half a metre, and a stereo baseline is lost in them. Poses are
read in float64, so that the origin can be moved before anything is rounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.errors import InputError
from gscompleter.types import Camera, Gaussians

MAX_REMOTENESS = 1e3
"""Coordinates this many times as large as the cameras' spread are told from a local origin: of
the seven digits of float32, stereo needs four."""
MAX_STEP = 1e-3
"""Coarsest step of a scene's coordinates, in distances between its cameras."""


def local_origin(poses: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "3"]:
    """Where coordinates are counted from: zero, or for remote cameras the first one's centre."""
    if not poses:
        return np.zeros(3)
    centers = np.stack([pose[:3, 3] for pose in poses])
    spread = np.abs(centers - centers[0]).max()
    remote = spread > 0 and np.abs(centers).max() > MAX_REMOTENESS * spread
    return centers[0] if remote else np.zeros(3)


def frame_from_photographs(origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The transform from the photographs' own frame to the one that `origin` is the zero of."""
    transform = np.eye(4)
    transform[:3, 3] -= origin
    return transform


def origin_of(scene: Gaussians, origin: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Where a scene's coordinates are to be told from beside photographs told from `origin`.

    From there too, if the scene lies there; from zero, if it is in a frame of its own.
    """
    if len(scene) == 0 or not origin.any():
        return origin
    middle = scene.means.median(dim=0).values.double().cpu().numpy()
    there = np.abs(middle - origin).max() < 0.5 * np.abs(origin).max()
    return origin if there else np.zeros(3)


def told_from(
    origin: Float[np.ndarray, "3"], scene: Gaussians, cameras: Sequence[Camera]
) -> Gaussians:
    """A scene in the photographs' own frame, told from `origin` (scene units) as `cameras` are.

    Raises:
        InputError: where float32 is too coarse so far from zero for what the cameras show.
    """
    if not origin.any():
        return scene
    step = float(np.spacing(np.float32(np.abs(origin).max())))
    centers = torch.stack([camera.center.cpu() for camera in cameras])
    spread = (centers - centers[0]).norm(dim=-1).max().item()
    if step > MAX_STEP * spread:
        raise InputError(
            f"The scene lies {np.abs(origin).max():g} units from its origin, where float32 has "
            f"steps of {step:g}, and its cameras are {spread:g} apart; export the scene and its "
            "photographs relative to a local origin."
        )
    means = scene.means.double() - torch.from_numpy(origin).to(scene.means.device)
    return replace(scene, means=means.float())
