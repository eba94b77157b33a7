"""Places that a camera passed: nothing but what is measured stands right before them.

Surfaces that only one photograph shows continue those beside them, and may hang in the air where
other cameras were carried along. No photograph of the context sees through them there, but whoever
looks from such a place sees little else (decision 158).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gscompleter.numerics.geometry import interpolate_camera, is_inside, project
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

    def find_blocking(self, number: int, inverse: Map, mask: Mask) -> Mask:
        """Find the pixels in the mask of a view that stand right before a passage."""
        if not self.cameras:
            return np.zeros_like(mask)
        camera = self.of_views[number]
        rows, columns = np.nonzero(mask)
        depth = torch.from_numpy(self.unit / inverse[rows, columns]).to(camera.c2w)
        points = camera.center + depth[:, None] * camera.z_rays()[rows, columns]
        is_blocking = torch.zeros_like(depth, dtype=torch.bool)
        for passage in self.cameras:
            pixel, z = project(points, passage)
            is_blocking |= is_inside(pixel, z, passage) & (z < self.depth)
        blocking = mask.copy()
        blocking[rows, columns] = is_blocking.numpy(force=True)
        return blocking


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
    unit = float((depth.depth.cpu() * torch.from_numpy(inverse)).median())
    return Passages([*cameras, *between], PASSAGE_DEPTH * near, of_views, unit)
