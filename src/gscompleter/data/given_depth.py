"""Depth that a scene holds, given to its photographs: depth maps, laser sweeps, COLMAP's points.

Nothing that is scored may be given, so `evaluate` never does this.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.frame import Frame
from gscompleter.numerics.geometry import compute_sparse_depth
from gscompleter.types import View

EDGE_SHARE = 1 / 128
"""Half the window around a pixel of a depth map, relative to the longer side."""
EDGE_RATIO = 1.1
"""Depth ratio in it from which a pixel lies at an edge, where sensor and photograph disagree."""
GAP_SHARE = 1 / 64
"""The same window around a laser point."""
GAP_RATIO = 1.2
"""Depth ratio from which a nearer laser point hides another."""


def give_depth(view: View, frame: Frame, origin: Float[np.ndarray, "3"]) -> View:
    """Give a photograph its depth map or laser points, and the triangulated points beside them."""
    # Tracks of this photograph alone: of the scene's points, surfaces may hide some from it.
    sparse = project_tracks(frame, view, origin)
    if view.depth is not None:
        sure = drop_unsure(view.depth, frame)
        # A measurement of the sensor is denser than tracks, and wins where both are known.
        sparse = sure.where(sure > 0, sparse)
    # A point that a mask hides may lie behind what the mask hides it with.
    return replace(view, depth=None, given_depth=sparse.where(view.valid_mask, 0.0))


def project_tracks(
    frame: Frame,
    view: View,
    origin: Float[np.ndarray, "3"],
    points: Float[Tensor, "n 3"] | None = None,
) -> Float[Tensor, "h w"]:
    """Project the triangulated points that a photograph shows to its z-depths, 0 between them.

    Without a list of those, `points` of the scene (relative to `origin`) take their place, of which
    surfaces may hide some; none if there are none.
    """
    if frame.seen_points is not None:
        points = torch.from_numpy(frame.seen_points() - origin).float()
    if points is None:
        return torch.zeros_like(view.image[..., 0])
    return compute_sparse_depth(points, view.camera)


def drop_unsure(depth: Float[Tensor, "h w"], frame: Frame) -> Float[Tensor, "h w"]:
    """Set the measured depth of a frame to 0 where sensor and photograph may see two surfaces."""
    is_sweep = frame.depth is None and frame.laser_points is not None
    return drop_hidden(depth) if is_sweep else drop_edges(depth)


def drop_edges(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Set a depth map to 0 at its edges."""
    nearest, farthest = find_extremes(depth, EDGE_SHARE)
    return depth.where(farthest < EDGE_RATIO * nearest, 0.0)


def drop_hidden(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Set sparse depths to 0 where a nearer surface lies beside them; a laser sees past it."""
    return depth.where(depth < GAP_RATIO * find_extremes(depth, GAP_SHARE)[0], 0.0)


def find_extremes(
    depth: Float[Tensor, "h w"], share: float
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Find the nearest and the farthest known depth around each pixel."""
    values = depth.numpy()
    window = np.ones((2 * max(1, round(share * max(values.shape))) + 1,) * 2, np.uint8)
    # Unknown pixels are 0: infinite for the nearest depth, and smallest for the farthest.
    known = np.where(values > 0, values, np.float32(np.inf))
    return torch.from_numpy(cv2.erode(known, window)), torch.from_numpy(cv2.dilate(values, window))
