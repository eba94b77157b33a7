"""Completion of a scene, and the report on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rich.console import Console

from gscompleter.apps.command_line.exit_codes import DONE, ERROR
from gscompleter.apps.completing.holes import EXPORTED, refuse_painted, write_holes
from gscompleter.apps.completing.keeping import save_compactly
from gscompleter.apps.completing.maker import describe_maker
from gscompleter.apps.completing.marking import prepare_repair
from gscompleter.apps.completing.preparation import describe_settings, prepare_completion
from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.completing.printing import (
    answer_completion,
    answer_export,
    answer_plan,
)
from gscompleter.apps.completing.refill import find_reopened
from gscompleter.apps.completing.remove import prepare_removal
from gscompleter.apps.completing.run_info import describe_run_values, read_held_out
from gscompleter.apps.completing.update import prepare_update
from gscompleter.apps.inputs.describing import describe_task, print_lines
from gscompleter.apps.inputs.earlier_targets import EMPTY_SHARES
from gscompleter.apps.inputs.refined_poses import write_refined_poses
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.apps.report.completion import write_report
from gscompleter.apps.report.film import write_comparison_video
from gscompleter.apps.report.page import write_completion_page
from gscompleter.apps.report.pictures import IMAGES_FOLDER, write_images
from gscompleter.apps.report.results import COMPLETE_COMMAND, COMPLETION_RESULTS
from gscompleter.apps.report.schema import read_summary, refuse_completed
from gscompleter.apps.requests.completion import (
    ExportRequest,
    FillingRequest,
    PlanRequest,
    RemovalRequest,
    RepairRequest,
    Request,
    ResultsRequest,
    UpdateRequest,
    get_completion,
)
from gscompleter.config.generators import PaintedSettings, makes_any_image
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.scene import describe_camera, write_cameras
from gscompleter.editing.removal import restore_surroundings
from gscompleter.evaluation.metrics.coverage import (
    compute_covered_share,
    render_pairs,
    sample_held_out_cameras,
)
from gscompleter.numerics.kernels.parallel import run_in_background
from gscompleter.parts import check_target_ids, find_last_target_id
from gscompleter.splats.alignment.similarity import transform_camera_exactly
from gscompleter.splats.alignment.trainer_files import write_trainer_cameras
from gscompleter.splats.edits import EditDraft
from gscompleter.state import Completion
from gscompleter.system.console import make_console
from gscompleter.system.errors import print_error, quote_value
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.result_names import RENDERS_FILE, TARGETS_FILE
from gscompleter.system.files.video import find_ffmpeg
from gscompleter.system.process import release_free_memory
from gscompleter.system.progress import show_progress, stage, track
from gscompleter.system.timing import add_seconds
from gscompleter.types import Camera

REGIONS = ("box", "box_rotation", "sphere", "margin")
"""Settings of a place."""
NAMED_FILES = ("mask", "select", "images", "photos", "geometry")
"""Settings that name files."""


def run_request(request: Request) -> int:
    """Do what is asked, print the result, and return the exit code."""
    if isinstance(request, ExportRequest):
        return export_holes(request)
    if isinstance(request, PlanRequest):
        return plan_targets(request)
    return complete_scene(request)


def prepare(request: FillingRequest | UpdateRequest, console: Console) -> Prepared:
    """Open the scene, and load the models; what is taken out first is chosen when it begins."""
    if isinstance(request, UpdateRequest):
        return prepare_update(request, console)
    if isinstance(request, RemovalRequest):
        return prepare_removal(request, console)
    if isinstance(request, RepairRequest):
        return prepare_repair(request, console)
    return prepare_completion(request, console, remakes_own=True)


def get_results(request: FillingRequest | UpdateRequest) -> ResultsRequest:
    """Return what is written, and where."""
    if isinstance(request, UpdateRequest):
        return request.results
    return get_completion(request).results


def complete_scene(request: FillingRequest | UpdateRequest) -> int:
    """Complete the scene, print a summary, and return the exit code."""
    complete_folder(request)
    return answer_outcome(get_results(request))


def answer_outcome(
    results: ResultsRequest, further: Mapping[str, Any] = MappingProxyType({})
) -> int:
    """Print a completion, as `answer_completion` does, and return the exit code of its outcome."""
    outcome = read_summary(results.out).outcome
    answer_completion(results, further)
    if outcome.status != "not-reconstructed":
        return DONE
    # A quiet run that fails says why, and so does one whose answer is for a program.
    if results.answer.quiet or results.answer.json:
        print_error(outcome.headline)
    return ERROR


def complete_folder(
    request: FillingRequest | UpdateRequest, takes_over: bool = False
) -> dict[str, Any]:
    """Complete the scene, write the results, and return the summary.

    `takes_over` is that of `reserve_output`.
    """
    results = get_results(request)
    # A missing ffmpeg ends the command at its beginning, not after the completion.
    if results.has_video:
        find_ffmpeg()
    console = make_console(stderr=True, quiet=results.answer.quiet)
    with (
        show_progress(console),
        reserve_output(
            results.out, results.overwrite, COMPLETE_COMMAND, COMPLETION_RESULTS, takes_over
        ) as output,
    ):
        print_lines(console, *output.describe_others())
        ready = prepare(request, console)
        print_lines(console, *describe_completion_plan(ready))
        with output.write() as folder:
            return write_completion(folder, ready)


def write_completion(folder: Path, ready: Prepared) -> dict[str, Any]:
    """Complete the targets, write all results to a folder, and return the summary."""
    results = ready.results
    completion, ready = complete_targets(ready)

    # Frozen views of the scene take memory, and the report does not use them.
    ready.completer.scenes.clear()
    release_free_memory()
    with stage("report"):
        summary = write_done(folder, ready, completion)
        write_targets(folder, ready.task)
    if results.has_video:
        photographs = list(ready.cameras.values())
        write_comparison_video(folder, completion, photographs, ready.completer.renderer)
    if results.suffix is not None:
        given = None if ready.work.splat is None else ready.work.splat.path
        # An earlier result in OUT may be the input, and is replaced.
        if given is not None and results.out.resolve() in given.resolve().parents:
            given = None
        summary = save_compactly(folder, results.suffix, summary, given)
    return summary


def plan_targets(request: PlanRequest) -> int:
    """Write the targets and print the plan, without completing the scene.

    The hole fraction of each target is that after those before it are completed.
    """
    results = get_results(request.filling)
    console = make_console(stderr=True, quiet=results.answer.quiet)
    with (
        show_progress(console),
        reserve_output(
            results.out, results.overwrite, COMPLETE_COMMAND, COMPLETION_RESULTS
        ) as output,
    ):
        refuse_completed(results.out)
        print_lines(console, *output.describe_others())
        ready = prepare(request.filling, console)
        check_target_count(ready)
        print_lines(console, *describe_completion_plan(ready))
        with output.write() as folder:
            begun = ready.begin()
            targets = ready.task.target_cameras
            if targets:
                holes = ready.explorer.compute_hole_fractions(begun, targets)
            else:
                cameras = list(ready.cameras.values())
                choices = ready.explorer.plan(begun, cameras, ready.max_targets)
                ready = ready.with_choices(choices)
                holes = [choice.hole_fraction for choice in choices]
            write_targets(folder, ready.task)
            write_chosen_cameras(folder, ready.opened, ready.task)
            if ready.task.targets:
                write_plan_pictures(folder / IMAGES_FOLDER, ready, begun)
    answer_plan(results, ready.opened, ready.task.targets, holes)
    return DONE


def export_holes(request: ExportRequest) -> int:
    """Write the holes of the targets to be painted, and print how to go on."""
    refuse_painted(request.folder)
    if request.has_path:
        find_ffmpeg()
    results = get_results(request.filling)
    console = make_console(stderr=True, quiet=results.answer.quiet)
    with (
        show_progress(console),
        reserve_output(request.folder, results.overwrite, COMPLETE_COMMAND, EXPORTED) as output,
    ):
        print_lines(console, *output.describe_others())
        ready = prepare(request.filling, console)
        check_target_count(ready)
        print_lines(console, *describe_export(ready, request.folder))
        with output.write() as folder:
            begun = ready.begin()
            if not ready.task.targets:
                cameras = list(ready.cameras.values())
                choices = ready.explorer.plan(begun, cameras, ready.max_targets)
                ready = ready.with_choices(choices)
            lines = write_holes(folder, ready, begun, request.has_path)
    answer_export(request, results.answer, lines)
    return DONE


def write_plan_pictures(folder: Path, ready: Prepared, begun: Completion) -> None:
    """Write what each target sees of the scene, and the photograph that it was derived from.

    They show where to stand for a further photograph.
    """
    folder.mkdir()
    renderer = ready.completer.renderer
    for number, target in enumerate(ready.task.targets, start=1):
        # Without the range of the scene, a camera of a file sees nothing nearer than 0.01 units.
        camera = begun.with_depth_range(target.camera.to(ready.task.device))
        render = renderer.render(begun.scene, camera)
        write_images(folder, f"target{number}", {"before": render.image})
        if target.derived_from is not None:
            resolution = ready.opened.request.resolution
            (beside,) = ready.opened.photographs.views([target.derived_from], resolution)
            write_images(folder, f"target{number}", {"beside": beside.image})


def describe_completion_plan(ready: Prepared) -> list[str]:
    """Write the lines before a completion."""
    models = ready.work.models
    settings = models.generator_settings
    names = models.reconstructor
    if isinstance(settings, PaintedSettings):
        names += f" and images of {quote_value(settings.painter)}"
    elif ready.targets is not None:
        names += f" and {models.generator}"
    return describe_task(ready.opened, ready.task, ready.max_targets, names, ready.results.out)


def describe_export(ready: Prepared, folder: Path) -> list[str]:
    """Write the lines before an export."""
    return describe_task(
        ready.opened,
        ready.task,
        ready.max_targets,
        ready.work.models.reconstructor,
        folder,
        "export holes of the scene",
    )


def write_done(
    folder: Path, ready: Prepared, completion: Completion, command: str | None = None
) -> dict[str, Any]:
    """Write all results but the targets and the video, and return the summary.

    `command` is that of the record of edits, if it is not that of `ready`.
    """
    seed = ready.work.models.seed
    task = ready.task
    renderer = ready.completer.renderer

    # After a removal, photographs must look as before where they do not show what was removed.
    # Without one this returns the completion as it is.
    completion = restore_surroundings(completion, ready.completer.scenes)
    completion = replace(completion, seconds=add_seconds(completion.seconds, ready.seconds))

    # Coverage is measured from cameras beside the photographs, not from the targets themselves.
    # They are rendered while the files are written.
    cameras = tuple(ready.cameras.values())
    aside = sample_held_out_cameras(cameras, seed)
    facts = describe_run_values(
        ready.source,
        ready.work.splat,
        ready.opened,
        task,
        completion.config,
        describe_settings(ready),
        ready.inverts_masks,
    )
    reopened = {"reopened": len(ready.reopened)} if ready.reopened else {}
    with run_in_background(render_pairs, completion, aside, renderer) as looks:
        summary = write_report(
            folder,
            completion,
            task.targets,
            renderer,
            {**facts, "seed": seed, **reopened},
            task.splat_file,
            cameras,
            looks,
            read_held_out(ready.opened, task, ready.cameras),
            ready.opened.files,
            has_searched=ready.targets is not None,
            run=describe_maker(ready.work.models, task, completion),
            testing=[completion.with_depth_range(camera) for camera in task.witnesses.testing],
            edit=EditDraft(command or ready.command, describe_edit(ready, completion)),
        )
    write_chosen_cameras(folder, ready.opened, ready.task)
    # A scene that Ψ made has its photographs as the splat of a trainer has its own.
    if task.scene is None or completion.is_remade:
        write_trainer_cameras(folder, list_sources(ready, completion))
    write_completion_page(folder)
    return summary


def list_sources(ready: Prepared, completion: Completion) -> dict[str, Camera]:
    """List the cameras of the photographs that a scene was reconstructed from, by their names.

    They are in the frame of the scene's file, and in the size of the photographs: a later command
    takes the size of the list for that which the scene is sharp at.
    """
    photographs = ready.opened.photographs
    to_file = compute_frame_from_photographs(-ready.task.splat_origin)
    cameras = {}
    for view in completion.views:
        if view.frame is None:
            continue
        # Its pose may have been refined, and is that of the scene.
        own = replace(photographs.camera(view.frame), c2w=view.camera.on_cpu.c2w)
        name = photographs.frame(view.frame).file_name
        cameras[name] = transform_camera_exactly(own, to_file)
    return cameras


def describe_edit(ready: Prepared, completion: Completion) -> dict[str, Any]:
    """Describe what was done for the record of edits: places, cameras, masks, photographs, models.

    Of each camera it also tells the share of its image that stayed empty.

    Places are in the coordinates of the splat's file, and cameras in the frame of the photographs.
    Paths are without their folders, which tell about the machine.
    """
    files = ready.opened.files
    settings = describe_settings(ready)
    place = {name: settings[name] for name in REGIONS if settings.get(name)}
    named = {name: settings[name] for name in NAMED_FILES if settings.get(name)}
    back = np.linalg.inv(ready.task.frame)
    cameras = [
        describe_camera(transform_camera_exactly(target.camera, back))
        for target in ready.task.targets
    ]
    empty = [round(1 - compute_covered_share([result.after]), 5) for result in completion.targets]
    return {
        **place,
        **{name: strip_folders(value) for name, value in named.items()},
        "cameras": cameras,
        EMPTY_SHARES: empty,
        "photographs": [files.get(frame) for frame in ready.task.context_frames],
        "reconstructor": strip_folders(ready.work.models.reconstructor),
        "generator": strip_folders(ready.work.models.generator),
    }


def strip_folders(value: str | Sequence[str]) -> str | list[str]:
    """Strip the folders of a path, or of several."""
    if isinstance(value, str):
        return Path(value).name
    return [Path(path).name for path in value]


def complete_targets(ready: Prepared) -> tuple[Completion, Prepared]:
    """Complete the scene for the named targets, or for targets that it finds.

    Then it is completed for those of earlier commands at which holes opened (decision 151).
    """
    task = ready.task

    # What photographs show is added when the completion begins, before any target.
    if ready.targets is None:
        completion = ready.begin()
        return completion, replace(ready, reopened=find_reopened(ready, completion))

    check_target_count(ready)
    if task.targets:
        completion = ready.completer.complete(ready.begin(), task.target_cameras)
    else:
        cameras = list(ready.cameras.values())
        completion, choices = ready.explorer.explore(ready.begin(), cameras, ready.max_targets)
        ready = ready.with_choices(choices)
    # A painter and the oracle have images of the named targets alone.
    if not makes_any_image(ready.work.models.generator):
        return completion, ready
    reopened = find_reopened(ready, completion)
    for target in track(reopened, "target of an earlier command"):
        completion = ready.completer.advance(completion, target.camera)
    return completion, ready.with_targets((*ready.task.targets, *reopened))


def check_target_count(ready: Prepared) -> None:
    """Raise InputError, before any is completed, if a .ply cannot tell all targets apart."""
    if ready.targets is not None:
        scene = ready.task.scene
        last = 0 if scene is None else find_last_target_id(scene)
        check_target_ids(last, len(ready.task.targets) or ready.max_targets)


def write_targets(folder: Path, task: CompletionTask) -> None:
    """Write the target cameras in the frame of the photographs, as `--target` reads them."""
    if task.targets:
        write_in_given_frame(folder / TARGETS_FILE, task, [t.camera for t in task.targets])


def write_chosen_cameras(folder: Path, opened: Opened, task: CompletionTask) -> None:
    """Write cameras that were not given: those of renders, and refined ones of photographs."""
    if opened.renders_from is not None:
        cameras = [view.camera for view in task.views]
        write_in_given_frame(folder / RENDERS_FILE, task, cameras)
    write_refined_poses(folder, opened)


def write_in_given_frame(path: Path, task: CompletionTask, cameras: Sequence[Camera]) -> None:
    """Write cameras of the result in the frame of the photographs, or of a splat alone."""
    # In float64, because coordinates of maps are large.
    back = np.linalg.inv(task.frame)
    write_cameras(path, [transform_camera_exactly(camera, back) for camera in cameras])
