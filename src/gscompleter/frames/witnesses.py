"""The photographs that tell where a splat lies: a few, small, from all along the path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gscompleter.data.photographs import Photographs
from gscompleter.data.poses import pose_defect
from gscompleter.errors import InputError
from gscompleter.frames.trainers import Points, Poses
from gscompleter.matching.depth_range import estimate_depth_range
from gscompleter.types import View

COUNT = 8
"""Photographs that are looked at."""
LONG_SIDE = 320
"""Of them, in pixels: enough for features and for a blur of a pixel to be seen."""


def witnesses(photographs: Photographs, frames: Sequence[int]) -> list[View]:
    """The first of `frames`, which must be readable, and others spread over all photographs.

    A photograph that cannot be read is no witness, unless it is one of `frames`.

    Raises:
        InputError: where one of `frames` cannot be used.
    """
    named = list(frames)[: COUNT // 2]
    spread = np.linspace(0, len(photographs) - 1, COUNT).round().astype(int).tolist()
    others = [frame for frame in dict.fromkeys(spread) if frame not in named]
    views = photographs.views(named, LONG_SIDE)
    for frame in others[: COUNT - len(views)]:
        try:
            views += photographs.views([frame], LONG_SIDE)
        except InputError:
            continue
    return views


def usable_poses(photographs: Photographs) -> Poses:
    """Camera-to-world of all frames whose pose is one, told from the photographs' origin."""
    poses = [frame.c2w for frame in photographs.frames if pose_defect(frame.c2w) is None]
    told = np.stack(poses).astype(np.float64)
    told[:, :3, 3] -= photographs.origin
    return told


def rough_points(views: Sequence[View]) -> Points:
    """About where the scene lies, for photographs without sparse points: a grid before each.

    Its depth is the middle of what matched features tell.

    Raises:
        InputError: where they have no baseline.
    """
    near, far = estimate_depth_range(views)
    depth = float(np.sqrt(near * far))
    rays = [view.camera.z_rays()[::16, ::16].reshape(-1, 3) for view in views]
    pairs = zip(views, rays, strict=True)
    points = torch.cat([view.camera.center + depth * ray for view, ray in pairs])
    return points.double().cpu().numpy()
