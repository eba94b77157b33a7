"""The command `bench`: measure completions and how their time grows."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from gscompleter.apps.bench.cases import (
    BenchCase,
    Manifest,
    check_frames,
    get_size,
    make_default_series,
    read_manifest,
    write_input_splat,
)
from gscompleter.apps.bench.machine import describe_machine
from gscompleter.apps.bench.measure import (
    OWN,
    PROCESS,
    BenchTask,
    Sample,
    Yardstick,
    measure_command,
    measure_in_rounds,
    measure_method,
)
from gscompleter.apps.bench.report import (
    Report,
    Spread,
    fit_growth,
    format_report,
    plot_growth,
    summarize,
)
from gscompleter.apps.commands.demo import (
    BASELINE_M,
    get_motorcycle_cameras,
    move_right,
    write_motorcycle_scene,
)
from gscompleter.apps.commands.options import BenchOptions
from gscompleter.apps.inputs.opening import print_lines
from gscompleter.data.scene import write_cameras
from gscompleter.errors import InputError, quote_value
from gscompleter.evaluation.methods import Models
from gscompleter.evaluation.plots import PlotsNotAvailable
from gscompleter.generators import load_generator
from gscompleter.io.files import check_output, open_output_folder
from gscompleter.progress import show_preparation, show_progress, stage
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render import choose_device, load_renderer

BEYOND = (1.0, 1.25, 1.5, 1.75)
"""Distances of the demo's targets from its two cameras, in baselines."""
QUICK_ITERATIONS = 2
FAST_METHODS = ("full", "autograd")


@dataclass(frozen=True)
class Bench:
    """Shared input of all measurements."""

    options: BenchOptions
    device: str
    models: Models
    yardstick: Yardstick
    folder: Path
    """Folder for temporary scenes and results."""

    @property
    def repeats(self) -> int:
        """Number of repetitions."""
        return 1 if self.options.quick else self.options.repeats

    @property
    def baseline_repeats(self) -> int:
        """Number of repetitions of slow methods."""
        return min(self.repeats, self.options.baseline_repeats)

    def complete(self, case: BenchCase) -> Sample:
        """Complete a case in a process of its own."""
        out = self.folder / "completion"
        scene = write_input_splat(case, self.folder, self.models, self.device)
        given = {"--near": case.near, "--far": case.far, "--scene": scene}
        words = [
            *("complete", case.scene, "--out", out, "--overwrite", "--quiet"),
            *("--context", *case.context, "--target", *case.targets),
            *("--resolution", *case.resolution),
            *("--device", self.device, "--seed", self.options.seed),
            *(word for pair in given.items() if pair[1] is not None for word in pair),
        ]
        return measure_command([str(word) for word in words], out, self.yardstick)


def run_bench(options: BenchOptions) -> None:
    """Measure the cases and methods, and print or write the tables."""
    if options.folder is not None and options.cases is not None:
        raise InputError("A scene and a file of cases are both named; name one.", "cases")
    if options.out is not None:
        check_output(options.out, options.overwrite)
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    with TemporaryDirectory(prefix="gscompleter-bench-") as temporary:
        manifest = select_cases(load_bench_manifest(options, Path(temporary)), options)
        with show_progress(None if options.quiet else console):
            with show_preparation("getting ready"):
                bench = prepare_bench(options, Path(temporary))
            report = run_measurements(bench, manifest, partial(print_lines, console))
    if options.out is not None:
        write_bench(report, options.out, options.overwrite, console)
    print(format_json(report) if options.json else format_report(report))


def load_bench_manifest(options: BenchOptions, folder: Path) -> Manifest:
    """Collect the cases of a file, a scene or the demo's pair."""
    if options.cases is not None:
        return read_manifest(options.cases)
    if options.folder is not None:
        case = make_scene_case(options, options.folder)
        return Manifest((case,), make_default_series(case))
    case = write_demo_case(options, folder / "motorcycle")
    return Manifest((replace(case, targets=case.targets[:1]),), make_default_series(case))


def make_scene_case(options: BenchOptions, scene: Path) -> BenchCase:
    """Create the case of a scene."""
    if not options.context or not options.target:
        raise InputError(
            "A scene needs context frames and targets; name them, as in --context 0 4 --target 8.",
        )
    name = scene.resolve().name
    planes = options.near, options.far
    return BenchCase(name, scene, options.context, options.target, options.resolution, *planes)


def write_demo_case(options: BenchOptions, folder: Path) -> BenchCase:
    """Write the demo's pair to `folder` with targets beyond its cameras."""
    write_motorcycle_scene(folder)
    left, right = get_motorcycle_cameras(741, 500)
    beyond = [
        move_right(camera, side * step * BASELINE_M)
        for step in BEYOND
        for camera, side in ((left, -1), (right, 1))
    ]
    names = ["images/left.png", "images/right.png"]
    names += [f"images/unseen_{number}.png" for number in range(len(beyond))]
    write_cameras(folder / "transforms.json", [left, right, *beyond], names)
    targets = tuple(range(2, 2 + len(beyond)))
    return BenchCase("motorcycle", folder, (0, 1), targets, options.resolution)


def select_cases(manifest: Manifest, options: BenchOptions) -> Manifest:
    """Select the cases of the options, and check their frames."""
    cases = [case for case in manifest.cases if not options.only or case.name in options.only]
    unknown = set(options.only) - {case.name for case in cases}
    if unknown:
        known = ", ".join(case.name for case in manifest.cases)
        raise InputError(
            f"There is no case '{quote_value(min(unknown))}' to measure; choose one of {known}.",
            "only",
        )
    axes: set[str] = set() if options.quick else {*options.growth}
    growth = {axis: found for axis, found in manifest.growth.items() if axis in axes}
    if options.quick:
        cases = [min(cases, key=lambda case: (case.gaussians or 0, case.pixels))]
    check_frames([*cases, *(case for found in growth.values() for case in found)])
    return Manifest(tuple(cases), growth)


def prepare_bench(options: BenchOptions, folder: Path) -> Bench:
    """Load the models and the yardstick, compiled."""
    device = choose_device(options.device)
    renderer = load_renderer(device)
    models = Models(
        load_reconstructor("plane-sweep", None, device),
        load_generator("warp-inpaint", options.seed, device=device),
        renderer,
        options.seed,
        QUICK_ITERATIONS if options.quick else None,
    )
    return Bench(options, device, models, Yardstick.create(renderer, device), folder)


def run_measurements(bench: Bench, manifest: Manifest, print_line: Callable[[str], None]) -> Report:
    """Run all measurements in rounds, after a first run that is not counted."""
    options, first = bench.options, manifest.cases[0]
    if not options.quick:
        print_line(f"{first.name}: first run, not counted")
        with stage("warming up"):
            bench.complete(first)
    growing = [case for series in manifest.growth.values() for case in series]
    cases = make_case_tasks(bench, [*manifest.cases, *growing])
    methods = make_method_tasks(bench, first) if options.methods else {}
    samples = measure_in_rounds({**cases, **methods}, print_line)
    yardsticks = [sample.yardstick for found in samples.values() for sample in found]
    return Report(
        describe_machine(bench.device),
        {
            "seed": options.seed,
            "repeats": bench.repeats,
            "baseline_repeats": bench.baseline_repeats,
            "baseline_iterations": bench.models.baseline_iterations,
        },
        Spread.from_values(yardsticks),
        [summarize(case.name, samples[case]) for case in manifest.cases],
        [summarize(name, samples[name]) for name in dict.fromkeys(options.methods)],
        [
            fit_growth(
                axis,
                [get_size(axis, case) for case in series],
                [summarize(case.name, samples[case]) for case in series],
            )
            for axis, series in manifest.growth.items()
        ],
    )


def make_case_tasks(bench: Bench, cases: Sequence[BenchCase]) -> dict[BenchCase | str, BenchTask]:
    """Create the task of each different case, through the command line."""
    return {
        case: BenchTask(case.name, partial(bench.complete, case), PROCESS, bench.repeats)
        for case in dict.fromkeys(cases)
    }


def make_method_tasks(bench: Bench, case: BenchCase) -> dict[BenchCase | str, BenchTask]:
    """Create the tasks that compare methods at the first target of `case`."""
    options = bench.options
    state = case.begin(bench.models, bench.device)
    target = case.open().camera(case.targets[0], case.resolution).to(bench.device)
    start = state, target, bench.models, bench.yardstick
    if not options.quick:
        with stage("warming up"), show_progress(None):
            measure_method("full", *start)
    tasks: dict[BenchCase | str, BenchTask] = {}
    for name in options.methods:
        repeats = bench.repeats if name in FAST_METHODS else bench.baseline_repeats
        measure = partial(measure_method, name, *start)
        tasks[name] = BenchTask(f"method {name}", measure, OWN, repeats)
    return tasks


def format_json(report: Report) -> str:
    """Format the report as JSON, in seconds, bytes and yardsticks (`ratios`)."""
    return json.dumps(asdict(report), indent=1)


def write_bench(report: Report, out: Path, overwrite: bool, console: Console) -> None:
    """Write bench.json, tables.md and growth.png."""
    with open_output_folder(out, overwrite) as folder:
        (folder / "bench.json").write_text(format_json(report) + "\n")
        (folder / "tables.md").write_text(format_report(report))
        if report.growth:
            try:
                plot_growth(folder / "growth.png", report.growth)
            except PlotsNotAvailable as missing:
                print_lines(console, str(missing))
