"""The way of a film's camera: from stop to stop along the photographs, smooth, its horizon level.

Between two targets that stand far apart a straight line may lead through what is looked at; where
photographs were taken there is room, and the scene looks best.
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

from gscompleter.metrics.coverage import interpolated
from gscompleter.stages.candidates import places, upward
from gscompleter.types import Camera

WINDOW = 0.15
"""Share of the frames of a leg, to either side, that corners are rounded over."""
ABOUT_UP = 1e-3
"""How much the top of the images counts for what is up, against that their rows are level."""
ROUGHLY = 0.7
"""Cosine of the angle within which images of photographs that are not turned show it there."""
STEEP = 0.99
"""Cosine of the angle to what is up, from which on a camera has no horizon to keep level."""


def path_through(
    stops: Sequence[Camera], photographs: Sequence[Camera], count: int
) -> list[Camera]:
    """The cameras of a way that slows down at each stop.

    Args:
        stops: Where it comes by, in this order; at least two.
        photographs: Cameras that it may come by, too.
        count: Frames from one stop to the next.
    """
    up = vertical([*stops, *photographs])
    legs = [leg(a, b, photographs, up, count) for a, b in pairwise(stops)]
    return [*(camera for each in legs for camera in each[:-1]), stops[-1]]


def leg(
    first: Camera,
    second: Camera,
    photographs: Sequence[Camera],
    up: Float[Tensor, "3"],
    count: int,
) -> list[Camera]:
    """`count` cameras from `first` on, and `second`."""
    way = waypoints(first, second, photographs)
    sharp = [at(way, smoothstep(k / count)) for k in range(count + 1)]
    widths = [min(k, count - k, round(WINDOW * count)) for k in range(count + 1)]
    rounded = [mean(sharp[k - width : k + width + 1]) for k, width in enumerate(widths)]
    if max(abs((camera.forward @ up).item()) for camera in rounded) > STEEP:
        return rounded
    start = roll(first, up)
    turn = math.remainder(roll(second, up) - start, 2 * math.pi)
    return [rolled(c, start + turn * k / count, up) for k, c in enumerate(rounded)]


def vertical(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """The direction to which the rows of the images are most nearly square, upwards, of length 1.
    Level cameras tell it exactly, however far they look up or down."""
    about = upward(cameras).double()
    axes = torch.stack([camera.c2w[:3, :2].T for camera in cameras]).double()
    rows = axes[-axes[:, 1] @ about > ROUGHLY, 0]
    # Where all look the same way, several directions are square to the rows.
    slant = rows.T @ rows / len(rows) - ABOUT_UP * torch.outer(about, about)
    axis = torch.linalg.eigh(slant).eigenvectors[:, 0]
    return (axis if axis @ about > 0 else -axis).to(cameras[0].c2w)


def waypoints(first: Camera, second: Camera, photographs: Sequence[Camera]) -> list[Camera]:
    """`first`, photographs on the way and `second`: of all ways the one with the least sum of
    squared steps, which takes many short ones. All see as `first` does."""
    # Here, so that what shows no film does not wait for it.
    from scipy.sparse.csgraph import shortest_path

    cameras = [first, *photographs, second]
    where = places(cameras).double().cpu()
    squares = (where[:, None] - where).square().sum(dim=-1).numpy()
    _, before = shortest_path(squares, indices=0, return_predecessors=True)
    way, number = [second], before[-1]
    while number > 0:
        way.append(replace(first, c2w=cameras[number].c2w.to(first.c2w)))
        number = before[number]
    return [first, *way[::-1]]


def at(way: Sequence[Camera], share: float) -> Camera:
    """The camera after a share of the way, by its length."""
    where = places(way).double().cpu()
    ends = np.concatenate([[0.0], np.cumsum((where[1:] - where[:-1]).norm(dim=1).numpy())])
    done = share * ends[-1]
    number = min(int(np.searchsorted(ends, done, side="right")), len(way) - 1)
    length = max(ends[number] - ends[number - 1], 1e-30)
    return interpolated(way[number - 1], way[number], float((done - ends[number - 1]) / length))


def smoothstep(share: float) -> float:
    """From 0 to 1, at rest at both ends."""
    return share * share * (3 - 2 * share)


def mean(cameras: Sequence[Camera]) -> Camera:
    """The camera amidst several that stand and look about alike."""
    if len(cameras) == 1:
        return cameras[0]
    c2w = torch.stack([camera.c2w for camera in cameras]).double().mean(dim=0)
    left, _, right = torch.linalg.svd(c2w[:3, :3])
    c2w[:3, :3] = left @ right
    return replace(cameras[0], c2w=c2w.to(cameras[0].c2w))


def level(camera: Camera, up: Float[Tensor, "3"]) -> tuple[Tensor, Tensor]:
    """Right [3] and down [3] of a camera that looks the same way and keeps its horizon level."""
    right = normalize(torch.linalg.cross(camera.forward, up), dim=0)
    return right, torch.linalg.cross(camera.forward, right)


def roll(camera: Camera, up: Float[Tensor, "3"]) -> float:
    """By how many radians a camera is turned about what it looks at, away from level."""
    right, down = level(camera, up)
    across = camera.c2w[:3, 0]
    return math.atan2((across @ down).item(), (across @ right).item())


def rolled(camera: Camera, angle: float, up: Float[Tensor, "3"]) -> Camera:
    """`camera` with another roll, in radians."""
    right, down = level(camera, up)
    cos, sin = math.cos(angle), math.sin(angle)
    c2w = camera.c2w.clone()
    c2w[:3, 0], c2w[:3, 1] = cos * right + sin * down, cos * down - sin * right
    return replace(camera, c2w=c2w)
