"""Sample photographs for the alignment: a few, small, spread along the path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gscompleter.data.cameras import find_pose_defect
from gscompleter.data.photographs import Photographs
from gscompleter.errors import InputError
from gscompleter.reconstructors.features.depth_range import estimate_depth_range
from gscompleter.splat_alignment.trainer_frames import Points, Poses
from gscompleter.types import View

NUM_SAMPLE_VIEWS = 8
"""Number of sample photographs."""
LONG_SIDE = 320
"""Their longer side in pixels: enough for features and for a blur of one pixel."""


def sample_views(photographs: Photographs, frames: Sequence[int]) -> list[View]:
    """Load the first of `frames` and further photographs spread over all.

    Raises:
        InputError: One of `frames` cannot be read; other unreadable photographs are skipped.
    """
    named = list(frames)[: NUM_SAMPLE_VIEWS // 2]
    spread = np.linspace(0, len(photographs) - 1, NUM_SAMPLE_VIEWS).round().astype(int).tolist()
    others = [frame for frame in dict.fromkeys(spread) if frame not in named]
    views = photographs.views(named, LONG_SIDE)
    for frame in others[: NUM_SAMPLE_VIEWS - len(views)]:
        try:
            views += photographs.views([frame], LONG_SIDE)
        except InputError:
            continue
    return views


def collect_poses(photographs: Photographs) -> Poses:
    """Collect the valid camera-to-world poses, relative to the photographs' origin."""
    poses = [frame.c2w for frame in photographs.frames if find_pose_defect(frame.c2w) is None]
    shifted = np.stack(poses).astype(np.float64)
    shifted[:, :3, 3] -= photographs.origin
    return shifted


def estimate_points(views: Sequence[View]) -> Points:
    """Estimate scene points without a sparse cloud: a grid at the median depth of each view."""
    near, far = estimate_depth_range(views)
    depth = float(np.sqrt(near * far))
    rays = [view.camera.z_rays()[::16, ::16].reshape(-1, 3) for view in views]
    pairs = zip(views, rays, strict=True)
    points = torch.cat([view.camera.center + depth * ray for view, ray in pairs])
    return points.double().cpu().numpy()
