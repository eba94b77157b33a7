"""Update of a splat by its photographs: a completion without targets that looks at all of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from rich.console import Console

from gscompleter.apps.completing.preparation import (
    Loaded,
    check_models,
    collect_cameras,
    compute_view_transform,
    load_models,
    make_prepared,
    open_for_completion,
    read_geometry,
    read_opened,
    use_predicted_depth,
)
from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.inputs.depth_range import apply_scene_range, apply_splat_range
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.inputs.earlier_work import mark_earlier_work
from gscompleter.apps.inputs.named_photographs import find_context
from gscompleter.apps.inputs.own_scene import find_own_photographs, join_photographs
from gscompleter.apps.inputs.reading import count_pixels, make_task
from gscompleter.apps.inputs.selection import choose_check_size, collect_usable_cameras
from gscompleter.apps.inputs.splat import add_check_views, read_check_view
from gscompleter.apps.inputs.taken_out import hide_taken_out
from gscompleter.apps.inputs.task import Opened
from gscompleter.apps.requests.completion import (
    ResultsRequest,
    TargetRequest,
    UpdateRequest,
    WorkRequest,
)
from gscompleter.apps.requests.scene import Names
from gscompleter.config import CompleterConfig
from gscompleter.data.formats import find_format
from gscompleter.data.sfm.placing import place_photographs
from gscompleter.numerics.geometry import embed_cameras, select_apart
from gscompleter.splats.alignment.similarity import transform_view
from gscompleter.splats.edits import read_edits
from gscompleter.stages.add_observed import MIN_ADDED_SHARE, find_lacks, limit_part_photos
from gscompleter.system.errors import InputError
from gscompleter.system.files.output_folder import FOUND_POSES_FOLDER, refuse_link
from gscompleter.system.progress import show_preparation, track
from gscompleter.types import Camera

MAX_LACKING = 16
"""Most photographs of SCENE that join the context because they show what the splat lacks; of more,
those that lack most and stand apart. New ones, and those of the context, do not count."""
MIN_LEFT = 2
"""Fewest usable photographs that `--hold-out` has to leave."""
NO_TARGETS = TargetRequest(max_found=0)
"""An update looks at photographs alone."""


def prepare_update(request: UpdateRequest, console: Console) -> Prepared:
    """Open the scene with new photographs, and choose those that show what the splat lacks."""
    work = request.work
    source = request.source
    check_models(work)
    geometry = read_geometry(work)
    # Cameras for all of SCENE would be searched for minutes, in the folder meant for the new ones.
    scene = source.scene
    if request.photos is not None and (scene.format or find_format(scene.folder)) is None:
        raise InputError(
            "SCENE has no cameras to place new photographs among; put all photographs into one "
            "folder, whose cameras are found together.",
            "photos",
        )
    opened = open_for_completion(work, source, NO_TARGETS, console)
    num_known = len(opened.photographs)
    if request.photos is not None:
        opened = add_new_photographs(request.photos, request.results, opened, console)
    # New photographs are numbered after those of the scene.
    new = list(range(num_known, len(opened.photographs)))
    opened = hold_out(opened, request.hold_out, source.context, new)

    def load(own: Sequence[int]) -> tuple[Loaded, tuple[str, ...]]:
        """Load the photographs, where those of `own` are to make the splat anew."""
        read = partial(read_opened, work, source, NO_TARGETS, opened, console, num_known)
        at_poses, task = read(asks_splat=not own)
        loaded = load_models(work, work.config, NO_TARGETS, at_poses, task, geometry, console)
        return choose_evidence(work, source.context, loaded, new, own)

    own = find_remade(work, opened, new)
    loaded, notes = load(own)
    if own and not loaded.task.is_remade and loaded.opened.given is not opened.given:
        # The splat stays, as nothing is to be added, and has to agree with refined poses.
        loaded, notes = load(())
    print_lines(console, *notes)
    settings = {
        "photos": None if request.photos is None else str(request.photos),
        "hold_out": request.hold_out,
    }
    return make_prepared(request, None, loaded, settings)


def add_new_photographs(
    photos: Path, results: ResultsRequest, opened: Opened, console: Console
) -> Opened:
    """Place new photographs among those of the scene, and add them."""
    kept = results.out / FOUND_POSES_FOLDER
    refuse_link(kept)
    photographs, placed = place_photographs(
        photos, opened.photographs, kept, results.overwrite, opened.request.search_masks
    )
    print_lines(console, *placed.notes)
    photographs = replace(photographs, notes=(*photographs.notes, *placed.notes))
    return replace(
        opened,
        photographs=photographs,
        num_photographs=opened.num_photographs + placed.total,
    )


def hold_out(opened: Opened, count: int, context: Names | None, new: Sequence[int]) -> Opened:
    """Keep back `count` photographs at even steps, none of them of a context that is named.

    They are chosen among the `new` ones, or among all if there are none.
    """
    if count == 0:
        return opened
    photographs = opened.photographs
    named = find_context(photographs, context)
    resolution = opened.request.resolution
    usable = list(collect_usable_cameras(photographs, range(len(photographs)), resolution))
    # New photographs are what the update is judged by; of others the splat may have been trained
    # on all.
    candidates = [frame for frame in new or usable if frame in usable and frame not in named]
    # One of which a mask hides everything scores nothing. Only chosen photographs are asked for
    # their masks, since each has to be read for it.
    while True:
        if count > len(candidates) or len(usable) - count < MIN_LEFT:
            raise InputError(
                f"--hold-out {count} is too much: there are {len(candidates)} to choose from, and "
                f"at least {MIN_LEFT} of {len(usable)} have to be left; name a smaller number.",
                "hold-out",
            )
        steps = [(2 * number + 1) * len(candidates) // (2 * count) for number in range(count)]
        chosen = tuple(candidates[step] for step in steps)
        hidden = {frame for frame in chosen if photographs.is_hidden(frame)}
        if not hidden:
            break
        candidates = [frame for frame in candidates if frame not in hidden]
        usable = [frame for frame in usable if frame not in hidden]
    # The comparison at the end leaves out what cannot be read, so it is refused here.
    photographs.views(chosen, resolution)
    return replace(opened, held_out=chosen)


def find_remade(work: WorkRequest, opened: Opened, new: Sequence[int]) -> tuple[int, ...]:
    """Find the photographs from which an earlier command made the splat, if it is made anew.

    Returns none if they and the `new` ones are too much for one reconstruction.
    """
    assert work.splat is not None
    if not work.config.add_observed:
        return ()
    own = find_own_photographs(work, read_edits(work.splat.path), opened.files)
    pixels = count_pixels(opened.photographs, opened.request.resolution)
    return own if len({*own, *new}) <= limit_part_photos(pixels) else ()


def choose_evidence(
    work: WorkRequest,
    context: Names | None,
    loaded: Loaded,
    new: Sequence[int],
    own: Sequence[int],
) -> tuple[Loaded, tuple[str, ...]]:
    """Add new photographs to the context, and photographs that show what the splat lacks.

    A context is chosen to overlook the scene, and what it leaves out only checks, at a low
    resolution. A context that the user named only gets the new photographs. A splat that an earlier
    command made of the photographs `own` is made anew from these and those that are added. Also
    returns lines for the user.
    """
    task = loaded.task
    opened = loaded.opened
    added = [frame for frame in new if frame not in opened.held_out]
    pixels = count_pixels(opened.photographs, opened.request.resolution)
    if context is None:
        # A scene that is made anew has its own photographs in place of the context.
        joining = {*added, *(own or task.context_frames)}
        room = limit_part_photos(pixels) - len(joining) if own else MAX_LACKING
        shares = measure_lacks(loaded)
        added += select_lacking(shares, loaded.cameras, joining, min(room, MAX_LACKING))
    joined = join_photographs(own, added, set(opened.held_out), pixels) if own else ()
    frames = joined or tuple(sorted({*task.context_frames, *added}))
    if not joined and set(frames) == set(task.context_frames):
        return loaded, ()

    with show_preparation("reading photographs"):
        read = add_check_views(
            make_task(opened, frames, (), task.device.type, has_splat=True), opened
        )
    # The new views go through what `load_models` and those before it did with the first ones.
    transform = compute_view_transform(opened, task)
    task = replace(
        task,
        views=[transform_view(view, transform) for view in read.views],
        check_views=[transform_view(view, transform) for view in read.check_views or ()],
        depth_notes=read.depth_notes,
        predicted_depths=read.predicted_depths,
        is_remade=len(joined) > 0,
    )
    notes: tuple[str, ...] = ()
    if task.is_remade:
        task, about_range = apply_scene_range(task, loaded.completer.reconstructor)
        task, about_scene = mark_earlier_work(task)
        notes = (*about_range, *about_scene)
    else:
        assert task.scene is not None
        task = apply_splat_range(task, task.scene, loaded.completer.renderer)
    task = hide_taken_out(task)
    completer, task = use_predicted_depth(work.models, loaded.completer, task)
    cameras = collect_cameras(opened, task)
    return replace(loaded, task=task, completer=completer, cameras=cameras), notes


def select_lacking(
    shares: Mapping[int, float], cameras: Mapping[int, Camera], known: Collection[int], count: int
) -> list[int]:
    """Select up to `count` frames that lack most, and are far from the `known` ones and each other.

    Beside one that is chosen, a second one would show much the same. `shares` are those that the
    scene lacks.
    """
    frames = list(cameras)
    where = embed_cameras(list(cameras.values()))
    is_known = torch.tensor([frame in known for frame in frames], device=where.device)
    share = torch.tensor([shares.get(frame, 0.0) for frame in frames], device=where.device)
    share[is_known | (share < MIN_ADDED_SHARE)] = 0.0
    apart = torch.cdist(where, where[is_known]).amin(dim=1)
    count = min(count, int((share > 0).sum()))
    return [frames[index] for index in select_apart(where, share, apart, count)]


def measure_lacks(loaded: Loaded) -> dict[int, float]:
    """Measure the share of each photograph that the splat lacks, in small images, by frame.

    What was invented counts as lacking, since photographs may show something else there.
    """
    size = choose_check_size(loaded.opened.request.resolution)
    opened = loaded.opened.with_resolution(size)
    task = loaded.task
    scene = task.scene
    assert scene is not None
    if task.earlier.invented is not None:
        scene = scene[~task.earlier.invented]
    cameras = collect_cameras(opened, task)
    checks = {view.frame: view for view in task.check_views or ()}
    frames = []
    views = []
    renders = []
    for frame in track(list(cameras), "Comparing photographs"):
        if frame in opened.held_out or opened.photographs.is_hidden(frame):
            continue
        # Check views have this size, and are in memory.
        view = checks[frame] if frame in checks else read_check_view(loaded.opened, frame)
        # A view refuses an image and a camera on two devices, and cameras are on that of the task.
        camera = replace(cameras[frame], blur=view.camera.blur)
        view = replace(view.to(task.device), camera=camera)
        if task.taken_out is not None:
            view = task.taken_out.hide(view)
        frames.append(frame)
        views.append(view)
        renders.append(loaded.completer.renderer.render(scene, view.camera))
    config = loaded.completer.config or CompleterConfig.splat()
    lacks = find_lacks(views, renders, config.holes)
    return {frame: lack.share for frame, lack in zip(frames, lacks, strict=True)}
