"""Completion of a scene, and the report on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.command_line.exit_codes import DONE, ERROR
from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.completing.holes import EXPORTED, refuse_painted, write_holes
from gscompleter.apps.completing.keeping import keep_small
from gscompleter.apps.completing.maker import describe_maker
from gscompleter.apps.completing.marking import prepare_marked
from gscompleter.apps.completing.preparation import Prepared
from gscompleter.apps.completing.printing import (
    answer_completion,
    describe_plan,
    print_export,
    print_plan,
)
from gscompleter.apps.completing.run_info import describe_run, read_held_out, refuse_results
from gscompleter.apps.inputs.describing import describe_task, print_lines
from gscompleter.apps.inputs.holes_file import HOLES_FILE
from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.apps.report.completion import (
    IMAGES,
    write_images,
    write_report,
)
from gscompleter.apps.report.film import write_comparison_video
from gscompleter.apps.report.page import write_completion_page
from gscompleter.apps.report.results import COMMAND, RESULTS
from gscompleter.apps.report.schema import read_summary
from gscompleter.completer import check_target_ids
from gscompleter.data.scene import describe_camera, write_cameras
from gscompleter.editing.removal import restore_surroundings
from gscompleter.evaluation.metrics.coverage import render_pairs, sample_held_out_cameras
from gscompleter.numerics.kernels.parallel import run_in_background
from gscompleter.splats.alignment.similarity import transform_camera_exactly
from gscompleter.splats.edits import EditDraft
from gscompleter.state import Completion
from gscompleter.system.console import make_console
from gscompleter.system.errors import print_error, quote_value
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.video import find_ffmpeg
from gscompleter.system.files.writing import RENDERS_FILE, TARGETS_FILE
from gscompleter.system.process import release_free_memory
from gscompleter.system.progress import show_progress, stage
from gscompleter.system.timing import add_seconds
from gscompleter.types import Camera

REGIONS = ("box", "box_rotation", "sphere", "margin")
"""Settings of a place."""
NAMED_FILES = ("mask", "select", "images", "photos")
"""Settings that name files."""
Prepare = Callable[[Any, Console], Prepared]
"""Opens the input of a command, whose options it takes, and loads the models."""


def complete_scene(options: CompleteOptions, prepare: Prepare = prepare_marked) -> int:
    """Complete the scene, print a summary, and return the exit code."""
    if options.export_holes is not None:
        export_folder(options, prepare)
        return DONE
    if options.dry_run:
        plan_folder(options, prepare)
        return DONE
    complete_folder(options, prepare)
    outcome = read_summary(options.out).outcome
    answer_completion(options)
    if outcome.status != "not-reconstructed":
        return DONE
    # A quiet run that fails says why, and so does one whose answer is for a program.
    if options.quiet or options.json:
        print_error(outcome.headline)
    return ERROR


def complete_folder(
    options: CompleteOptions, prepare: Prepare = prepare_marked, takes_over: bool = False
) -> dict[str, Any]:
    """Complete the scene, write `options.out`, and return the summary."""
    # A missing ffmpeg ends the command at its beginning, not after the completion.
    if options.video:
        find_ffmpeg()
    with open_completion(options, prepare, takes_over) as (ready, folder):
        completion, ready = complete_targets(ready)

        # Frozen views of the scene take memory, and the report does not use them.
        ready.completer.scenes.clear()
        release_free_memory()
        with stage("report"):
            summary = write_done(folder, ready, completion)
            write_targets(folder, ready.task)
        if options.video:
            photographs = list(ready.cameras.values())
            write_comparison_video(folder, completion, photographs, ready.completer.renderer)
        if options.save_as is not None:
            given = ready.options.scene
            # An earlier result in OUT may be the input, and is replaced.
            if given is not None and options.out.resolve() in given.resolve().parents:
                given = None
            summary = keep_small(folder, options.save_as, summary, given)
    return summary


def plan_folder(options: CompleteOptions, prepare: Prepare) -> None:
    """Write the targets and print the plan, without completing the scene.

    The hole fraction of each target is that after those before it are completed.
    """
    with open_completion(options, prepare) as (ready, folder):
        begun = ready.begin()
        targets = ready.task.target_cameras
        if targets:
            holes = ready.explorer.compute_hole_fractions(begun, targets)
        else:
            cameras = list(ready.cameras.values())
            choices = ready.explorer.plan(begun, cameras, ready.options.max_targets)
            ready = ready.with_choices(choices)
            holes = [choice.hole_fraction for choice in choices]
        write_targets(folder, ready.task)
        write_render_cameras(folder, ready)
        if ready.task.targets:
            write_plan_pictures(folder / IMAGES, ready, begun)
    if options.json:
        print_json(describe_plan(options, ready.opened, ready.task.targets, holes))
    elif not options.quiet:
        print_plan(options, ready.opened, ready.task.targets, holes)


def export_folder(options: CompleteOptions, prepare: Prepare) -> None:
    """Write the holes of the targets to be painted, and print how to go on."""
    refuse_painted(options.results)
    if options.path:
        find_ffmpeg()
    with open_completion(options, prepare) as (ready, folder):
        begun = ready.begin()
        if not ready.task.targets:
            cameras = list(ready.cameras.values())
            ready = ready.with_choices(ready.explorer.plan(begun, cameras, options.max_targets))
        lines = write_holes(folder, ready, begun)
    if options.json:
        content = json.loads((options.results / HOLES_FILE).read_bytes())
        print_json({"out": str(options.results), "notes": list(lines), "holes": content})
    elif not options.quiet:
        print_export(options, lines)


def write_plan_pictures(folder: Path, ready: Prepared, begun: Completion) -> None:
    """Write what each target sees of the scene, and the photograph that it was derived from.

    They show where to stand for a further photograph.
    """
    folder.mkdir()
    renderer = ready.completer.renderer
    for number, target in enumerate(ready.task.targets, start=1):
        render = renderer.render(begun.scene, target.camera.to(ready.task.device))
        write_images(folder, f"target{number}", {"before": render.image})
        if target.derived_from is not None:
            resolution = ready.opened.request.resolution
            (beside,) = ready.opened.photographs.views([target.derived_from], resolution)
            write_images(folder, f"target{number}", {"beside": beside.image})


@contextmanager
def open_completion(
    options: CompleteOptions, prepare: Prepare, takes_over: bool = False
) -> Iterator[tuple[Prepared, Path]]:
    """Reserve the output folder, load everything, print the input, and open the folder.

    `takes_over` is that of `reserve_output`.
    """
    console = make_console(stderr=True, quiet=options.quiet)
    with (
        show_progress(console),
        reserve_output(
            options.results, options.overwrite, COMMAND, list_results(options), takes_over
        ) as output,
    ):
        if options.dry_run:
            refuse_results(options.out)
        print_lines(console, *output.describe_others())
        ready = prepare(options, console)
        plan = describe_task(
            ready.opened,
            ready.task,
            options.max_targets,
            describe_models(ready.options),
            options.results,
            describe_doing(ready),
        )
        print_lines(console, *plan)
        with output.write() as folder:
            yield ready, folder


def list_results(options: CompleteOptions) -> tuple[str, ...]:
    """List globs of the files that a command may write to its folder."""
    return RESULTS if options.export_holes is None else EXPORTED


def describe_doing(ready: Prepared) -> str:
    """Say what is done with the scene, for the lines before the work."""
    if ready.options.export_holes is not None:
        return "export holes of the scene"
    if ready.command == "remove":
        return "remove the selection and fill its place"
    return "complete the scene"


def describe_models(options: CompleteOptions) -> str:
    """Name Ψ and Φ for the lines before the work."""
    if options.from_photographs_only or options.export_holes is not None:
        return options.reconstructor
    if options.images is None:
        return f"{options.reconstructor} and {options.synthesis.generator}"
    painter = options.painter or "an unnamed painter"
    return f"{options.reconstructor} and images of {quote_value(painter)}"


def write_done(
    folder: Path, ready: Prepared, completion: Completion, command: str | None = None
) -> dict[str, Any]:
    """Write all results but the targets and the video, and return the summary.

    `command` is that of the record of edits, if it is not that of `ready`.
    """
    options = ready.options
    task = ready.task
    renderer = ready.completer.renderer

    # After a removal, photographs must look as before where they do not show what was removed.
    # Without one this returns the completion as it is.
    completion = restore_surroundings(completion, renderer)
    completion = replace(completion, seconds=add_seconds(completion.seconds, ready.seconds))

    # Coverage is measured from cameras beside the photographs, not from the targets themselves.
    # They are rendered while the files are written.
    cameras = tuple(ready.cameras.values())
    aside = sample_held_out_cameras(cameras, options.seed)
    facts = describe_run(options, ready.opened, task, completion.config, ready.describe_settings())
    with run_in_background(render_pairs, completion, aside, renderer) as looks:
        summary = write_report(
            folder,
            completion,
            task.targets,
            renderer,
            {**facts, "seed": options.seed},
            task.splat_file,
            cameras,
            looks,
            read_held_out(ready.opened, task, ready.cameras),
            ready.opened.files,
            has_searched=not options.from_photographs_only,
            run=describe_maker(options, task, completion),
            testing=[completion.with_depth_range(camera) for camera in task.witnesses.testing],
            edit=EditDraft(command or ready.command, describe_edit(ready)),
        )
    write_render_cameras(folder, ready)
    write_completion_page(folder)
    return summary


def describe_edit(ready: Prepared) -> dict[str, Any]:
    """Describe what was done for the record of edits: places, cameras, masks, photographs, models.

    Paths are without their folders, which tell about the machine.
    """
    files = ready.opened.files
    settings = ready.describe_settings()
    # Those of a place are numbers, in the coordinates of the splat's file.
    place = {name: settings[name] for name in REGIONS if settings.get(name)}
    named = {name: settings[name] for name in NAMED_FILES if settings.get(name)}
    back = np.linalg.inv(ready.task.frame)
    cameras = [
        describe_camera(transform_camera_exactly(target.camera, back))
        for target in ready.task.targets
    ]
    return {
        **place,
        **{name: strip_folders(value) for name, value in named.items()},
        "cameras": cameras,
        "photographs": [files.get(frame) for frame in ready.task.context_frames],
        "reconstructor": strip_folders(ready.options.reconstructor),
        "generator": strip_folders(ready.options.synthesis.generator),
    }


def strip_folders(value: str | Sequence[str]) -> str | list[str]:
    """Strip the folders of a path, or of several."""
    if isinstance(value, str):
        return Path(value).name
    return [Path(path).name for path in value]


def complete_targets(ready: Prepared) -> tuple[Completion, Prepared]:
    """Complete the scene for the named targets, or for targets that it finds."""
    task = ready.task
    count = ready.options.max_targets

    # What photographs show is added when the completion begins, before any target.
    if ready.options.from_photographs_only:
        return ready.begin(), ready

    # Too many targets for the labels of a .ply are refused before the first one is completed.
    if task.targets:
        check_target_ids(task.scene, len(task.targets))
        return ready.completer.complete(ready.begin(), task.target_cameras), ready
    check_target_ids(task.scene, count)
    cameras = list(ready.cameras.values())
    completion, choices = ready.explorer.explore(ready.begin(), cameras, count)
    return completion, ready.with_choices(choices)


def write_targets(folder: Path, task: CompletionTask) -> None:
    """Write the target cameras in the frame of the photographs, as `--target` reads them."""
    if task.targets:
        write_in_first_frame(folder / TARGETS_FILE, task, [t.camera for t in task.targets])


def write_render_cameras(folder: Path, ready: Prepared) -> None:
    """Write the cameras of renders that took the place of photographs, as `--cameras` reads."""
    if ready.opened.renders_from is not None:
        cameras = [view.camera for view in ready.task.views]
        write_in_first_frame(folder / RENDERS_FILE, ready.task, cameras)


def write_in_first_frame(path: Path, task: CompletionTask, cameras: Sequence[Camera]) -> None:
    """Write cameras of the result in the frame of the photographs, or of a splat alone."""
    # In float64, because coordinates of maps are large.
    back = np.linalg.inv(task.frame)
    write_cameras(path, [transform_camera_exactly(camera, back) for camera in cameras])
