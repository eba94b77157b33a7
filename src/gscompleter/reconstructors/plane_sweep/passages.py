"""Keep what is not measured away from places that a camera passed.

Surfaces that only one photograph shows continue those beside them, and may hang in the air where
other cameras were carried along. No photograph of the context sees through them there, but whoever
looks from such a place sees little else (decision 158).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from gscompleter.numerics.geometry import interpolate_camera
from gscompleter.reconstructors.plane_sweep.sweep import Map, Mask
from gscompleter.types import Camera, DepthMap, View

PASSAGE_DEPTH = 1.25
"""Depth up to which nothing stands before a passage, relative to the near plane of the scene, which
has half the depth of the nearest features."""
PASSAGE_NEIGHBOURS = 3
"""Number of neighbours of each camera on the way to which there are passages."""
PASSAGE_SHARES = 0.25, 0.5, 0.75
"""Shares of that way at which they are."""
MIN_PASSAGE_COSINE = 0.5
"""Least cosine of the angle between the directions of neighbours. What lies between cameras that
look elsewhere is not known."""
POINTS_AT_ONCE = 4096
"""Points that are projected into all passages at a time, to save memory."""


@dataclass(frozen=True)
class Passages:
    """Cameras that photographs were taken with, and others on the way between these."""

    cameras: Sequence[Camera] = ()
    depth: float = 0.0
    """z-depth, in scene units, up to which nothing stands before them."""
    of_views: Sequence[Camera] = ()
    """Cameras of the views whose pixels are asked for."""
    unit: float = 1.0
    """Unit of length of their inverse depths, in scene units."""

    @cached_property
    def matrices(self) -> Float32[np.ndarray, "passages 3 4"]:
        """Matrices from world points to homogeneous pixels, whose third entry is z-depth."""
        return np.stack([compute_projection(passage) for passage in self.cameras])

    @cached_property
    def centers(self) -> Float32[Tensor, "passages 3"]:
        """Centres of the cameras."""
        return torch.stack([passage.center for passage in self.cameras]).float()

    @cached_property
    def reach(self) -> float:
        """Largest distance, in scene units, of a point that stands right before a passage."""
        return self.depth * max(measure_longest_ray(passage) for passage in self.cameras)

    def find_blocking(self, number: int, inverse: Map, mask: Mask) -> Mask:
        """Find the pixels in the mask of a view that stand right before a passage."""
        blocking = np.zeros_like(mask)
        rows, columns = np.nonzero(mask)
        if not self.cameras or not len(rows):
            return blocking
        camera = self.of_views[number]
        depth = torch.from_numpy(self.unit / inverse[rows, columns]).to(camera.c2w)
        points = (camera.center + depth[:, None] * camera.z_rays()[rows, columns]).float()
        # Points in world axes and scene units, some at a time to save memory. Most are far from all
        # passages, which their distances tell before they are projected.
        starts = range(0, len(points), POINTS_AT_ONCE)
        distance = [
            torch.cdist(points[i : i + POINTS_AT_ONCE], self.centers).amin(dim=1) for i in starts
        ]
        is_near = (torch.cat(distance) < self.reach).numpy()
        rows, columns, near = rows[is_near], columns[is_near], points.numpy()[is_near]

        width, height = np.array([[p.width, p.height] for p in self.cameras], np.float32).T
        for start in range(0, len(near), POINTS_AT_ONCE):
            part = slice(start, start + POINTS_AT_ONCE)
            homogeneous = self.matrices[..., :3] @ near[part].T + self.matrices[..., 3:]
            # x and y are pixels times z, so that nothing is divided by a z near 0; behind a camera,
            # where z is negative, none is inside.
            x, y, z = homogeneous.swapaxes(0, 1)
            is_inside = (x >= 0) & (x < width[:, None] * z) & (y >= 0) & (y < height[:, None] * z)
            blocking[rows[part], columns[part]] = (is_inside & (z < self.depth)).any(axis=0)
        return blocking


def measure_longest_ray(camera: Camera) -> float:
    """Measure the longest ray of a camera of unit z, to a corner of its image."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    x = max(cx, camera.width - cx) / fx
    y = max(cy, camera.height - cy) / fy
    return math.hypot(x, y, 1)


def compute_projection(camera: Camera) -> Float32[np.ndarray, "3 4"]:
    """Compute the matrix from world points to homogeneous pixels, whose third entry is z-depth."""
    world_to_camera = torch.linalg.inv(camera.c2w.double())[:3]
    projection: Float32[np.ndarray, "3 4"] = (camera.K.double() @ world_to_camera).float().numpy()
    return projection


def find_passages(
    views: Sequence[View], check_views: Sequence[View], depth: DepthMap, inverse: Map
) -> Passages:
    """Find the passages of a scene: its cameras, and others on the way to their neighbours.

    `depth`, in scene units, and `inverse` are those of the first view. There are none for up to two
    views, or without a near plane.
    """
    near = views[0].camera.near
    if len(views) <= 2 or near is None:
        return Passages()
    of_views = [view.camera.to("cpu") for view in views]
    cameras = [*of_views, *(view.camera.to("cpu") for view in check_views)]
    centers = torch.stack([camera.center for camera in cameras])
    # The nearest to each camera is itself.
    nearest = torch.cdist(centers, centers).argsort(dim=1, stable=True)[:, : PASSAGE_NEIGHBOURS + 1]
    pairs = {
        (min(number, other), max(number, other))
        for number, others in enumerate(nearest.tolist())
        for other in others
        if other != number
    }
    between = [
        interpolate_camera(cameras[first], cameras[second], share)
        for first, second in sorted(pairs)
        if float(cameras[first].c2w[:3, 2] @ cameras[second].c2w[:3, 2]) >= MIN_PASSAGE_COSINE
        for share in PASSAGE_SHARES
    ]
    # The same in all pixels but for rounding.
    unit = float((depth.depth.cpu() * torch.from_numpy(inverse)).median())
    return Passages([*cameras, *between], PASSAGE_DEPTH * near, of_views, unit)
