"""The command `complete`: a scene folder in, a completed scene and its report out."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from gscompleter.commands.options import CompleteOptions
from gscompleter.completer import GSCompleter
from gscompleter.data.formats import open_photographs, recognised
from gscompleter.data.origin import frame_from_photographs, origin_of, told_from
from gscompleter.data.photographs import Photographs, PosedPhotographs
from gscompleter.data.scene import load_cameras
from gscompleter.data.sparse_points import with_depth_range
from gscompleter.data.structure_from_motion import find_poses, holds_photographs
from gscompleter.errors import InputError, quoted
from gscompleter.frames.beside import GivenSplat
from gscompleter.frames.placing import frame_of_splat
from gscompleter.frames.similarity import moved_camera, moved_view
from gscompleter.generators import load_generator
from gscompleter.io.files import SUMMARY, check_output, output_folder
from gscompleter.memory import check_memory
from gscompleter.progress import shown_on
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render import choose_device, load_renderer
from gscompleter.reports.completion import Target, write_report
from gscompleter.splats.formats import load_splat
from gscompleter.types import Camera, Completion, Gaussians, View

MIN_SIZE = 16
"""Shorter side of an image, in pixels, under which there is nothing to match and to score."""
POSES = "colmap"
"""The folder of the output with the cameras that were found."""
MAX_DIGITS = 9
"""Characters of the longest number of a frame."""


def run_completion(options: CompleteOptions) -> None:
    """Complete the scene of `options.folder`, write `options.out` and say what was done."""
    summary, completion = complete_folder(options)
    if not options.quiet:
        tell(summary, completion, options.out)


def complete_folder(options: CompleteOptions) -> tuple[dict[str, Any], Completion]:
    """Complete the scene of `options.folder` and write `options.out`; also returns the summary.

    Raises:
        InputError: anything about the input that the user can mend; nothing is written then but
            cameras that were found.
    """
    console = Console(stderr=True, quiet=options.quiet)
    check_output(options.out, options.overwrite or holds_poses_only(options.out))
    check_context(options)
    device = choose_device(options.device)
    given = open_scene(options, console)
    task = read_task(options, given, device)
    if options.scene is not None:
        task = in_frame_of_splat(task, options.scene, options, given, console)
    completer = completer_for(options, task.targets, device)
    said = {
        "settings": settings_of(options),
        "seed": options.seed,
        "device": device,
        "frame": {"method": task.method, "transform": task.frame.tolist()},
    }
    overwrite = options.overwrite or holds_poses_only(options.out)
    with output_folder(options.out, overwrite) as folder:
        with shown_on(None if options.quiet else console):
            cameras = [target.camera.to(device) for target in task.targets]
            completion = completer(task.views, cameras, task.scene)
        summary = write_report(folder, completion, task.targets, completer.renderer, said)
    return summary, completion


@dataclass(frozen=True)
class Task:
    """What is completed, and in which frame."""

    views: Sequence[View]
    targets: Sequence[Target]
    frame: Float[np.ndarray, "4 4"]
    """From the frame of the photographs to that of the result."""
    scene: Gaussians | None = None
    """The splat that was brought; None where the context is reconstructed."""
    method: str = "given"
    """How the frame was found."""


def read_task(options: CompleteOptions, given: Photographs, device: str) -> Task:
    """The photographs and targets that the options name, once it is seen that there is room."""
    targets = read_targets(given, options)
    cameras = [given.camera(frame, options.resolution) for frame in options.context]
    check_sizes([*cameras, *(target.camera for target in targets)])
    views = [view.to(device) for view in given.views(options.context, options.resolution)]
    targets = [with_photograph(target, given, options) for target in targets]
    return Task(views, targets, frame_from_photographs(given.origin))


def in_frame_of_splat(
    task: Task, path: Path, options: CompleteOptions, given: Photographs, console: Console
) -> Task:
    """`task` with the splat of a file, its cameras brought to where the photographs show it.

    Raises:
        InputError: where the file is damaged, or the photographs show something else.
    """
    device = task.views[0].image.device
    cameras = [view.camera for view in task.views] + [target.camera for target in task.targets]
    scene = load_splat(path, drop_nonfinite=options.drop_nonfinite)
    origin = origin_of(scene, given.origin)
    scene = told_from(origin, scene, cameras).to(device)
    splat = GivenSplat(path, scene, origin, options.folder)
    found = frame_of_splat(splat, given, options.context, load_renderer(device.type))
    console.print(found.sentence(), highlight=False, soft_wrap=True)
    return Task(
        [moved_view(view, found.transform) for view in task.views],
        [replace(t, camera=moved_camera(t.camera, found.transform)) for t in task.targets],
        found.transform @ task.frame,
        scene,
        found.method,
    )


def open_scene(options: CompleteOptions, console: Console) -> Photographs:
    """The posed photographs of `options.folder`. Where it has no cameras, they are found first, and
    kept in the output folder, whatever becomes of the completion.

    Raises:
        InputError: as `open_photographs` and `find_poses`.
    """
    folder, poses = options.folder, options.out / POSES
    if options.format is None and holds_photographs(folder) and recognised(folder) is None:
        ours = options.overwrite or os.path.isfile(poses / SUMMARY)
        with shown_on(None if options.quiet else console):
            found = find_poses(folder, poses, overwrite=ours)
        for note in found.notes:
            console.print(note, highlight=False, soft_wrap=True)
        folder = poses
    given = open_photographs(folder, options.format, options.near, options.far)
    given = with_depth_range(given, options.context, options.resolution)
    for note in given.notes:
        console.print(note, highlight=False, soft_wrap=True)
    return given


def holds_poses_only(out: Path) -> bool:
    """Whether a folder has nothing in it but the poses that an earlier run found."""
    return os.path.isdir(out) and os.listdir(out) == [POSES]


def completer_for(options: CompleteOptions, targets: Sequence[Target], device: str) -> GSCompleter:
    """The models that the options name, and the settings of the stages."""
    photographs = [
        View(target.photograph, target.camera, target.frame)
        for target in targets
        if target.photograph is not None
    ]
    generator = options.synthesis
    return GSCompleter(
        load_reconstructor(options.reconstructor, options.weights, device),
        load_generator(generator.name, options.seed, photographs, device, generator.settings()),
        load_renderer(device),
        options.config,
        options.seed,
    )


def check_context(options: CompleteOptions) -> None:
    """Refuse too few context frames, and the same one twice."""
    needed = 2 if options.scene is None else 1
    if len(options.context) < needed:
        raise InputError(
            f"--context names {len(options.context)} frame(s), and stereo needs at least {needed}; "
            "name more, as in --context 0 4."
        )
    if len(set(options.context)) < len(options.context):
        raise InputError(
            f"--context names a frame twice ({' '.join(map(str, options.context))}), which gives "
            "identical cameras and no baseline; name different frames."
        )
    if not options.target:
        raise InputError("--target names no frame; name at least one, as in --target 8.")


def read_targets(photographs: PosedPhotographs, options: CompleteOptions) -> list[Target]:
    """The target cameras in the order of the command line."""
    targets = []
    for word in options.target:
        frame = frame_number(word)
        if frame is None:
            cameras = load_cameras(
                word, options.resolution, options.near, options.far, photographs.origin.tolist()
            )
            targets += [Target(camera) for camera in cameras]
        else:
            targets.append(Target(photographs.camera(frame, options.resolution), frame))
    return targets


def with_photograph(
    target: Target, photographs: PosedPhotographs, options: CompleteOptions
) -> Target:
    """`target` and what its camera took, if it is a frame that has a photograph."""
    if target.frame is None or not photographs.has_photograph(target.frame):
        return target
    (view,) = photographs.views([target.frame], options.resolution)
    return replace(target, photograph=view.image)


def check_sizes(cameras: Sequence[Camera]) -> None:
    """Refuse images with nothing in them to match and to score, and those beyond all memory."""
    for camera in cameras:
        if min(camera.width, camera.height) < MIN_SIZE:
            raise InputError(
                f"An image is {camera.width} x {camera.height} pixels, and both sides must have at "
                f"least {MIN_SIZE}; choose a larger --resolution, or another camera."
            )
    check_memory(max(camera.width * camera.height for camera in cameras), len(cameras))


def frame_number(word: str) -> int | None:
    """The number that `word` writes, or None where it names a file."""
    if re.fullmatch("-?[0-9]+", word) is None:
        return None
    if len(word) > MAX_DIGITS:
        raise InputError(f"There is no frame {quoted(word)}; name one by its number.", "target")
    return int(word)


def settings_of(options: CompleteOptions) -> dict[str, Any]:
    """Everything that decided the result, for `summary.json`."""
    return {
        "folder": str(options.folder),
        "format": options.format,
        "context": list(options.context),
        "target": list(options.target),
        "scene": None if options.scene is None else str(options.scene),
        "reconstructor": options.reconstructor,
        "weights": None if options.weights is None else str(options.weights),
        **options.synthesis.as_summary(),
        "uses_target_photographs": options.synthesis.name == "oracle",
        "resolution": None if options.resolution is None else list(options.resolution),
        "near": options.near,
        "far": options.far,
        "config": asdict(options.config),
    }


def tell(summary: Mapping[str, Any], completion: Completion, out: Path) -> None:
    """Say what was done: a row per camera, and where it lies."""

    def cell(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    table = Table("camera", "hole", "PSNR before", "PSNR after", "added", box=None)
    for row in summary["context"]:
        name = f"context {row['frame']}"
        table.add_row(name, "", cell(row["psnr_before"]), cell(row["psnr_after"]), "")
    notes = []
    for row, target in zip(summary["targets"], completion.targets, strict=True):
        name = "target" if row["frame"] is None else f"target {row['frame']}"
        notes += [f"{name}: {note}" for note in target.notes]
        hole = f"{100 * row['hole_fraction']:.1f} %"
        scores = cell(row["psnr_before"]), cell(row["psnr_after"])
        table.add_row(name, hole, *scores, f"{len(target.added):,}")
    console = Console(highlight=False)
    console.print(table)
    for note in notes:
        console.print(note)
    offset = [-row[3] for row in summary["frame"]["transform"][:3]]
    if summary["frame"]["method"] == "given" and any(offset):
        console.print(
            f"The coordinates are large against the baselines, so the result is relative to "
            f"{' '.join(map(str, offset))}; summary.json has the transform.",
            soft_wrap=True,
        )
    counts = summary["gaussians"]
    seconds = summary["seconds"]["total"]
    console.print(
        f"Added {counts['added']:,} Gaussians to {counts['context']:,} in {seconds:.1f} s: "
        f"{out / 'completed.ply'}",
        soft_wrap=True,
    )
