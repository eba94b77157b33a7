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
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.numerics.geometry import is_inside, project
from gscompleter.system.files.ply import read_ply_file
from gscompleter.types import Camera

AXES = ("x", "y", "z")
MIN_RANGE_POINTS = 100
"""Fewest visible points that define a depth range."""
DEPTH_QUANTILES = (0.01, 0.99)
"""Quantiles of z-depth; points beyond are taken for mismatches."""
NEAR_FACTOR = 0.5
"""Factor on the nearest depth, because many surfaces have no points."""
FAR_FACTOR = 2.0
"""Factor on the farthest depth."""


def add_depth_range(
    photographs: Photographs, frames: Sequence[int], resolution: Resolution = None
) -> Photographs:
    """Set missing near and far planes from the points that the cameras of `frames` see.

    The photographs stay the same if they have no points, or too few.
    """
    is_known = photographs.near is not None and photographs.far is not None
    points = None if is_known else photographs.points()
    if points is None:
        return photographs
    depth_range = compute_depth_range(points, [photographs.camera(f, resolution) for f in frames])
    if depth_range is None:
        return photographs
    near = depth_range[0] if photographs.near is None else photographs.near
    far = depth_range[1] if photographs.far is None else photographs.far
    # A plane of the file may lie beyond one that was found; then neither is replaced.
    return photographs if near >= far else replace(photographs, near=near, far=far)


def compute_depth_range(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera]
) -> tuple[float, float] | None:
    """Compute near and far planes (scene units) around visible points; None for too few.

    Points and cameras are in one frame, on the CPU. It is None, too, where the planes would be out
    of `DEPTH_RANGE`.
    """
    seen = [torch.zeros(0)]
    for camera in cameras:
        # Points behind a camera or outside its image say nothing about its depth range.
        pixels, z = project(points, camera)
        seen.append(z[is_inside(pixels, z, camera)])
    depths = torch.cat(seen)
    if len(depths) < MIN_RANGE_POINTS:
        return None
    low, high = np.quantile(depths.double().numpy(), DEPTH_QUANTILES).tolist()
    near = NEAR_FACTOR * low
    far = FAR_FACTOR * high
    return (near, far) if DEPTH_RANGE[0] <= near < far <= DEPTH_RANGE[1] else None


def read_point_cloud(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read the vertices of a PLY file, in its coordinates; raise InputError if it is damaged."""
    vertices = read_ply_file(path, AXES, "point cloud").rows
    return np.stack([vertices[axis].astype(np.float64) for axis in AXES], axis=-1)
