"""Choice of photographs: for the context, for checks and for the depth range."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.apps.inputs.task import Target
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.numerics.geometry import measure_distances, select_spread_cameras
from gscompleter.planning.select_context import make_points_in_front, select_context
from gscompleter.planning.select_overview import select_overview, summarize_cameras
from gscompleter.reconstructors.features.depth_range import estimate_depth_range
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import Camera

NUM_CONTEXT = 3
"""Number of context photographs if targets but no context are named (decision 030)."""
MAX_TARGET_CONTEXT = 8
"""Most of them if the scene is fitted jointly, with those near the targets first (decision 143)."""
TARGET_CONTEXT_SHARE = 1 / 2
"""Share of the photographs that they are at most: far ones gain nothing at the targets."""
NUM_CONTEXT_WITH_SPLAT = 8
"""Number of context photographs with an input splat. It is also the smallest number without one if
no targets are named either, so that the photographs have to show the whole scene (decision 030)."""
MAX_FITTED_CONTEXT = 24
"""Most photographs of a context that has to show the whole scene and is fitted jointly (decision
157)."""
FITTED_CONTEXT_SHARE = 3 / 4
"""Share of the photographs that it is at most: to some of the others it is fitted, too, and the
rest scores it."""
MAX_FITTED_PIXELS = 16 * 640 * 480
"""Most pixels of a context that is fitted jointly, for its time and memory; of large photographs
there are fewer."""
NUM_DEPTH_VIEWS = 6
"""Number of photographs from which a depth range is estimated."""
CHECK_VIEW_SIZE = 320
"""Longer side, in pixels, of check views and of the photographs for a depth range."""


def choose_check_size(resolution: tuple[int, int] | int | None) -> tuple[int, int] | int:
    """Choose the size of check views, which is that of the context if this is smaller.

    Ψ takes images of one size, so that check views are then evidence beside the context.
    """
    if resolution is None:
        return CHECK_VIEW_SIZE
    sides = resolution if isinstance(resolution, tuple) else (resolution,)
    return resolution if max(sides) <= CHECK_VIEW_SIZE else CHECK_VIEW_SIZE


def choose_context(
    photographs: Photographs,
    targets: Sequence[Target],
    resolution: Resolution,
    has_splat: bool,
    held_out: Sequence[int] = (),
    is_fitted: bool = False,
) -> tuple[int, ...]:
    """Choose context frames for the targets, or for the whole scene without any.

    `is_fitted` is True if Ψ makes the scene of them and fits it to all of them together.
    Targets and `held_out` are never chosen, because their photographs score the result, and neither
    are photographs of which a mask hides everything.
    """
    scoring = {*held_out, *(target.frame for target in targets)}
    others = [frame for frame in range(len(photographs)) if frame not in scoring]

    # Only chosen photographs are asked for their masks, since each has to be read for it.
    while True:
        chosen = _choose_frames(photographs, targets, others, resolution, has_splat, is_fitted)
        hidden = {frame for frame in chosen if photographs.is_hidden(frame)}
        if not hidden:
            return chosen
        others = [frame for frame in others if frame not in hidden]


def _choose_frames(
    photographs: Photographs,
    targets: Sequence[Target],
    others: Sequence[int],
    resolution: Resolution,
    has_splat: bool,
    is_fitted: bool,
) -> tuple[int, ...]:
    """Choose context frames among `others`, hidden by a mask or not."""
    cameras = collect_usable_cameras(photographs, others, resolution)
    if not cameras:
        raise InputError(explain_unusable(photographs, others, resolution))
    if len(cameras) == 1:
        return tuple(cameras)

    candidates = list(cameras.values())
    target_cameras = [target.camera for target in targets]

    # What a photograph shows is judged by points of the scene: those of COLMAP, or else points
    # that are spread in front of the cameras over the depth range.
    points = photographs.points()
    if points is None or len(points) == 0:
        goals = target_cameras or summarize_cameras(candidates)
        points = sample_scene_points(photographs, goals, cameras)

    # Without targets, medoids of all photographs with a partner each; with targets, photographs
    # that show what the targets see (decision 030).
    if not targets:
        count = NUM_CONTEXT_WITH_SPLAT
        if is_fitted:
            limit = limit_fitted_context(candidates, FITTED_CONTEXT_SHARE, MAX_FITTED_CONTEXT)
            count = max(count, limit)
        chosen = select_overview(candidates, points, count)
    else:
        count = NUM_CONTEXT_WITH_SPLAT if has_splat else NUM_CONTEXT
        if is_fitted:
            limit = limit_fitted_context(candidates, TARGET_CONTEXT_SHARE, MAX_TARGET_CONTEXT)
            count = max(NUM_CONTEXT, limit)
        chosen = select_context(target_cameras, candidates, points, count)
    frames = list(cameras)
    return tuple(frames[index] for index in chosen)


def limit_fitted_context(cameras: Sequence[Camera], share: float, most: int) -> int:
    """Limit the context of a scene that is fitted to the photographs at `cameras`.

    It is at most a `share` of these, and no more than `most`.
    """
    pixels = max(camera.width * camera.height for camera in cameras)
    return min(most, int(share * len(cameras)), MAX_FITTED_PIXELS // pixels)


def collect_usable_cameras(
    photographs: Photographs, frames: Sequence[int], resolution: Resolution
) -> dict[int, Camera]:
    """Return the cameras of frames that have a photograph, and leave out invalid ones."""
    cameras = {}
    for frame in frames:
        with suppress(InputError):
            if photographs.frame(frame).has_photograph():
                cameras[frame] = photographs.camera(frame, resolution)
    return cameras


def explain_unusable(
    photographs: Photographs, frames: Sequence[int], resolution: Resolution
) -> str:
    """Explain why none of the photographs at `frames` can be used."""
    if not frames:
        return (
            "The context needs photographs, and without the targets none is left; name fewer "
            "targets, or add photographs."
        )
    missing = [frame for frame in frames if not photographs.frame(frame).has_photograph()]
    reasons = []
    for frame in frames:
        if frame not in missing:
            try:
                photographs.camera(frame, resolution)
            except InputError as error:
                # Without the advice, which is the same for all, and what a library says.
                reasons.append(re.split(r"; | \(", str(error))[0])
    parts = []
    if missing:
        name = quote_value(photographs.frame(missing[0]).name)
        parts.append(f"{len(missing)} {'is' if len(missing) == 1 else 'are'} missing ({name})")
    if reasons:
        parts.append(f"{len(reasons)} cannot be read ({quote_value(reasons[0], 150)})")
    return (
        f"None of the {len(frames)} photographs of the context can be used: "
        f"{' and '.join(parts)}; copy the files again, or name others."
    )


def select_closest(
    targets: Sequence[Camera], cameras: Mapping[int, Camera], count: int
) -> list[int]:
    """Select the frames whose cameras are nearest to a target, in ascending order."""
    frames = list(cameras)
    nearest = measure_distances(list(cameras.values()), targets).argsort(stable=True)
    return sorted(frames[place] for place in nearest[:count].tolist())


def sample_scene_points(
    photographs: Photographs, targets: Sequence[Camera], cameras: dict[int, Camera]
) -> Float[Tensor, "n 3"]:
    """Sample points in front of the targets within the known or estimated depth range."""
    near = photographs.near
    far = photographs.far
    if near is None or far is None:
        # Small photographs near the targets: the range need not be exact to choose among cameras.
        closest = select_closest(targets, cameras, NUM_DEPTH_VIEWS)
        frames = [frame for frame in closest if not photographs.is_hidden(frame)]
        estimated_near, estimated_far = estimate_depth_range(
            photographs.views(frames, CHECK_VIEW_SIZE)
        )
        near = estimated_near if near is None else near
        far = estimated_far if far is None else far
    return torch.cat([make_points_in_front(target, near, far) for target in targets])


def select_near_and_far(
    wanted: Sequence[Camera], cameras: Mapping[int, Camera], count: int
) -> list[int]:
    """Select up to `count` frames: half nearest to `wanted`, the others spread over the rest."""
    # With the nearest alone, photographs from other sides get worse without being checked
    # (decision 020).
    near = select_closest(wanted, cameras, count if len(cameras) <= count else count // 2)
    rest = [frame for frame in cameras if frame not in near]
    if not rest:
        return near
    spread = select_spread_cameras([cameras[frame] for frame in rest], count - len(near))
    return sorted([*near, *(rest[index] for index in spread)])
