"""Photographs of an opened scene as the input of a completion."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from gscompleter.apps.inputs.given_depth import DepthReading, read_with_depth
from gscompleter.apps.inputs.named_photographs import (
    PhotographNames,
    add_photograph,
    find_context,
    read_targets,
)
from gscompleter.apps.inputs.own_scene import join_photographs
from gscompleter.apps.inputs.selection import (
    choose_context,
    collect_usable_cameras,
    explain_unusable,
    select_closest,
)
from gscompleter.apps.inputs.task import CompletionTask, Opened, Target
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.data.points import add_depth_range
from gscompleter.numerics.geometry import select_spread_cameras
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.memory import check_memory
from gscompleter.types import Camera

MIN_IMAGE_SIZE = 16
"""Smallest side of an image, in pixels."""
MAX_FIT_VIEWS = 8
"""Most photographs beside the context to which a scene is fitted (decision 139)."""
MIN_FITTED_CONTEXT = 3
"""Fewest photographs of a context that is fitted to others, too."""


def read_task(
    opened: Opened,
    context: PhotographNames | None,
    target_words: Sequence[str],
    device: str,
    has_splat: bool,
    is_fitted: bool,
    own: Sequence[int] = (),
) -> CompletionTask:
    """Read the context and the targets, after checking the memory.

    A context that is not named is chosen. `has_splat` is True if an input splat is completed, and
    `is_fitted` if Ψ makes the scene and fits it to all photographs of the context together. From
    the frames `own` it made the splat, which it makes anew if that and the context are not too many
    photographs together.
    """
    photographs = opened.photographs
    resolution = opened.request.resolution
    targets = read_targets(photographs, target_words, resolution, has_splat)
    named = find_context(photographs, context)
    choose = partial(choose_context, photographs, targets, resolution, held_out=opened.held_out)
    scoring = {*opened.held_out, *(target.frame for target in targets)}
    joined: tuple[int, ...] = ()
    if own:
        chosen = named or choose(has_splat=False, is_fitted=True)
        joined = join_photographs(own, chosen, scoring, count_pixels(photographs, resolution))
    frames = joined or named or choose(has_splat=has_splat, is_fitted=is_fitted)

    # Cameras are enough to estimate the memory, before any photograph is loaded.
    cameras = [photographs.camera(frame, resolution) for frame in frames]
    cameras += [target.camera for target in targets]
    check_memory(max(camera.width * camera.height for camera in cameras), len(cameras))
    task = make_task(opened, frames, targets, device, has_splat)
    return replace(task, is_remade=len(joined) > 0)


def count_pixels(photographs: Photographs, resolution: Resolution) -> int:
    """Count the pixels of the first photograph at the working size."""
    camera = photographs.camera(0, resolution)
    return camera.width * camera.height


def add_fit_views(task: CompletionTask, opened: Opened) -> CompletionTask:
    """Add photographs to which the reconstructed scene is fitted besides the context.

    They are nearest to the targets, or spread over the scene, and as many photographs stay unused
    and score the result. What looks right from the context alone, such as shards before a wall, is
    wrong in others (decision 139). A task with a smaller context than `MIN_FITTED_CONTEXT`, or
    without photographs to spare, stays as it is.
    """
    if len(task.views) < MIN_FITTED_CONTEXT:
        return task
    photographs = opened.photographs
    resolution = opened.request.resolution
    known = task.used_frames | set(opened.held_out)
    others = [frame for frame in range(len(photographs)) if frame not in known]
    cameras = collect_usable_cameras(photographs, others, resolution)
    count = min(MAX_FIT_VIEWS, len(cameras) // 2)
    if count == 0:
        return task
    if task.targets:
        chosen = select_closest(task.goals, cameras, count)
    else:
        frames = list(cameras)
        chosen = [frames[index] for index in select_spread_cameras(list(cameras.values()), count)]
    views = []
    for frame in chosen:
        # One that is damaged or hidden by a mask tells nothing, and others do.
        with suppress(InputError):
            views += photographs.views([frame], resolution)
    return replace(task, check_views=[view.to(task.device) for view in views])


def read_photographs(
    opened: Opened, context: PhotographNames | None, device: str
) -> CompletionTask:
    """Read the named photographs of a splat, or all that can be used."""
    frames = find_context(opened.photographs, context)
    return make_task(opened, frames or find_usable_frames(opened), (), device, has_splat=True)


def find_usable_frames(opened: Opened) -> list[int]:
    """Find the photographs that have a camera and are not hidden by a mask.

    Raises:
        InputError: There is none.
    """
    photographs = opened.photographs
    resolution = opened.request.resolution
    numbers = range(len(photographs))
    cameras = collect_usable_cameras(photographs, numbers, resolution)
    if not cameras:
        raise InputError(explain_unusable(photographs, numbers, resolution))
    shown = [frame for frame in cameras if not photographs.is_hidden(frame)]
    if not shown:
        raise InputError(
            f"Masks hide all of each photograph of {quote_value(opened.request.folder)}; add "
            "--no-masks to use all pixels."
        )
    return shown


def make_task(
    opened: Opened,
    frames: Sequence[int],
    targets: Sequence[Target],
    device: str,
    has_splat: bool,
) -> CompletionTask:
    """Read the photographs of `frames`, sorted, and those of the targets."""
    frames = sorted(frames)
    request = opened.request
    photographs = opened.photographs
    resolution = request.resolution

    # `bounded` has the depth range of the request and the scene, or that of the sparse points that
    # the context sees. The targets were read before the context was known, so they get it here.
    bounded = add_depth_range(photographs, frames, resolution)
    bounded_targets = [
        replace(target, camera=replace(target.camera, near=bounded.near, far=bounded.far))
        for target in targets
    ]
    cameras = [bounded.camera(frame, resolution) for frame in frames]
    check_sizes([*cameras, *(target.camera for target in bounded_targets)])

    if request.uses_given_depth:
        scoring = {*opened.held_out, *(target.frame for target in bounded_targets)}
        read = read_with_depth(bounded, frames, resolution, scoring)
    else:
        read = DepthReading(bounded.views(frames, resolution))
    return CompletionTask(
        views=[view.to(device) for view in read.views],
        # Photographs of the targets score the result, and only the oracle generator sees them.
        targets=[add_photograph(target, bounded, resolution) for target in bounded_targets],
        frame=compute_frame_from_photographs(photographs.origin),
        origin=photographs.origin,
        depths=find_depth_sources(opened, bounded, has_splat),
        depth_notes=read.notes,
        predicted_depths=read.predicted,
    )


def check_sizes(cameras: Sequence[Camera]) -> None:
    """Refuse cameras whose images are too small."""
    for camera in cameras:
        if min(camera.width, camera.height) < MIN_IMAGE_SIZE:
            raise InputError(
                f"An image is {camera.width} x {camera.height} pixels, and both sides must have at "
                f"least {MIN_IMAGE_SIZE}; choose a larger --resolution, or another camera."
            )


def find_depth_sources(opened: Opened, bounded: Photographs, has_splat: bool) -> dict[str, str]:
    """Find the sources of `near` and `far`, as `CompletionTask.depths` names them.

    `bounded` are the photographs with what the sparse points tell of both.
    """
    estimate = "splat" if has_splat else "features"
    # In this order: each of them has what the one before it has, and may have more.
    sources = {"given": opened.request, "scene": opened.photographs, "points": bounded}
    source_by_name = {}
    for name in ("near", "far"):
        known = [source for source, value in sources.items() if getattr(value, name) is not None]
        source_by_name[name] = known[0] if known else estimate
    return source_by_name
