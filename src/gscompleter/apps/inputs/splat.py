"""The input splat: how it is read, its file, its frame, and the photographs that check it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.apps.inputs.own_scene import find_source_frames
from gscompleter.apps.inputs.selection import (
    choose_check_size,
    collect_usable_cameras,
    select_near_and_far,
)
from gscompleter.apps.inputs.taken_out import merge_taken_out
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile, Opened
from gscompleter.apps.requests.splat import SplatRequest
from gscompleter.data.local_origin import (
    choose_scene_origin,
    compute_frame_from_photographs,
    shift_to_origin,
)
from gscompleter.numerics.geometry import sample_image
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import MIN_PROXY_GAUSSIANS
from gscompleter.splats.alignment.estimate import align_splat
from gscompleter.splats.alignment.similarity import transform_camera, transform_view
from gscompleter.splats.alignment.trainer_frames import InputSplat
from gscompleter.splats.formats import detect_splat_format, load_splat
from gscompleter.splats.morton import sort_nearby
from gscompleter.splats.ply import find_finite_rows
from gscompleter.system.errors import InputError
from gscompleter.system.files.mapping import move_to_file
from gscompleter.system.process import give_large_arrays_own_pages
from gscompleter.types import Camera, Gaussians, View

MAX_CHECK_VIEWS = 40
"""Most photographs that check a splat."""


def locate_splat(path: Path, drop_nonfinite: bool) -> InputSplatFile:
    """Describe the file of the input splat, of which Gaussians may have been dropped."""
    # A .ply is written again from its own rows, of which those that were dropped are left out.
    if drop_nonfinite and detect_splat_format(path) == "ply":
        return InputSplatFile(path, find_finite_rows(path))
    return InputSplatFile(path)


def read_splat(splat: SplatRequest) -> Gaussians:
    """Read the Gaussians of a splat, in the order of its file."""
    gaussians = load_splat(splat.path, splat.drop_nonfinite, splat.ignore_properties)
    if len(gaussians) >= MIN_PROXY_GAUSSIANS:
        give_large_arrays_own_pages()
    return gaussians


def sort_splat(
    gaussians: Gaussians, splat: SplatRequest, device: str
) -> tuple[Gaussians, InputSplatFile]:
    """Sort a large splat along a Morton curve, in place, and keep the order of its file.

    Also moves its harmonics to a temporary file (`file_harmonics`).
    """
    splat_file = locate_splat(splat.path, splat.drop_nonfinite)
    # Gaussians of a file lie in random order, and each tile of an image would read memory all over
    # (decision 025). Files are written in the order of the given file, which `file_order` leads
    # back to.
    if len(gaussians) >= MIN_PROXY_GAUSSIANS:
        splat_file = replace(splat_file, file_order=sort_nearby(gaussians))
    return file_harmonics(gaussians, splat, device), splat_file


def file_harmonics(gaussians: Gaussians, splat: SplatRequest, device: str) -> Gaussians:
    """Move the harmonics of a large splat to a temporary file; return it with these mapped.

    They are three quarters of it, and seldom read. A GPU holds them in its own memory.
    """
    if len(gaussians) < MIN_PROXY_GAUSSIANS or splat.beside is None or device != "cpu":
        return gaussians
    return replace(gaussians, sh=move_to_file(gaussians.sh, splat.beside))


def place_scene(
    scene: Gaussians, origin: Float[np.ndarray, "3"], cameras: Sequence[Camera]
) -> tuple[Gaussians, Float[np.ndarray, "3"]]:
    """Express a scene near an origin, and return it with that origin.

    It is the scene's own if its file states positions beyond float32. Otherwise it is `origin`,
    that of the photographs, if the scene lies there.
    """
    if scene.origin is not None:
        return scene, np.array(scene.origin)
    chosen = choose_scene_origin(scene, origin)
    return shift_to_origin(chosen, scene, cameras), chosen


def move_to_splat(
    task: CompletionTask,
    scene: Gaussians,
    splat_file: InputSplatFile,
    opened: Opened,
) -> CompletionTask:
    """Add the splat of a file to the task, and move its cameras into the splat's frame."""
    photographs = opened.photographs

    # Coordinates of maps are too large for float32, so that work is done near the scene's origin.
    scene, origin = place_scene(scene, photographs.origin, task.cameras)
    scene = scene.to(task.device)

    # Photographs still show what was taken out, so they are compared with the splat as it was.
    splat_file = replace(splat_file, origin=origin)
    whole = merge_taken_out(scene, splat_file)

    # A trainer may have moved and scaled the cameras before it trained the splat.
    splat = InputSplat(splat_file.path, whole, origin, opened.request.folder)
    alignment = align_splat(
        splat,
        photographs,
        task.context_frames,
        load_renderer(task.device.type),
        find_source_frames(splat_file.edits, opened.files),
    )

    # Cameras were read relative to the origin of the photographs, whatever frame they are in. Those
    # of the splat's own frame only change to its origin; all others are aligned.
    from_photographs = alignment.transform
    from_splat = compute_frame_from_photographs(origin) @ compute_frame_from_photographs(
        -photographs.origin
    )
    targets = []
    for target in task.targets:
        transform = from_splat if target.is_in_splat_frame else from_photographs
        targets.append(replace(target, camera=transform_camera(target.camera, transform)))

    # Where the splat fits as it is, its zero is that of the photographs as they were read. The
    # origin of a splat that states its own is in another frame than theirs unless it fits so.
    has_their_origin = alignment.method == "given" or scene.origin is not None
    return replace(
        task,
        views=[transform_view(view, from_photographs) for view in task.views],
        targets=targets,
        frame=from_photographs @ task.frame,
        origin=photographs.origin if has_their_origin else origin,
        scene=scene,
        splat_file=splat_file,
        method=alignment.method,
        frame_description=alignment.describe(),
        check_views=[transform_view(view, from_photographs) for view in task.check_views or ()],
    )


def read_check_view(opened: Opened, frame: int) -> View:
    """Read a photograph at the size of check views.

    Gaussians are drawn there as wide as in photographs of the context.
    """
    resolution = opened.request.resolution
    (view,) = opened.photographs.views([frame], choose_check_size(resolution))
    large = opened.photographs.camera(frame, resolution)
    return replace(view, camera=sample_image(view.camera, large))


def add_check_views(task: CompletionTask, opened: Opened) -> CompletionTask:
    """Add check views: unused photographs near the targets and all around (decision 020)."""
    photographs = opened.photographs
    known = task.used_frames | set(opened.held_out)
    others = [frame for frame in range(len(photographs)) if frame not in known]
    size = choose_check_size(opened.request.resolution)
    cameras = collect_usable_cameras(photographs, others, size)
    views = []
    for frame in select_near_and_far(task.goals, cameras, MAX_CHECK_VIEWS):
        # One that is damaged or hidden by a mask checks nothing, and many others do.
        with suppress(InputError):
            views.append(read_check_view(opened, frame))
    return replace(task, check_views=[view.to(task.device) for view in views])
