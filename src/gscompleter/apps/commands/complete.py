"""The command `complete`: complete a scene and report the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.table import Table

from gscompleter.apps.commands.exploring import (
    collect_cameras,
    complete_targets,
    name_target,
    plan_completion,
    print_plan,
    render_looks_around,
    write_targets,
)
from gscompleter.apps.commands.options import CompleteOptions, get_max_targets
from gscompleter.apps.commands.output import (
    describe_opened,
    describe_settings,
    is_replaceable,
    read_held_out,
    report_interrupts,
)
from gscompleter.apps.inputs.opening import (
    Opened,
    Task,
    add_check_views,
    apply_working_range,
    check_context,
    check_scene,
    check_targets,
    move_to_splat,
    open_scene,
    print_lines,
    read_task,
)
from gscompleter.apps.inputs.plan import describe_task
from gscompleter.apps.report.completion import Surroundings, Target, write_report
from gscompleter.apps.report.completion_page import render_completion_page
from gscompleter.apps.report.film import VIDEO_FILE as FILM
from gscompleter.apps.report.film import write_comparison_video
from gscompleter.apps.report.page import REPORT_FILE as PAGE
from gscompleter.apps.report.page import write_page
from gscompleter.apps.report.plain_words import (
    NO_TARGET_NOTE,
    describe_exposures,
    describe_ignored,
    describe_motion,
)
from gscompleter.apps.warmup.compilation import SPLAT_PART, compile_kernels
from gscompleter.completer import Clock, GSCompleter, add_seconds
from gscompleter.config import CompleterConfig
from gscompleter.config.generators import get_settings_class
from gscompleter.generators import load_generator
from gscompleter.io.files import check_output, open_output_folder
from gscompleter.io.video import check_video_writer
from gscompleter.kernels.parallel import run_in_background
from gscompleter.next_best_view.planner import ViewPlanner
from gscompleter.progress import show_preparation, show_progress, stage
from gscompleter.reconstructors import check_reconstructor, load_reconstructor
from gscompleter.render import choose_device, load_renderer
from gscompleter.render.lod import MIN_PROXY_GAUSSIANS
from gscompleter.splats.formats import load_splat
from gscompleter.splats.morton import argsort_nearby
from gscompleter.state import Completion
from gscompleter.types import Camera, View


def run_completion(options: CompleteOptions) -> None:
    """Complete the scene, and print a summary."""
    with report_interrupts(options.out):
        if options.dry_run:
            plan_folder(options)
            return
        summary, completion = complete_folder(options)
        if not options.quiet:
            print_completion(summary, completion, options)


def complete_folder(options: CompleteOptions) -> tuple[dict[str, Any], Completion]:
    """Complete the scene, write `options.out`, and return the summary."""
    if options.video:
        check_video_writer()
    console = Console(stderr=True, quiet=options.quiet)
    with show_progress(None if options.quiet else console):
        opened, task, explorer, before = prepare_completion(options, console)
        print_lines(console, *describe_task(options, opened, task))
        cameras = collect_cameras(options, opened, task)
        with open_output_folder(options.out, is_replaceable(options)) as folder:
            completion, task = complete_targets(options, task, cameras, explorer)
            completion = replace(completion, seconds=add_seconds(completion.seconds, before))
            with stage("report"):
                done = Done(opened, task, cameras, completion)
                summary = write_done(folder, options, done, explorer)
                write_targets(folder, task)
            if options.video:
                photographs = list(cameras.values())
                write_comparison_video(folder, completion, photographs, explorer.completer.renderer)
    return summary, completion


@dataclass(frozen=True)
class Done:
    """A finished completion and its input."""

    opened: Opened
    task: Task
    cameras: Mapping[int, Camera]
    """Cameras of all usable photographs by frame, in the frame of the result."""
    completion: Completion


def write_done(
    folder: Path, options: CompleteOptions, done: Done, explorer: ViewPlanner
) -> dict[str, Any]:
    """Write all results but the targets and the video, and return the summary."""
    task, cameras = done.task, tuple(done.cameras.values())
    facts = describe_run(options, done.opened, task, task.views[0].image.device.type)
    with run_in_background(
        render_looks_around, options, done.completion, cameras, explorer
    ) as looks:
        summary = write_report(
            folder,
            done.completion,
            task.targets,
            explorer.completer,
            facts,
            task.splat_file,
            lambda: Surroundings(tuple(looks()), cameras),
            read_held_out(options, done.opened, task, done.cameras),
        )
    write_page(folder, render_completion_page(folder))
    return summary


def plan_folder(options: CompleteOptions) -> None:
    """Write the targets and print the plan, without completing the scene."""
    console = Console(stderr=True, quiet=options.quiet)
    with show_progress(None if options.quiet else console):
        opened, task, explorer, _ = prepare_completion(options, console)
        print_lines(console, *describe_task(options, opened, task))
        cameras = collect_cameras(options, opened, task)
        with open_output_folder(options.out, is_replaceable(options)) as folder:
            plan = plan_completion(options, task, cameras, explorer)
            write_targets(folder, plan.task)
    if not options.quiet:
        print_plan(options, plan)


def prepare_completion(
    options: CompleteOptions, console: Console
) -> tuple[Opened, Task, ViewPlanner, Mapping[str, float]]:
    """Open the scene and load the models; also returns the seconds that this took."""
    check_output(options.out, is_replaceable(options))
    check_context(options)
    check_targets(options)
    check_reconstructor(options.reconstructor)
    get_settings_class(options.synthesis.name)
    device = choose_device(options.device)
    opened = open_scene(options, console)
    if not options.config.ego_mask:
        opened = opened.keep_ego_vehicle()
    with show_preparation("reading photographs"):
        task = read_task(options, opened, device)
    parts = device, options.reconstructor, options.synthesis.name
    if options.scene is None:
        compile_kernels(parts)
    else:
        task = add_splat(task, options.scene, options, opened, parts)
    with show_preparation("loading models"):
        completer = load_completer(options, task.targets, device)
    clock = Clock()
    with show_preparation("depth range"), clock("context"):
        task = apply_working_range(task, completer.renderer)
    return opened, task, ViewPlanner(completer), clock.seconds


def add_splat(
    task: Task, path: Path, options: CompleteOptions, opened: Opened, parts: Sequence[str]
) -> Task:
    """Compile the kernels, and add the input splat to the task."""
    with show_preparation("reading the scene"):
        task = add_check_views(task, opened.photographs)
        given = load_splat(path, options.drop_nonfinite)
        if "cpu" in parts:
            check_scene(task, given)
    compile_kernels([*parts, *([SPLAT_PART] if "cpu" in parts else [])])
    with show_preparation("aligning the scene"):
        order = argsort_nearby(given) if len(given) >= MIN_PROXY_GAUSSIANS else None
        given = given if order is None else given[order]
        return move_to_splat(task, given, path, options, opened, order)


def describe_run(
    options: CompleteOptions, opened: Opened, task: Task, device: str
) -> dict[str, Any]:
    """Describe the input and the settings for `summary.json`."""
    auto = None if options.target else get_max_targets(options)
    targets = {"target": list(options.target), "auto": auto}
    return {
        "settings": describe_settings(
            options, get_stage_config(options), targets, describe_models(options)
        ),
        "seed": options.seed,
        "device": device,
        **describe_opened(options, opened, task),
    }


def load_completer(options: CompleteOptions, targets: Sequence[Target], device: str) -> GSCompleter:
    """Load the models of the options."""
    photographs = [
        View(target.photograph, target.camera, target.frame)
        for target in targets
        if target.photograph is not None
    ]
    generator = options.synthesis
    return GSCompleter(
        load_reconstructor(options.reconstructor, options.weights, device),
        load_generator(
            generator.name, options.seed, photographs, device, generator.make_settings()
        ),
        load_renderer(device),
        get_stage_config(options),
        options.seed,
    )


def get_stage_config(options: CompleteOptions) -> CompleterConfig:
    """Return the settings, changed by options that have a name of their own."""
    if not options.no_prune:
        return options.config
    settings = replace(options.config.trust_settings, prune=False)
    return replace(options.config, trust_settings=settings)


def describe_models(options: CompleteOptions) -> dict[str, Any]:
    """Describe the models for `summary.json`."""
    return {
        "reconstructor": options.reconstructor,
        "weights": None if options.weights is None else str(options.weights),
        **options.synthesis.describe(),
        "uses_target_photographs": options.synthesis.name == "oracle",
    }


def print_completion(
    summary: Mapping[str, Any], completion: Completion, options: CompleteOptions
) -> None:
    """Print the scores per camera, the notes, and the location of the results."""

    def cell(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    table = Table("camera", "hole", "PSNR before", "PSNR after", "added", box=None)
    for row in summary["context"]:
        name = f"context {row['frame']}"
        table.add_row(name, "", cell(row["psnr_before"]), cell(row["psnr_after"]), "")
    notes = []
    for row, target in zip(summary["targets"], completion.targets, strict=True):
        name = name_target(row["frame"], row["derived_from"])
        notes += [f"{name}: {note}" for note in target.notes]
        hole = f"{100 * row['hole_fraction']:.1f} %"
        scores = cell(row["psnr_before"]), cell(row["psnr_after"])
        table.add_row(name, hole, *scores, f"{len(target.added):,}")
    console = Console(highlight=False)
    console.print(table)
    for note in notes:
        console.print(note)
    gains = [row["exposure_gain"] for row in summary["context"]]
    contradicted = {row["frame"]: row["dynamic_fraction"] for row in summary["context"]}
    carried = describe_ignored(row["ignored"] for row in summary["context"])
    for sentence in filter(
        None, (describe_exposures(gains), describe_motion(contradicted), carried)
    ):
        console.print(sentence, soft_wrap=True)
    origin = summary["frame"]["origin"]
    if any(origin):
        console.print(
            f"The coordinates are very large, so the result has its origin at "
            f"{' '.join(map(str, origin))}; summary.json has the transform.",
            soft_wrap=True,
        )
    if not summary["targets"]:
        console.print(NO_TARGET_NOTE)
    elif options.video:
        console.print(f"Video: {options.out / FILM}", soft_wrap=True)
    covered = summary["coverage"]
    console.print(
        f"Coverage around the photographs: {100 * covered['before']:.1f} % before, "
        f"{100 * covered['after']:.1f} % after.",
        soft_wrap=True,
    )
    unused = summary["held_out"]
    if unused:
        before = fmean(row["psnr_before"] for row in unused)
        after = fmean(row["psnr_after"] for row in unused)
        console.print(
            f"Mean PSNR of {len(unused)} photographs that were not used: {before:.2f} dB before, "
            f"{after:.2f} dB after.",
            soft_wrap=True,
        )
    counts = summary["gaussians"]
    seconds = summary["seconds"]["total"]
    console.print(
        f"Added {counts['added']:,} Gaussians to {counts['context']:,} in {seconds:.1f} s: "
        f"{options.out / 'completed.ply'}",
        soft_wrap=True,
    )
    console.print(f"Report: {options.out / PAGE}", soft_wrap=True)
