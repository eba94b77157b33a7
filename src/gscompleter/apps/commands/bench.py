"""The command `bench`: measure completions and how their time grows."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from gscompleter.apps.bench.comparison import (
    OWN,
    check_bench_methods,
    measure_method,
    prepare_start,
)
from gscompleter.apps.bench.completions import PROCESS, measure_command, write_input_splat
from gscompleter.apps.bench.growth import Growth
from gscompleter.apps.bench.machine import describe_machine
from gscompleter.apps.bench.manifest import (
    BenchCase,
    Manifest,
    check_frames,
    get_size,
    make_series,
    read_manifest,
)
from gscompleter.apps.bench.plots import plot_growth
from gscompleter.apps.bench.report import Report, build_content, format_report
from gscompleter.apps.bench.rounds import BenchTask, measure_in_rounds
from gscompleter.apps.bench.samples import Sample, SampleSet
from gscompleter.apps.bench.yardstick import Yardstick
from gscompleter.apps.commands.demo import (
    BASELINE_M,
    get_motorcycle_cameras,
    move_right,
    write_motorcycle_scene,
)
from gscompleter.apps.commands.options import BenchOptions
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


@dataclass(frozen=True)
class Bench:
    """Shared input of all measurements."""

    options: BenchOptions
    device: str
    models: Models
    yardstick: Yardstick
    folder: Path
    """Folder for temporary scenes and results."""

    def complete(self, case: BenchCase) -> Sample:
        """Complete a case in a process of its own."""
        out = self.folder / "completion"
        scene = write_input_splat(case, self.folder, self.models, self.device)
        return measure_command(self.make_words(case, scene, out), out, self.yardstick)

    def make_words(self, case: BenchCase, scene: Path | None, out: Path) -> list[str]:
        """Write the command line that completes a case."""
        planes = {"--near": case.near, "--far": case.far, "--scene": scene}
        given = [(flag, value) for flag, value in planes.items() if value is not None]
        return [
            *("complete", str(case.scene), "--out", str(out), "--overwrite", "--quiet"),
            *("--context", *map(str, case.context), "--target", *map(str, case.targets)),
            *("--resolution", *map(str, case.resolution)),
            *("--device", self.device, "--seed", str(self.options.seed)),
            *(str(word) for pair in given for word in pair),
        ]


def run_bench(options: BenchOptions) -> None:
    """Measure the cases and methods, and print or write the tables."""
    check_bench_options(options)
    console = Console(stderr=True, quiet=options.quiet, highlight=False)
    with TemporaryDirectory(prefix="gscompleter-bench-") as temporary:
        manifest = select_cases(load_bench_manifest(options, Path(temporary)), options)
        with show_progress(None if options.quiet else console):
            with show_preparation("getting ready"):
                bench = prepare_bench(options, Path(temporary))
            report = run_measurements(bench, manifest, make_printer(console))
    if options.out is not None:
        write_bench(report, options.out, options.overwrite, console)
    print(json.dumps(build_content(report), indent=1) if options.json else format_report(report))


def check_bench_options(options: BenchOptions) -> None:
    """Refuse impossible options."""
    check_bench_methods(options.methods)
    if options.folder is not None and options.cases is not None:
        raise InputError("A scene and a file of cases are both named; name one.", "cases")
    if options.out is not None:
        check_output(options.out, options.overwrite)


def make_printer(console: Console) -> Callable[[str], None]:
    """Return a function that prints lines without markup."""
    return lambda line: console.print(line, markup=False, soft_wrap=True)


def load_bench_manifest(options: BenchOptions, folder: Path) -> Manifest:
    """Collect the cases of a file, a scene or the demo's pair."""
    if options.cases is not None:
        return read_manifest(options.cases)
    if options.folder is not None:
        case = make_scene_case(options, options.folder)
        return Manifest((case,), make_series(case))
    case = write_demo_case(options, folder / "motorcycle")
    return Manifest((replace(case, targets=case.targets[:1]),), make_series(case))


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


def run_measurements(bench: Bench, manifest: Manifest, tell: Callable[[str], None]) -> Report:
    """Run all measurements in rounds, after a first run that is not counted."""
    growing = [case for found in manifest.growth.values() for case in found]
    names = map_case_names([*manifest.cases, *growing])
    if not bench.options.quick:
        tell(f"{manifest.cases[0].name}: first run, not counted")
        with stage("warming up"):
            bench.complete(manifest.cases[0])
    methods = make_method_tasks(bench, manifest.cases[0])
    found = measure_in_rounds([*make_case_tasks(bench, names), *methods], tell)
    growth = [
        Growth(
            axis,
            tuple(get_size(axis, case) for case in cases),
            tuple(replace(found[names[remove_case_name(case)]], name=case.name) for case in cases),
        )
        for axis, cases in manifest.growth.items()
    ]
    return Report(
        describe_machine(bench.device),
        describe_bench_settings(bench),
        tuple(found[names[remove_case_name(case)]] for case in manifest.cases),
        tuple(remove_method_prefix(found[task.name]) for task in methods),
        tuple(growth),
    )


def map_case_names(cases: Sequence[BenchCase]) -> dict[BenchCase, str]:
    """Map each different case to the first of its names."""
    names: dict[BenchCase, str] = {}
    for case in cases:
        names.setdefault(remove_case_name(case), case.name)
    return names


def remove_case_name(case: BenchCase) -> BenchCase:
    """Remove the name of a case."""
    return replace(case, name="")


def make_case_tasks(bench: Bench, names: dict[BenchCase, str]) -> list[BenchTask]:
    """Create the tasks that complete cases through the command line."""
    repeats = get_repeats(bench.options)

    def task(case: BenchCase, name: str) -> BenchTask:
        return BenchTask(name, lambda: bench.complete(case), PROCESS, repeats)

    return [task(case, name) for case, name in names.items()]


METHOD_PREFIX = "method "


def make_method_tasks(bench: Bench, case: BenchCase) -> list[BenchTask]:
    """Create the tasks that compare methods at the first target of `case`."""
    if not bench.options.methods:
        return []
    start = prepare_start(case, bench.models, bench.device)
    if not bench.options.quick:
        with stage("warming up"), show_progress(None):
            measure_method("full", start, bench.yardstick)

    def task(name: str) -> BenchTask:
        repeats = get_repeats(bench.options)
        if name not in ("full", "autograd"):
            repeats = min(repeats, bench.options.baseline_repeats)
        return BenchTask(
            METHOD_PREFIX + name, lambda: measure_method(name, start, bench.yardstick), OWN, repeats
        )

    return [task(name) for name in dict.fromkeys(bench.options.methods)]


def remove_method_prefix(found: SampleSet) -> SampleSet:
    """Remove the prefix from the name of a measurement."""
    return replace(found, name=found.name.removeprefix(METHOD_PREFIX))


def get_repeats(options: BenchOptions) -> int:
    """Return the number of repetitions."""
    return 1 if options.quick else options.repeats


def describe_bench_settings(bench: Bench) -> dict[str, int | None]:
    """Describe the settings that determine the numbers."""
    options = bench.options
    return {
        "seed": options.seed,
        "repeats": get_repeats(options),
        "baseline_repeats": min(get_repeats(options), options.baseline_repeats),
        "baseline_iterations": bench.models.baseline_iterations,
    }


def write_bench(report: Report, out: Path, overwrite: bool, console: Console) -> None:
    """Write bench.json, tables.md and growth.png."""
    with open_output_folder(out, overwrite) as folder:
        (folder / "bench.json").write_text(json.dumps(build_content(report), indent=1) + "\n")
        (folder / "tables.md").write_text(format_report(report))
        if report.growth:
            try:
                plot_growth(folder / "growth.png", report.growth)
            except PlotsNotAvailable as missing:
                console.print(str(missing), markup=False)
