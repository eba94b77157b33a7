"""Update of a splat by its photographs: a completion without targets that looks at all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rich.console import Console

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.update import UpdateOptions
from gscompleter.apps.completing.complete import complete_scene
from gscompleter.apps.completing.preparation import (
    Prepared,
    check_options,
    collect_cameras,
    compute_view_transform,
    load_models,
    open_for_completion,
    read_inputs,
    use_predicted_depth,
)
from gscompleter.apps.inputs.depth_range import apply_splat_range
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.inputs.named_photographs import find_context
from gscompleter.apps.inputs.reading import make_task
from gscompleter.apps.inputs.selection import CHECK_VIEW_SIZE, collect_usable_cameras
from gscompleter.apps.inputs.splat import add_check_views
from gscompleter.apps.inputs.taken_out import hide_taken_out
from gscompleter.apps.inputs.task import Opened
from gscompleter.config import CompleterConfig
from gscompleter.data.formats import find_format
from gscompleter.data.sfm.placing import place_photographs
from gscompleter.planning.planner import ViewPlanner
from gscompleter.splats.alignment.similarity import transform_view
from gscompleter.stages.add_observed import MIN_SHARE, find_lacks
from gscompleter.system.errors import InputError
from gscompleter.system.files.output_folder import POSES, refuse_link
from gscompleter.system.progress import show_preparation, track

MAX_LACKING = 16
"""Most photographs of SCENE that join the context because they show what the splat lacks; of more,
those that show most."""
MIN_LEFT = 2
"""Fewest photographs that are not kept back."""


@dataclass(frozen=True)
class PreparedUpdate(Prepared):
    """A completion without targets, with the options of the update."""

    update: UpdateOptions

    def describe_settings(self) -> dict[str, Any]:
        """Describe the settings, with the new photographs and those that are kept back."""
        photos = self.update.photos
        return {
            **super().describe_settings(),
            "photos": None if photos is None else str(photos),
            "hold_out": self.update.hold_out,
        }


def update_splat(options: UpdateOptions) -> int:
    """Update the splat, print a summary, and return the exit code."""
    return complete_scene(options.make_completion(), partial(prepare_update, options))


def prepare_update(
    update: UpdateOptions, options: CompleteOptions, console: Console
) -> PreparedUpdate:
    """Open the scene with new photographs, and choose those that show what the splat lacks."""
    options = check_options(options)
    # Cameras for all of SCENE would be searched for minutes, in the folder meant for the new ones.
    if update.photos is not None and (update.format or find_format(update.folder)) is None:
        raise InputError(
            "SCENE has no cameras to place new photographs among; put all photographs into one "
            "folder, whose cameras are found together.",
            "photos",
        )
    opened = open_for_completion(options, console)
    num_known = len(opened.photographs)
    if update.photos is not None:
        opened = add_new_photographs(update, opened, console)
    new = list(range(num_known, len(opened.photographs)))
    opened = hold_out(opened, update, new)

    task = read_inputs(options, opened)
    ready = load_models(options, opened, task, console)
    ready = choose_evidence(ready, new)
    return PreparedUpdate(**vars(ready), update=update)


def add_new_photographs(update: UpdateOptions, opened: Opened, console: Console) -> Opened:
    """Place new photographs among those of the scene, and add them."""
    assert update.photos is not None
    kept = update.out / POSES
    refuse_link(kept)
    photographs, placed = place_photographs(
        update.photos, opened.photographs, kept, update.overwrite, opened.request.masks
    )
    print_lines(console, *placed.notes)
    photographs = replace(photographs, notes=(*photographs.notes, *placed.notes))
    return replace(
        opened,
        photographs=photographs,
        num_photographs=opened.num_photographs + placed.total,
    )


def hold_out(opened: Opened, update: UpdateOptions, new: Sequence[int]) -> Opened:
    """Keep back as many photographs as the options ask for, at even steps."""
    count = update.hold_out
    if count == 0:
        return opened
    photographs = opened.photographs
    named = find_context(photographs, update.context)
    resolution = opened.request.resolution
    usable = list(collect_usable_cameras(photographs, range(len(photographs)), resolution))
    # New photographs are what the update is judged by; of others the splat may have been trained
    # on all.
    candidates = [frame for frame in new or usable if frame in usable and frame not in named]
    if count > len(candidates) or len(usable) - count < MIN_LEFT:
        raise InputError(
            f"{count} photographs cannot be kept back: there are {len(candidates)} to choose from, "
            f"and at least {MIN_LEFT} of {len(usable)} have to be left; name a smaller number.",
            "hold-out",
        )
    steps = [(2 * number + 1) * len(candidates) // (2 * count) for number in range(count)]
    return replace(opened, held_out=tuple(candidates[step] for step in steps))


def choose_evidence(ready: Prepared, new: Sequence[int]) -> Prepared:
    """Add new photographs to the context, and photographs that show what the splat lacks.

    A context is chosen to overlook the scene, and what it leaves out only checks, at a low
    resolution. A context that the user named only gets the new photographs.
    """
    task = ready.task
    opened = ready.opened
    frames = set(task.context_frames)
    frames.update(frame for frame in new if frame not in opened.held_out)
    if ready.options.context is None:
        shares = measure_lacks(ready)
        lacking = [frame for frame, share in shares.items() if share >= MIN_SHARE]
        lacking.sort(key=lambda frame: -shares[frame])
        frames.update(lacking[:MAX_LACKING])
    if frames == set(task.context_frames):
        return ready

    with show_preparation("reading photographs"):
        read = add_check_views(
            make_task(opened, sorted(frames), (), task.device.type, True), opened
        )
    transform = compute_view_transform(opened, task)
    task = replace(
        task,
        views=[transform_view(view, transform) for view in read.views],
        check_views=[transform_view(view, transform) for view in read.check_views or ()],
        depth_notes=read.depth_notes,
        predicted_depths=read.predicted_depths,
    )
    assert task.scene is not None
    task = apply_splat_range(task, task.scene, ready.completer.renderer)
    task = hide_taken_out(task)
    completer, task = use_predicted_depth(ready.options, ready.completer, task)
    return replace(
        ready,
        task=task,
        explorer=ViewPlanner(completer),
        cameras=collect_cameras(opened, task),
    )


def measure_lacks(ready: Prepared) -> dict[int, float]:
    """Measure the share of each photograph that the splat lacks, in small images, by frame."""
    opened = ready.opened.with_resolution(CHECK_VIEW_SIZE)
    task = ready.task
    scene = task.scene
    assert scene is not None
    cameras = collect_cameras(opened, task)
    checks = {view.frame: view for view in task.check_views or ()}
    frames = []
    views = []
    renders = []
    for frame in track(list(cameras), "Comparing photographs"):
        if frame in opened.held_out or opened.photographs.is_hidden(frame):
            continue
        # Check views have this size, and are in memory.
        if frame in checks:
            view = checks[frame]
        else:
            (view,) = opened.photographs.views([frame], CHECK_VIEW_SIZE)
        # A view refuses an image and a camera on two devices, and cameras are on that of the task.
        view = replace(view.to(task.device), camera=cameras[frame])
        if task.taken_out is not None:
            view = task.taken_out.hide(view)
        frames.append(frame)
        views.append(view)
        renders.append(ready.completer.renderer.render(scene, view.camera))
    config = ready.completer.config or CompleterConfig.splat()
    lacks = find_lacks(views, renders, config.holes)
    return {frame: lack.share for frame, lack in zip(frames, lacks, strict=True)}
