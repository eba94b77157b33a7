"""Conversion between the scene and the page: cameras, and Gaussians without view-dependent colour.

Both have OpenCV axes. Page units are scaled so that the photographed surfaces are a few units away,
as the controls and clipping planes of the page expect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from gscompleter.geometry import quats_to_rotations, rotations_to_quats
from gscompleter.types import SH_C0, Camera, Gaussians

SCENE_DISTANCE = 3.0
"""Distance of the middle of the depth range, in page units."""


@dataclass(frozen=True)
class PagePose:
    """Position, rotation and field of view of a page camera."""

    wxyz: Float[np.ndarray, "4"]
    """Rotation to the world, as a quaternion."""
    position: Float[np.ndarray, "3"]
    """Camera centre, in page units."""
    fov: float
    """Vertical field of view, in radians."""


def compute_page_unit(camera: Camera) -> float:
    """Compute page units per scene unit from a camera with a depth range."""
    assert camera.near is not None
    assert camera.far is not None
    return SCENE_DISTANCE / math.sqrt(camera.near * camera.far)


def camera_to_page(camera: Camera, unit: float) -> PagePose:
    """Convert a scene camera to a page pose."""
    c2w = camera.c2w.detach().cpu().double()
    fov = 2 * math.atan(camera.height / 2 / camera.K[1, 1].item())
    return PagePose(rotations_to_quats(c2w[:3, :3]).numpy(), c2w[:3, 3].numpy() * unit, fov)


def camera_from_page(pose: PagePose, height: int, width: int, unit: float) -> Camera:
    """Convert a page pose to a scene camera with the same vertical field of view."""
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = quats_to_rotations(torch.from_numpy(np.asarray(pose.wxyz, dtype=np.float64)))
    c2w[:3, 3] = torch.from_numpy(np.asarray(pose.position, dtype=np.float64)) / unit
    focal = height / 2 / math.tan(pose.fov / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(c2w.float(), K, width, height)


def make_page_splat(gaussians: Gaussians, unit: float) -> dict[str, Any]:
    """Convert one or more Gaussians for the page, which scales them back by `scale`.

    The page keeps covariances in float16, in which those of a scene in kilometres would vanish, so
    their unit is the median of the largest scales.
    """
    gaussians = gaussians.to("cpu")
    size = gaussians.scales.amax(dim=1).median().item()
    axes = quats_to_rotations(gaussians.quats) * (gaussians.scales / size)[:, None, :]
    rgbs = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1)
    return {
        "centers": (gaussians.means / size).numpy(),
        "covariances": (axes @ axes.transpose(1, 2)).numpy(),
        "rgbs": rgbs.numpy(),
        "opacities": gaussians.opacities[:, None].clamp(0, 1).numpy(),
        "scale": size * unit,
    }
