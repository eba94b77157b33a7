"""The camera path of a video: smooth, near the photographs, with a level horizon.

A straight line between distant targets may pass through surfaces. Around the photographs
there is free space, and the scene is sharpest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.evaluation.metrics.coverage import interpolate_camera
from gscompleter.geometry import embed_cameras, estimate_up
from gscompleter.types import Camera

SMOOTHING_FRACTION = 0.15
"""Half width of the smoothing window, as a fraction of a leg."""
UP_WEIGHT = 1e-3
"""Weight of the image's up direction against level image rows."""
MIN_UPRIGHT_COSINE = 0.7
"""Cosine limit between a camera's up direction and the mean for cameras held upright."""
MAX_LEVEL_COSINE = 0.99
"""Cosine to the vertical above which a camera has no horizon."""


def plan_camera_path(
    stops: Sequence[Camera], photographs: Sequence[Camera], count: int
) -> list[Camera]:
    """Plan a path through two or more stops, with `count` frames from one to the next.

    It slows down at each stop and may pass the photographs.
    """
    up = fit_vertical([*stops, *photographs])
    legs = [plan_leg(a, b, photographs, up, count) for a, b in pairwise(stops)]
    return [*(camera for each in legs for camera in each[:-1]), stops[-1]]


def plan_leg(
    first: Camera,
    second: Camera,
    photographs: Sequence[Camera],
    up: Float[Tensor, "3"],
    count: int,
) -> list[Camera]:
    """Plan `count` cameras from `first` on, and `second`."""
    way = find_waypoints(first, second, photographs)
    sharp = [interpolate_path(way, ease_in_out(k / count)) for k in range(count + 1)]
    widths = [min(k, count - k, round(SMOOTHING_FRACTION * count)) for k in range(count + 1)]
    rounded = [average_cameras(sharp[k - width : k + width + 1]) for k, width in enumerate(widths)]
    if max(abs((camera.forward @ up).item()) for camera in rounded) > MAX_LEVEL_COSINE:
        return rounded
    start = measure_roll(first, up)
    turn = math.remainder(measure_roll(second, up) - start, 2 * math.pi)
    return [set_roll(c, start + turn * k / count, up) for k, c in enumerate(rounded)]


def fit_vertical(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """Estimate the unit up direction, to which image rows of level cameras are orthogonal."""
    about = estimate_up(cameras).double()
    axes = torch.stack([camera.c2w[:3, :2].T for camera in cameras]).double()
    rows = axes[-axes[:, 1] @ about > MIN_UPRIGHT_COSINE, 0]
    # If all cameras have the same direction, several axes are orthogonal to the rows.
    slant = rows.T @ rows / len(rows) - UP_WEIGHT * torch.outer(about, about)
    axis = torch.linalg.eigh(slant).eigenvectors[:, 0]
    return (axis if axis @ about > 0 else -axis).to(cameras[0].c2w)


def find_waypoints(first: Camera, second: Camera, photographs: Sequence[Camera]) -> list[Camera]:
    """Find the path along photographs with the smallest sum of squared steps.

    It prefers many short steps. All cameras get the intrinsics of `first`.
    """
    # Imported here, since SciPy is slow to import and only videos need it.
    from scipy.sparse.csgraph import shortest_path

    cameras = [first, *photographs, second]
    where = embed_cameras(cameras).double().cpu()
    squares = (where[:, None] - where).square().sum(dim=-1).numpy()
    _, before = shortest_path(squares, indices=0, return_predecessors=True)
    way, number = [second], before[-1]
    while number > 0:
        way.append(replace(first, c2w=cameras[number].c2w.to(first.c2w)))
        number = before[number]
    return [first, *way[::-1]]


def interpolate_path(way: Sequence[Camera], share: float) -> Camera:
    """Interpolate the path at a fraction of its length."""
    where = embed_cameras(way).double().cpu()
    ends = np.concatenate([[0.0], np.cumsum((where[1:] - where[:-1]).norm(dim=1).numpy())])
    done = share * ends[-1]
    number = min(int(np.searchsorted(ends, done, side="right")), len(way) - 1)
    length = max(ends[number] - ends[number - 1], 1e-30)
    return interpolate_camera(
        way[number - 1], way[number], float((done - ends[number - 1]) / length)
    )


def ease_in_out(share: float) -> float:
    """Ease from 0 to 1 with zero speed at both ends."""
    return share * share * (3 - 2 * share)


def average_cameras(cameras: Sequence[Camera]) -> Camera:
    """Average cameras that are close to each other."""
    if len(cameras) == 1:
        return cameras[0]
    c2w = torch.stack([camera.c2w for camera in cameras]).double().mean(dim=0)
    left, _, right = torch.linalg.svd(c2w[:3, :3])
    c2w[:3, :3] = left @ right
    return replace(cameras[0], c2w=c2w.to(cameras[0].c2w))


def compute_level_axes(camera: Camera, up: Float[Tensor, "3"]) -> tuple[Tensor, Tensor]:
    """Compute the right [3] and down [3] axes of a level camera with the same direction."""
    right = normalize(torch.linalg.cross(camera.forward, up), dim=0)
    return right, torch.linalg.cross(camera.forward, right)


def measure_roll(camera: Camera, up: Float[Tensor, "3"]) -> float:
    """Measure the rotation about the viewing direction, in radians from level."""
    right, down = compute_level_axes(camera, up)
    across = camera.c2w[:3, 0]
    return math.atan2((across @ down).item(), (across @ right).item())


def set_roll(camera: Camera, angle: float, up: Float[Tensor, "3"]) -> Camera:
    """Set the roll of a camera, in radians."""
    right, down = compute_level_axes(camera, up)
    cos, sin = math.cos(angle), math.sin(angle)
    c2w = camera.c2w.clone()
    c2w[:3, 0], c2w[:3, 1] = cos * right + sin * down, cos * down - sin * right
    return replace(camera, c2w=c2w)
