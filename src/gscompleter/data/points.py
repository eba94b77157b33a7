"""Depth range of a scene from the sparse points of its reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.limits import DEPTH_RANGE
from gscompleter.data.photographs import Photographs
from gscompleter.data.resize import Resolution
from gscompleter.splats.ply_file import read_ply_file
from gscompleter.types import Camera

AXES = ("x", "y", "z")
MIN_POINTS = 100
"""Fewest visible points that define a depth range."""
PERCENTILES = (0.01, 0.99)
"""Percentiles of z-depth; points beyond are taken for mismatches."""
NEAR_FACTOR, FAR_FACTOR = 0.5, 2.0
"""Factors on the nearest and farthest depth, because many surfaces have no points."""


def add_depth_range(
    photographs: Photographs, frames: Sequence[int], resolution: Resolution = None
) -> Photographs:
    """Set missing near and far planes from the points that the cameras of `frames` see."""
    if photographs.near is not None and photographs.far is not None:
        return photographs
    points = photographs.points()
    if points is None:
        return photographs
    found = compute_depth_range(points, [photographs.camera(f, resolution) for f in frames])
    near, far = found or (None, None)
    near = near if photographs.near is None else photographs.near
    far = far if photographs.far is None else photographs.far
    empty = near is not None and far is not None and near >= far
    return photographs if empty else replace(photographs, near=near, far=far)


def compute_depth_range(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera]
) -> tuple[float, float] | None:
    """Compute near and far planes (scene units) around the points that the cameras see.

    Returns None for too few points. Hidden points count too; the percentiles tolerate them.
    """
    depths = torch.cat([torch.zeros(0), *(_compute_visible_depths(points, c) for c in cameras)])
    if len(depths) < MIN_POINTS:
        return None
    low, high = np.quantile(depths.double().numpy(), PERCENTILES).tolist()
    near, far = widen_depth_range(low, high)
    return (near, far) if DEPTH_RANGE[0] <= near < far <= DEPTH_RANGE[1] else None


def widen_depth_range(nearest: float, farthest: float) -> tuple[float, float]:
    """Widen a depth range (scene units) for surfaces without points."""
    return NEAR_FACTOR * nearest, FAR_FACTOR * farthest


def _compute_visible_depths(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "m"]:
    """Compute the z-depths of the points that project into the image."""
    local = (points - camera.center) @ camera.c2w[:3, :3]
    front = local[local[:, 2] > 0]
    pixels = (front @ camera.K.T)[:, :2] / front[:, 2:]
    size = torch.tensor([camera.width, camera.height])
    return front[((pixels >= 0) & (pixels < size)).all(dim=1), 2]


def read_point_cloud(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the vertices of a PLY file, in scene units."""
    vertices = read_ply_file(path, AXES, "point cloud").rows
    return np.stack([vertices[axis].astype(np.float64) for axis in AXES], axis=-1)
