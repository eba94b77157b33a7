"""The commands `complete` and `report`: complete a scene and report the result."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from gscompleter.apps.commands.options import (
    CompleteOptions,
    ReportOptions,
    get_max_targets,
    parse_resolution,
)
from gscompleter.apps.commands.output import describe_run, read_held_out, refuse_results
from gscompleter.apps.inputs.opening import (
    CompletionTask,
    Opened,
    add_check_views,
    apply_scene_range,
    apply_splat_range,
    check_context,
    check_scene,
    check_target_files,
    check_targets,
    choose_working_size,
    describe_range_mismatch,
    describe_task,
    move_to_splat,
    open_scene,
    print_lines,
    read_task,
    resolve_scene,
)
from gscompleter.apps.inputs.selection import collect_usable_cameras
from gscompleter.apps.report.completion import GENERATED_FILE, Target, write_report
from gscompleter.apps.report.film import VIDEO_FILE, write_comparison_video
from gscompleter.apps.report.names import describe_offset
from gscompleter.apps.report.outcome import name_unused, select_testing
from gscompleter.apps.report.page import REPORT_FILE, write_completion_page
from gscompleter.apps.report.plain_words import (
    format_number,
    format_percent,
    group_target_notes,
    list_notes,
    list_shared_notes,
)
from gscompleter.apps.report.schema import (
    RECORD_FILE,
    CompletionSummary,
    average,
    read_summary,
)
from gscompleter.apps.warmup import SPLAT_PART, compile_kernels
from gscompleter.completer import GSCompleter, check_target_ids
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.editing.removal import restore_surroundings
from gscompleter.evaluation.metrics.coverage import render_pairs, sample_held_out_cameras
from gscompleter.generators import load_generator
from gscompleter.numerics.kernels.parallel import run_in_background
from gscompleter.planning.planner import Choice, ViewPlanner
from gscompleter.reconstructors import check_reconstructor, load_reconstructor
from gscompleter.render.device import choose_device
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import MIN_PROXY_GAUSSIANS
from gscompleter.splats.alignment.similarity import transform_camera, transform_camera_exactly
from gscompleter.splats.formats import load_splat
from gscompleter.splats.morton import argsort_nearby
from gscompleter.stages.context import prepare_single
from gscompleter.state import Completion
from gscompleter.system.errors import print_error, quote_value
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.video import find_ffmpeg
from gscompleter.system.files.writing import (
    COMPLETED_FILE,
    CONTEXT_FILE,
    REMOVED_FILE,
    SUMMARY_FILE,
    TARGETS_FILE,
)
from gscompleter.system.progress import show_preparation, show_progress, stage
from gscompleter.system.timing import add_seconds, record_seconds, timed_stage
from gscompleter.types import Camera

COMMAND = "complete"
RESULTS = (
    *(COMPLETED_FILE, CONTEXT_FILE, GENERATED_FILE, REMOVED_FILE, TARGETS_FILE),
    *(REPORT_FILE, RECORD_FILE, SUMMARY_FILE, VIDEO_FILE, "images/target*.png"),
)
"""Globs of the files that a completion may write."""


@dataclass(frozen=True)
class Prepared:
    """Everything that is loaded before the first completion."""

    options: CompleteOptions
    opened: Opened
    task: CompletionTask
    explorer: ViewPlanner
    cameras: Mapping[int, Camera]
    """Cameras of all usable photographs by frame, in the frame of the result."""
    seconds: Mapping[str, float]

    @property
    def completer(self) -> GSCompleter:
        """The completer with its models."""
        return self.explorer.completer

    def begin(self) -> Completion:
        """Initialize the context."""
        task = self.task
        return self.completer.begin(task.views, task.scene, task.check_views, task.target_cameras)

    # `PreparedRemoval` adds the selection to them.
    def describe_settings(self) -> dict[str, Any]:
        """Describe the settings of targets and models for `summary.json`."""
        return describe_settings(self.options)

    def with_choices(self, choices: Iterable[Choice]) -> Prepared:
        """Return a copy with chosen candidates as targets."""
        # A candidate counts its photograph among the usable ones, where a target names its frame.
        frames = list(self.cameras)
        targets = []
        for choice in choices:
            frame = frames[choice.candidate.base]
            offset = describe_offset(choice.camera, self.cameras[frame])
            targets.append(Target(choice.camera, derived_from=frame, offset=offset))
        return replace(self, task=replace(self.task, targets=targets))


def check_completion_inputs(options: CompleteOptions, device: str) -> None:
    """Read what can be read without the cameras of the photographs, and refuse it if it is wrong.

    It takes seconds, and the search for cameras after it minutes.
    """
    load_completer(options, (), device)
    check_target_files(options)
    if options.scene is not None:
        load_splat(options.scene, options.drop_nonfinite)


def prepare_completion(options: CompleteOptions, console: Console) -> Prepared:
    """Open the scene and load the models."""
    # First what is wrong whatever the scene is.
    check_context(options)
    check_targets(options)
    check_reconstructor(options.reconstructor)
    options.synthesis.make_settings()

    device = choose_device(options.device)
    options = resolve_scene(options)
    opened = open_scene(options, console, partial(check_completion_inputs, options, device))
    options = choose_working_size(options, opened.photographs, console)
    if not options.config.ego_mask:
        opened = replace(opened, photographs=opened.photographs.keep_ego_vehicle())
    with show_preparation("reading photographs"):
        task = read_task(options, opened, device)

    parts = (device, options.reconstructor, options.synthesis.generator)
    if options.scene is None:
        compile_kernels(parts)
    else:
        task = add_splat(task, options.scene, options, opened, parts)

    # Only here, because the oracle is given the photographs of the targets.
    with show_preparation("loading models"):
        completer = load_completer(options, task.targets, device)
    reconstructor = completer.reconstructor

    # A single photograph has no stereo, so a network predicts its depth; a splat needs neither.
    if options.scene is None:
        task = replace(task, views=prepare_single(reconstructor, task.views))

    # The depth range is counted as a part of the context stage, whose seconds it is added to.
    with show_preparation("depth range"), record_seconds() as seconds, timed_stage("context"):
        if task.scene is None:
            task = apply_scene_range(task, reconstructor)
        else:
            task = apply_splat_range(task, task.scene, completer.renderer)
    print_lines(console, *describe_range_mismatch(task, reconstructor))

    cameras = collect_cameras(options, opened, task)
    return Prepared(options, opened, task, ViewPlanner(completer), cameras, seconds)


Prepare = Callable[[Any, Console], Prepared]
"""Opens the input of a command, whose options it takes, and loads the models."""


def run_completion(options: CompleteOptions, prepare: Prepare = prepare_completion) -> None:
    """Complete the scene, and print a summary. Exit code 1 if the scene did not reconstruct."""
    if options.dry_run:
        plan_folder(options, prepare)
        return
    complete_folder(options, prepare)
    outcome = read_summary(options.out).outcome
    if not options.quiet:
        print_completion(options)
    if outcome.status == "not-reconstructed":
        if options.quiet:
            print_error(outcome.headline)
        sys.exit(1)


def run_report(options: ReportOptions) -> None:
    """Write `report.html` and print its path."""
    write_completion_page(options.out)
    if not options.quiet:
        print(options.out / REPORT_FILE)


def complete_folder(
    options: CompleteOptions, prepare: Prepare = prepare_completion, takes_over: bool = False
) -> dict[str, Any]:
    """Complete the scene, write `options.out`, and return the summary."""
    # A missing ffmpeg ends the command at its beginning, not after the completion.
    if options.video:
        find_ffmpeg()
    with open_completion(options, prepare, takes_over) as (ready, folder):
        completion, ready = complete_targets(ready)

        # Frozen views of the scene take memory, and the report does not use them.
        ready.completer.scenes.clear()
        with stage("report"):
            summary = write_done(folder, ready, completion)
            write_targets(folder, ready.task)
        if options.video:
            photographs = list(ready.cameras.values())
            write_comparison_video(folder, completion, photographs, ready.completer.renderer)
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
            choices = ready.explorer.plan(begun, cameras, get_max_targets(ready.options))
            ready = ready.with_choices(choices)
            holes = [choice.hole_fraction for choice in choices]
        write_targets(folder, ready.task)
    if not options.quiet:
        print_plan(options, ready.opened, ready.task.targets, holes)


@contextmanager
def open_completion(
    options: CompleteOptions, prepare: Prepare, takes_over: bool = False
) -> Iterator[tuple[Prepared, Path]]:
    """Reserve the output folder, load everything, print the input, and open the folder.

    `takes_over` is that of `reserve_output`.
    """
    console = Console(stderr=True, quiet=options.quiet)
    with (
        show_progress(console),
        reserve_output(options.out, options.overwrite, COMMAND, RESULTS, takes_over) as output,
    ):
        if options.dry_run:
            refuse_results(options.out)
        print_lines(console, *output.describe_others())
        ready = prepare(options, console)
        print_lines(console, *describe_task(options, ready.opened, ready.task))
        with output.write() as folder:
            yield ready, folder


def write_done(folder: Path, ready: Prepared, completion: Completion) -> dict[str, Any]:
    """Write all results but the targets and the video, and return the summary."""
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
            read_held_out(options, ready.opened, task, ready.cameras),
            ready.opened.files,
        )
    write_completion_page(folder)
    return summary


def add_splat(
    task: CompletionTask, path: Path, options: CompleteOptions, opened: Opened, parts: Sequence[str]
) -> CompletionTask:
    """Compile the kernels, and add the input splat to the task."""
    with show_preparation("reading the scene"):
        task = add_check_views(task, opened.photographs)
        gaussians = load_splat(path, options.drop_nonfinite)
        if "cpu" in parts:
            check_scene(task, gaussians)
    compile_kernels([*parts, SPLAT_PART] if "cpu" in parts else parts)

    with show_preparation("aligning the scene"):
        # Gaussians of a file lie in random order, and each tile of an image would read memory all
        # over. Large scenes are sorted along a Morton curve (decision 025); files are written in
        # the order of the given file, which `order` leads back to.
        order = None
        if len(gaussians) >= MIN_PROXY_GAUSSIANS:
            order = argsort_nearby(gaussians)
            gaussians = gaussians[order]
        return move_to_splat(task, gaussians, path, options, opened, order)


def describe_settings(options: CompleteOptions) -> dict[str, Any]:
    """Describe the settings of targets and models for `summary.json`."""
    return {
        "target": list(options.target),
        "auto": None if options.target else get_max_targets(options),
        "reconstructor": options.reconstructor,
        "weights": None if options.weights is None else str(options.weights),
        "depth": options.depth,
        **options.synthesis.describe(),
        "uses_target_photographs": options.synthesis.generator == "oracle",
    }


def load_completer(options: CompleteOptions, targets: Sequence[Target], device: str) -> GSCompleter:
    """Load the models of the options."""
    # Only the oracle reads the photographs of the targets.
    photographs = [target.view for target in targets if target.view is not None]
    synthesis = options.synthesis
    config = options.config
    if options.no_recolor:
        config = replace(config, recolor=replace(config.recolor, iterations=0))
    return GSCompleter(
        load_reconstructor(
            options.reconstructor, options.weights, device, options.depth, options.depth_weights
        ),
        load_generator(
            synthesis.generator, options.seed, photographs, device, synthesis.make_settings()
        ),
        load_renderer(device),
        config,
        options.seed,
    )


def print_completion(options: CompleteOptions) -> None:
    """Print the scores per camera, the notes, and the location of the results."""
    console = Console(highlight=False)
    summary = read_summary(options.out)
    console.print(summary.outcome.headline, markup=False, soft_wrap=True)
    console.print(make_score_table(summary))

    # What holds for several targets is said once, before the notes of each. If nothing was gained,
    # the headline gives the reason for all.
    sentences = list(list_shared_notes(summary))
    if summary.outcome.status != "nothing-gained":
        for notes, numbers in group_target_notes(summary.targets).items():
            if len(numbers) == 1:
                name = summary.targets[numbers[0] - 1].name
                sentences.append(f"{name}: {' '.join(notes)}")
    sentences += describe_result(summary, options)
    for sentence in sentences:
        console.print(sentence, markup=False, soft_wrap=True)


def make_score_table(summary: CompletionSummary) -> Table:
    """Make the table of PSNR before and after at each camera."""
    table = Table("camera", "hole", "PSNR before", "PSNR after", "added", box=None)
    # Photographs of the context have neither a hole nor Gaussians of their own.
    for row in summary.context:
        before = format_number(row.psnr_before)
        after = format_number(row.psnr_after)
        table.add_row(f"context {row.photograph}", "", before, after, "")
    for target in summary.targets:
        before = format_number(target.psnr_before)
        after = format_number(target.psnr_after)
        hole = format_percent(target.hole_fraction)
        table.add_row(f"target: {target.name}", hole, before, after, f"{target.added:,}")
    return table


def describe_result(summary: CompletionSummary, options: CompleteOptions) -> Iterator[str]:
    """Write the sentences below the table."""
    yield from list_notes(summary)

    # Under photometric trust covered is not enough: photographs have to confirm what covers.
    share = "Trusted" if summary.settings["config"]["trust"] == "photometric" else "Coverage"
    before = format_percent(summary.coverage.before)
    after = format_percent(summary.coverage.after)
    yield f"{share} around the photographs: {before} before, {after} after."

    rows = select_testing(summary.held_out)
    if rows:
        at_first = format_percent(average(row.covered_before for row in rows))
        at_last = format_percent(average(row.covered_after for row in rows))
        yield f"Covered of {name_unused(rows)}: {at_first} before, {at_last} after."

    counts = summary.gaussians
    seconds = summary.seconds["total"]
    yield (
        f"Added {counts['added']:,} Gaussians to {counts['context']:,} in {seconds:.1f} s: "
        f"{options.out / COMPLETED_FILE}"
    )
    yield f"Report: {options.out / REPORT_FILE}"
    if options.video and summary.targets:
        yield f"Video: {options.out / VIDEO_FILE}"


def collect_cameras(
    options: CompleteOptions, opened: Opened, task: CompletionTask
) -> dict[int, Camera]:
    """Return the cameras of all usable photographs by frame, in the frame of the result."""
    photographs = opened.photographs
    cameras = collect_usable_cameras(
        photographs, range(len(photographs)), parse_resolution(options.resolution)
    )

    # Photographs are read relative to their local origin. `task.frame` begins at their own frame,
    # so the shift is undone before it.
    transform = task.frame @ compute_frame_from_photographs(-photographs.origin)

    # One depth range for all: that of the context, which was measured in the frame of the result.
    context_camera = task.views[0].camera
    near = context_camera.near
    far = context_camera.far
    return {
        frame: replace(transform_camera(camera, transform).to(task.device), near=near, far=far)
        for frame, camera in cameras.items()
    }


def complete_targets(ready: Prepared) -> tuple[Completion, Prepared]:
    """Complete the scene for the named targets, or for targets that it finds."""
    task = ready.task
    count = get_max_targets(ready.options)

    # Too many targets for the labels of a .ply are refused before the first one is completed.
    if task.targets:
        check_target_ids(task.scene, len(task.targets))
        return ready.completer.complete(ready.begin(), task.target_cameras), ready
    check_target_ids(task.scene, count)
    cameras = list(ready.cameras.values())
    completion, choices = ready.explorer.explore(ready.begin(), cameras, count)
    return completion, ready.with_choices(choices)


def print_plan(
    options: CompleteOptions, opened: Opened, targets: Sequence[Target], holes: Sequence[float]
) -> None:
    """Print the targets and their holes."""
    console = Console(highlight=False)
    if not targets:
        console.print("No camera has much to gain; there is nothing to complete.")
        return
    table = Table("camera", "hole", box=None)
    for number, (target, hole) in enumerate(zip(targets, holes, strict=True), 1):
        table.add_row(f"{number}: {opened.name_target(target)}", format_percent(hole))
    console.print(table)
    console.print(f"Edit the cameras in {quote_value(options.out / TARGETS_FILE)}.", soft_wrap=True)


def write_targets(folder: Path, task: CompletionTask) -> None:
    """Write the target cameras in the frame of the photographs, as `--target` reads them."""
    if task.targets:
        # In float64, because coordinates of maps are large.
        back = np.linalg.inv(task.frame)
        cameras = [transform_camera_exactly(target.camera, back) for target in task.targets]
        write_cameras(folder / TARGETS_FILE, cameras)
