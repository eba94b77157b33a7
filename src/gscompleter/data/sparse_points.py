"""Between which depths a scene lies, as the sparse points of its reconstruction tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.data.framing import Resolution
from gscompleter.data.limits import DEPTH_RANGE
from gscompleter.data.photographs import Photographs
from gscompleter.types import Camera

MIN_POINTS = 100
"""Fewest points in the sight of the cameras that tell a depth range."""
PERCENTILES = (0.01, 0.99)
"""Of the points' z-depths: what lies beyond is taken for mismatched."""
NEAR_ROOM, FAR_ROOM = 0.5, 2.0
"""What the nearest and the farthest depth are multiplied by: much carries no point."""


def with_depth_range(
    photographs: Photographs, frames: Sequence[int], resolution: Resolution = None
) -> Photographs:
    """The photographs with the planes that their points tell, where they are not known.

    Args:
        photographs: With or without points.
        frames: Numbers of the frames whose cameras are to see the points.
        resolution: To which images are cropped or shrunk.

    Raises:
        InputError: where a frame does not exist or is impossible, or the points are damaged.
    """
    if photographs.near is not None and photographs.far is not None:
        return photographs
    points = photographs.points()
    if points is None:
        return photographs
    found = depth_range_of_points(points, [photographs.camera(f, resolution) for f in frames])
    near, far = found or (None, None)
    near = near if photographs.near is None else photographs.near
    far = far if photographs.far is None else photographs.far
    empty = near is not None and far is not None and near >= far
    return photographs if empty else replace(photographs, near=near, far=far)


def depth_range_of_points(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera]
) -> tuple[float, float] | None:
    """Near and far plane, in scene units, that enclose the points in sight of the cameras.

    Hidden points count too, which the percentiles bear. None where fewer than `MIN_POINTS` are in
    sight, or the range is impossible.
    """
    depths = torch.cat([torch.zeros(0), *(_depths_in_sight(points, c) for c in cameras)])
    if len(depths) < MIN_POINTS:
        return None
    low, high = np.quantile(depths.double().numpy(), PERCENTILES).tolist()
    near, far = with_room(low, high)
    return (near, far) if DEPTH_RANGE[0] <= near < far <= DEPTH_RANGE[1] else None


def with_room(nearest: float, farthest: float) -> tuple[float, float]:
    """Near and far plane around depths, in scene units, with room for what carries no point."""
    return NEAR_ROOM * nearest, FAR_ROOM * farthest


def _depths_in_sight(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "m"]:
    """The z-depths of the points that project into the image of a camera."""
    local = (points - camera.center) @ camera.c2w[:3, :3]
    front = local[local[:, 2] > 0]
    pixels = (front @ camera.K.T)[:, :2] / front[:, 2:]
    size = torch.tensor([camera.width, camera.height])
    return front[((pixels >= 0) & (pixels < size)).all(dim=1), 2]
