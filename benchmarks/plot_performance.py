"""Figures of docs/performance.md: where the seconds of a command go, and how they grow.

python benchmarks/measure_completions.py --cases benchmarks/growth.json --out OUT
python benchmarks/plot_performance.py --bench OUT/bench.json
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from completions.cases import BenchCase, read_manifest
from completions.report import fit_exponent

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("context", "generate", "lift", "register", "integrate")
LIBRARIES = ("torch", "numba", "scipy", "gscompleter")
TITLES = {
    "gaussians": "Gaussians of an input splat",
    "pixels": "pixels of an image",
    "views": "photographs",
    "targets": "targets",
}


@dataclass(frozen=True)
class Options:
    bench: Path
    """JSON file of `measure_completions.py` with growth."""
    cases: Path = ROOT / "benchmarks" / "performance.json"
    """Cases, of which the first is profiled."""
    out: Path = ROOT / "docs"
    """Folder of profile.png and growth.png."""


def profile_command(case: BenchCase) -> dict[str, float]:
    """Return the seconds of a command by part: imports, stages, and the rest."""
    with TemporaryDirectory() as out:
        words = [
            *("complete", case.scene, "--out", out, "--overwrite", "--quiet"),
            *("--context", *case.context, "--target", *case.targets),
            *("--resolution", *case.resolution, "--near", case.near, "--far", case.far),
        ]
        program = "from gscompleter.cli import run; run()"
        command = [sys.executable, "-X", "importtime", "-c", program, *map(str, words)]
        start = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        wall = time.perf_counter() - start
        stages = json.loads((Path(out) / "summary.json").read_text())["seconds"]
    found = dict.fromkeys((*LIBRARIES, "other packages"), 0.0)
    for own, name in re.findall(r"^import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)$", done.stderr, re.M):
        package = name.split(".")[0]
        found[package if package in LIBRARIES else "other packages"] += int(own) / 1e6
    parts = {f"import {name}": seconds for name, seconds in found.items()}
    parts |= {stage: stages[stage] for stage in STAGES}
    return parts | {"options, photographs, report, files": wall - sum(parts.values())}


def draw_profile(parts: dict[str, float], path: Path) -> None:
    """Draw the parts of a command one after the other, as one bar each."""
    figure = Figure(figsize=(7, 3.4), layout="constrained")
    axes = figure.subplots()
    start = 0.0
    for name, seconds in parts.items():
        axes.barh(name, seconds, left=start, color="C0" if name.startswith("import") else "C1")
        axes.text(start + seconds + 0.03, name, f"{seconds:.2f}", va="center", fontsize=8)
        start += seconds
    axes.invert_yaxis()
    axes.set_xlim(0, 1.1 * start)
    axes.set_xlabel("seconds")
    figure.savefig(path, dpi=120)


def draw_growth(growth: dict[str, dict[str, dict]], path: Path) -> None:
    """Draw seconds over size along each axis, with the exponents of the whole process."""
    figure = Figure(figsize=(9, 2.8), layout="constrained")
    for axes, (axis, points) in zip(figure.subplots(1, len(growth)), growth.items(), strict=True):
        sizes = [int(size) for size in points]
        samples = [point["samples"][0]["seconds"] for point in points.values()]
        for name in ("process", *STAGES):
            values = [sample.get(name, 0.0) for sample in samples]
            style = {"color": "black", "linewidth": 2} if name == "process" else {"linewidth": 1}
            axes.loglog(sizes, values, marker=".", label=name, **style)
        power = fit_exponent(sizes, [sample["process"] for sample in samples])
        axes.set_title(f"{TITLES[axis]}: p = {power:.2f}", fontsize=8)
        axes.set_xticks(sizes[::2], [f"{size:,}" for size in sizes[::2]], fontsize=7)
        axes.xaxis.set_minor_locator(NullLocator())
    figure.axes[0].set_ylabel("seconds")
    figure.axes[-1].legend(fontsize=6)
    figure.savefig(path, dpi=120)


def main(options: Options) -> None:
    """Draw both figures."""
    (case, *_) = read_manifest(options.cases).cases
    draw_profile(profile_command(case), options.out / "profile.png")
    draw_growth(json.loads(options.bench.read_text())["growth"], options.out / "growth.png")


if __name__ == "__main__":
    main(tyro.cli(Options))
