"""Measure how long completions take on this machine, and how the time grows.

    python benchmarks/measure_completions.py [--cases benchmarks/performance.json] [--out OUT]
    python benchmarks/measure_completions.py --quick

Every completion is a process of its own, start-up included. Times are also given relative to one
pass of the renderer, forward and backward, with 196,608 Gaussians at 256 x 256. Without cases the
pair of `gscompleter demo` is measured.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import tyro
from annotated_types import Interval

from completions.cases import (
    BenchCase,
    GrowthValues,
    Manifest,
    Series,
    check_frames,
    copy_photographs,
    read_manifest,
    write_input_splat,
)
from completions.generators import compare_generators, format_generators
from completions.measure import (
    Sample,
    Yardstick,
    make_yardstick,
    measure_call,
    measure_command,
    measure_in_rounds,
)
from completions.report import Measured, Report, format_report
from gscompleter.config.settings import Device, Seed, Settings, validate
from gscompleter.data.demo_scene import (
    BASELINE_M,
    get_motorcycle_cameras,
    move_right,
    write_motorcycle_scene,
)
from gscompleter.data.scene import write_cameras
from gscompleter.evaluation.methods import Models
from gscompleter.generators import load_generator
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render.device import choose_device
from gscompleter.render.loading import load_renderer
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, print_error
from gscompleter.system.files.output_folder import check_output, open_output_folder
from gscompleter.system.machine import describe_machine
from gscompleter.system.progress import show_preparation, show_progress, stage

BEYOND = (1.0, 1.25, 1.5, 1.75)
"""Distances of targets to the right of the demo's right camera, in baselines."""
DEMO_GROWTH = GrowthValues(
    gaussians=(250_000, 500_000, 1_000_000, 2_000_000),
    pixels=((128, 128), (256, 256), (512, 512)),
    targets=((2,), (2, 3), (2, 3, 4, 5)),
)
WRONG_INPUT = 2
"""Exit code of wrong input, as that of the commands."""

Axis = Literal["gaussians", "pixels", "views", "targets"]


@dataclass(frozen=True, kw_only=True)
class Options(Settings):
    """Measure how long completions take on this machine, and how the time grows."""

    cases: Path | None = None
    """JSON file of scenes with their frames and growth series, as benchmarks/performance.json."""
    in_process: bool = False
    """Run all completions in this process, as a program does that uses the library."""
    generators: tuple[str, ...] = ()
    """Compare these generators instead, at the first target of each case: seconds, and scores in
    holes."""
    growth: tuple[Axis, ...] = ("gaussians", "pixels", "views", "targets")
    """Quantities to increase in the first case."""
    repeats: Annotated[int, Interval(ge=1, le=1000)] = 5
    """Number of repetitions."""
    quick: bool = False
    """Run a quick check: the smallest case once, no growth."""
    device: Device = "auto"
    """Device to compute on."""
    seed: Seed = 0
    """Seed of all random numbers."""
    out: Path | None = None
    """Folder to write bench.json and tables.md to."""
    overwrite: bool = False
    """Replace the files that an earlier run wrote there."""
    quiet: bool = False
    """Show no progress."""
    json: bool = False
    """Print the measurements as JSON."""


def main(words: Sequence[str] | None = None) -> int:
    """Measure what the words of the command line ask for, and return the exit code."""
    options = tyro.cli(Options, args=words, config=(tyro.conf.FlagCreatePairsOff,))
    try:
        measure_completions(validate(options))
    except InputError as error:
        print_error(str(error))
        return WRONG_INPUT
    return 0


@dataclass(frozen=True)
class Bench:
    """Shared input of all measurements."""

    options: Options
    device: str
    models: Models
    yardstick: Yardstick
    folder: Path
    """Folder for temporary scenes and results."""

    def complete(self, case: BenchCase) -> Sample:
        """Complete a case, in a process of its own unless all share this one."""
        scene = write_input_splat(case, self.folder, self.models, self.device)
        if case.splat is not None:
            with TemporaryDirectory(dir=self.folder) as own:
                return self.run(copy_photographs(case, Path(own)), scene)
        return self.run(case, scene)

    def run(self, case: BenchCase, scene: Path | None) -> Sample:
        """Complete the photographs of a case, or the splat in the file `scene`."""
        out = self.folder / "completion"
        if self.options.in_process:
            call = partial(case.complete, self.models, self.device, scene)
            return measure_call(call, self.device, self.yardstick)

        words: list[object] = ["complete", case.scene, "--out", out, "--overwrite", "--quiet"]
        words += ["--context", *case.context, "--target", *case.targets]
        words += ["--resolution", *case.resolution]
        words += ["--device", self.device, "--seed", self.options.seed]
        for option, value in (("--near", case.near), ("--far", case.far), ("--scene", scene)):
            if value is not None:
                words += [option, value]
        return measure_command([str(word) for word in words], out, self.yardstick)


def measure_completions(options: Options) -> None:
    """Measure the cases, and print or write the tables."""
    if options.out is not None:
        check_output(options.out, options.overwrite)
    if options.quick:
        options = replace(options, repeats=1, growth=())
    with TemporaryDirectory(prefix="gscompleter-bench-") as temporary:
        manifest = load_manifest(options, Path(temporary) / "motorcycle")
        cases = list(manifest.cases)
        series = manifest.make_series(options.growth)
        if options.quick:
            cases = [min(cases, key=lambda case: (case.gaussians or 0, case.pixels))]

        # A missing frame is reported before minutes of measurements, not in the middle of them.
        check_frames([*cases, *list_grown_cases(series)])
        with show_progress(None if options.quiet else make_console(stderr=True)):
            with show_preparation("getting ready"):
                bench = prepare_bench(options, Path(temporary))
            if options.generators:
                fillings = compare_generators(options.generators, cases, bench.models, bench.device)
                values = {name: [asdict(one) for one in own] for name, own in fillings.items()}
                write_results(values, format_generators(fillings), options)
                return
            report = run_measurements(bench, cases, series)
    write_results(asdict(report), format_report(report), options)


def list_grown_cases(series: Series) -> list[BenchCase]:
    """List the cases of all axes of growth."""
    return [case for grown in series.values() for case in grown.values()]


def write_results(values: dict[str, Any], tables: str, options: Options) -> None:
    """Print the tables or JSON, and write both to the output folder."""
    text = json.dumps(values, indent=1)
    if options.out is not None:
        with open_output_folder(options.out, options.overwrite, "bench") as folder:
            (folder / "bench.json").write_bytes(text.encode() + b"\n")
            (folder / "tables.md").write_bytes(tables.encode())
    print(text if options.json else tables)


def load_manifest(options: Options, folder: Path) -> Manifest:
    """Read the cases of a file, or write the demo's pair to `folder`."""
    if options.cases is not None:
        return read_manifest(options.cases)

    write_motorcycle_scene(folder)
    # Width and height of the pair in pixels. Targets have no photograph: they lie beyond the right
    # camera, each a quarter of a baseline farther than the one before it.
    left, right = get_motorcycle_cameras(741, 500)
    beyond = [move_right(right, step * BASELINE_M) for step in BEYOND]
    names = [f"images/{name}.png" for name in ("left", "right", *BEYOND)]
    write_cameras(folder / "transforms.json", [left, right, *beyond], names)
    return Manifest((BenchCase("motorcycle", folder, (0, 1), (2,), (256, 256)),), DEMO_GROWTH)


def prepare_bench(options: Options, folder: Path) -> Bench:
    """Load the models and the yardstick, compiled."""
    device = choose_device(options.device)
    renderer = load_renderer(device)
    models = Models(
        load_reconstructor("plane-sweep", None, device),
        load_generator("warp-inpaint", options.seed, device=device),
        renderer,
        options.seed,
    )
    return Bench(options, device, models, make_yardstick(renderer, device), folder)


def run_measurements(bench: Bench, cases: Sequence[BenchCase], series: Series) -> Report:
    """Run all measurements in rounds, after a first run that is not counted."""
    options = bench.options

    # The first completion also fills the caches of kernels and files for the later ones.
    if not options.quick:
        with stage("warming up"):
            bench.complete(cases[0])

    # Cases that differ only in their names are equal, and so are measured once.
    tasks = {case: partial(bench.complete, case) for case in (*cases, *list_grown_cases(series))}
    samples = measure_in_rounds(tasks, options.repeats)
    return Report(
        describe_machine(bench.device),
        {"seed": options.seed, "repeats": options.repeats, "in_process": options.in_process},
        [Measured(case.name, samples[case]) for case in cases],
        {
            axis: {size: Measured(f"{size:,}", samples[case]) for size, case in grown.items()}
            for axis, grown in series.items()
        },
    )


if __name__ == "__main__":
    sys.exit(main())
