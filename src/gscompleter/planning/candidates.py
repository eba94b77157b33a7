"""Candidate target cameras: moves of the photographs' cameras, as in ExploreGS.

Each camera is translated in six directions, turned in four, and moved on four orbits. Steps are so
short that most of what a candidate sees was observed; horizons stay as level as in photographs.
Around a trained splat, candidates only stand beside and between photographs, and look at the same
scene (`stays_beside`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.config import NextBestViewConfig
from gscompleter.numerics.geometry import (
    axis_angle_to_matrix,
    compute_field_of_view,
    embed_cameras,
    estimate_up,
    interpolate_camera,
    move_camera,
    project,
    resize_camera,
    unproject,
)
from gscompleter.types import Camera, Render

FREE_SPACE_MARGIN = 0.1
"""Least distance in front of a surface, relative to its depth, of a point in free space."""
MOVES_ASIDE = (0, 1, 10, 11)
"""Moves of `make_moves` to the right and left, straight and around what the camera looks at."""
TURNS_UP_AND_DOWN = (8, 9)
"""Moves of `make_moves` that stand still and look at the floor or the ceiling."""
MIN_SHOWN_SCENE = 0.05
"""Fraction of its image that must show the scene for a camera to have a known depth."""

MIN_LEVEL = 0.9
"""Least cosine of the angle between a level surface and the upward direction: 25 degrees."""
MIN_LEVEL_SHARE = 0.02
"""Least share of an image with level surfaces below the camera that tells where the ground is."""
DEEPER_SHARE = 0.25
"""Share of these surfaces that may lie deeper than the ground, as shards and wrong matches do. With
0.05 the ground before a castle was found at twice its depth, and cameras looked through grass."""


@dataclass(frozen=True)
class Candidate:
    """A camera that the scene may be completed for."""

    camera: Camera
    base: int
    """Index of the camera that it was derived from."""
    nearest: float
    """5 % quantile of the z-depths that the base camera sees, in scene units."""
    region: Bool[Tensor, "*size"] = torch.tensor(True)
    """Pixels of its small image that may be completed; all by default."""
    looks_up_or_down: bool = False
    """True for a turn up or down in place."""


def propose_candidates(
    bases: Sequence[Camera],
    renders: Sequence[Render],
    step: float,
    config: NextBestViewConfig = NextBestViewConfig(),
    stays_beside: bool = False,
) -> list[Candidate]:
    """Propose the moves of each base camera that end in free space, above the ground.

    `renders` show the scene at `bases`, at a small size. `step` is the longest move in scene units,
    0 if unknown. With `stays_beside`, cameras move aside or halfway to the most similar base only.
    """
    depths = compute_depth_quantiles(renders, 0.5)
    nearest = compute_depth_quantiles(renders, 0.05)
    up = estimate_up(bases)
    # The base that is most similar to each: the second of the sorted ones, since the first is the
    # camera itself. Of a single base there is no second, and the list stays empty.
    places = embed_cameras(bases)
    similar = torch.cdist(places, places).argsort(dim=1)[:, 1:2].tolist()

    candidates = []
    for index, (base, depth) in enumerate(zip(bases, depths, strict=True)):
        # At most a fraction of the depth, or else a step would leave all that the photograph shows.
        longest = config.max_step * depth
        length = min(step, longest) if step > 0 else longest
        moved = make_moves(base, depth, length, config.yaw_fraction, up)
        if stays_beside:
            between = [interpolate_camera(base, bases[other], 0.5) for other in similar[index]]
            moved = [*(moved[move] for move in MOVES_ASIDE), *between]
        candidates += [
            Candidate(
                camera,
                index,
                nearest[index],
                looks_up_or_down=not stays_beside and move in TURNS_UP_AND_DOWN,
            )
            for move, camera in enumerate(moved)
        ]

    small = [
        resize_camera(base, *render.alpha.T.shape)
        for base, render in zip(bases, renders, strict=True)
    ]
    # Photographs see no ground below themselves, so that it is no surface before a move down.
    grounds = [
        find_ground_height(camera, render, up)
        for camera, render in zip(small, renders, strict=True)
    ]
    lowest = [
        -torch.inf if ground is None else (1 - config.clearance) * ground for ground in grounds
    ]
    return [
        candidate
        for candidate in candidates
        if is_in_free_space(candidate.camera.center, small, renders)
        and (candidate.camera.center - bases[candidate.base].center) @ up >= lowest[candidate.base]
    ]


def make_moves(
    camera: Camera, depth: float, step: float, turn: float, up: Float[Tensor, "3"]
) -> list[Camera]:
    """Make fourteen cameras one move away from `camera`.

    `depth` (of the viewed point) and `step` are in scene units; `turn` is a fraction of the field
    of view; `up` is the unit axis of turns to the side.
    """
    # The order is that of `MOVES_ASIDE`: right, left, down, up, forward, back; four turns in place;
    # then four orbits about the point that the camera looks at.
    axes = camera.c2w[:3, :3].T
    shifts = [sign * step * axis for axis in axes for sign in (1, -1)]
    translated = [move_camera(camera, torch.eye(3).to(up), shift) for shift in shifts]
    ahead = camera.center + depth * camera.forward
    wide, high = compute_field_of_view(camera)
    return [
        *translated,
        *orbit_camera(camera, camera.center, (turn * wide, turn * high), up),
        *orbit_camera(camera, ahead, (step / depth, step / depth), up),
    ]


def orbit_camera(
    camera: Camera, pivot: Float[Tensor, "3"], angles: tuple[float, float], up: Float[Tensor, "3"]
) -> list[Camera]:
    """Turn a camera about `pivot`, both ways: about `up`, and about its own x axis.

    `angles`, in radians, are those of the two axes.
    """
    # About `up` instead of the camera's own y axis, which keeps the horizon level.
    axes = (up, camera.c2w[:3, 0])
    arm = camera.center - pivot
    turns = [
        axis_angle_to_matrix(axis, sign * angle)
        for axis, angle in zip(axes, angles, strict=True)
        for sign in (1, -1)
    ]
    return [move_camera(camera, turn, turn @ arm - arm) for turn in turns]


def is_in_free_space(
    point: Float[Tensor, "3"], cameras: Sequence[Camera], renders: Sequence[Render]
) -> bool:
    """Return True if a photograph sees through a point, or if none has a surface at or before it.

    One photograph that sees through it outweighs others that do not: to them it may be hidden.
    `renders` show the scene at `cameras` and have their sizes. Only surfaces count: a hole, and
    what is outside of an image, says nothing.
    """
    is_hidden = False
    for camera, render in zip(cameras, renders, strict=True):
        pixel, z = project(point, camera)
        # Clamped, since a point beside the camera has infinite coordinates.
        x, y = (int(value) for value in pixel.clamp(-1, 1e6).floor())
        if z <= 0 or not (0 <= x < camera.width and 0 <= y < camera.height):
            continue
        surface = render.depth_map()
        if not surface.valid[y, x]:
            continue
        if z < (1 - FREE_SPACE_MARGIN) * surface.depth[y, x]:
            return True
        is_hidden = True
    return not is_hidden


def find_ground_height(camera: Camera, render: Render, up: Float[Tensor, "3"]) -> float | None:
    """Find the height of the ground that a camera sees, relative to the camera, in scene units.

    It is negative, and that of the lower level surfaces below the camera. `up` is a unit vector.
    Returns None if the image shows too little of any.
    """
    seen = render.depth_map()
    points = unproject(seen.depth, camera)
    corner = points[:-1, :-1]
    normals = normalize(
        torch.linalg.cross(points[:-1, 1:] - corner, points[1:, :-1] - corner), dim=-1
    )
    heights = (corner - camera.center) @ up
    is_level = (normals @ up).abs() >= MIN_LEVEL
    has_depth = seen.valid[:-1, :-1] & seen.valid[:-1, 1:] & seen.valid[1:, :-1]
    is_ground = is_level & has_depth & (heights < 0)
    if is_ground.float().mean().item() < MIN_LEVEL_SHARE:
        return None
    return heights[is_ground].quantile(DEEPER_SHARE).item()


def is_close(render: Render, nearest: float, config: NextBestViewConfig) -> bool:
    """Return True if surfaces much closer than `nearest` (z-depth) fill too much of an image."""
    seen = render.depth_map()
    near = seen.valid & (seen.depth < config.clearance * nearest)
    return near.float().mean().item() > config.max_close


def compute_depth_quantiles(renders: Sequence[Render], share: float) -> list[float]:
    """Compute the quantile at `share` in [0, 1] of the z-depths in each render, in scene units.

    A render that shows hardly anything of the scene gets the quantile over all renders.
    """
    valid = [render.depth_map().valid for render in renders]
    depths = [render.depth[mask] for render, mask in zip(renders, valid, strict=True)]
    if sum(len(values) for values in depths) == 0:
        raise ValueError("no camera sees the scene, so its distance is unknown")
    usual = torch.cat(depths).quantile(share).item()
    return [
        values.quantile(share).item() if mask.float().mean().item() >= MIN_SHOWN_SCENE else usual
        for values, mask in zip(depths, valid, strict=True)
    ]
