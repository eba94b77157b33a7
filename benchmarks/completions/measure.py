"""Time and memory of one completion, next to a yardstick."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch

from gscompleter.evaluation.memory import Peak, measure_peak_memory
from gscompleter.render.protocols import Renderer
from gscompleter.state import Completion
from gscompleter.system.children import run_python
from gscompleter.system.errors import InputError
from gscompleter.system.files.result_names import SUMMARY_FILE
from gscompleter.system.progress import show_progress, track
from gscompleter.system.timing import wait_for_gpu
from gscompleter.types import Camera, Gaussians, make_observed, merge, sh_from_rgb

SIDE = 256
"""Side of the yardstick's image, in pixels."""
SHIFTS = (-0.2, 0.2, 0.4)
"""Camera positions in metres to the right; each camera adds one Gaussian per pixel."""
RUNS = 5
"""Number of runs of which the median is taken."""

PROCESS = "process"
"""Seconds of the whole process."""
REST = "rest"
"""Seconds outside of the stages: start, imports, files, scores."""
PROGRAM = """
from gscompleter.cli import run
try:
    run()
finally:
    import os
    from gscompleter.evaluation.memory import read_process_peak
    print(sum(os.times()[:4]), read_process_peak() or "")
"""
"""Program of a process. It prints its CPU seconds, with those of its own processes, and its peak,
because a child inherits its parent's."""

Yardstick = Callable[[], object]
T = TypeVar("T")
K = TypeVar("K")


@dataclass(frozen=True)
class Sample:
    """One measurement: wall time by stage, the last of which is compared with others.

    Memory is None if the system does not report it. Gaussians are those of the context and added.
    """

    seconds: Mapping[str, float]
    yardstick: float
    cpu: float
    """CPU seconds of all threads and further processes, which a busy machine changes least."""
    peak_bytes: int | None
    gaussians: Mapping[str, int]

    @property
    def ratio(self) -> float:
        """Seconds of the last stage, in yardsticks."""
        last = list(self.seconds.values())[-1]
        return last / self.yardstick


def make_yardstick(renderer: Renderer, device: str) -> Yardstick:
    """Make a fixed workload: one forward and backward pass of 196,608 Gaussians.

    It compares times of different machines and busy hours. Its first run compiles everything.
    """
    cameras = [make_yardstick_camera(shift).to(device) for shift in SHIFTS]
    scene = merge([make_surface(camera) for camera in cameras])

    def render() -> None:
        names = ("means", "quats", "scales", "opacities", "sh")
        varied = {name: getattr(scene, name).clone() for name in names}
        variables = [tensor.requires_grad_() for tensor in varied.values()]
        image = renderer.render(replace(scene, **varied), cameras[-1]).image
        torch.autograd.grad(image.sum(), variables)

    # Compiles everything, before the first run that counts.
    render()
    return render


def measure_beside(yardstick: Yardstick, measure: Callable[[], T]) -> tuple[T, float]:
    """Run `measure`, and return the mean yardstick of just before and just after."""
    before = measure_median_seconds(yardstick)
    result = measure()
    after = measure_median_seconds(yardstick)
    return result, (before + after) / 2


def measure_median_seconds(work: Yardstick) -> float:
    """Measure the median seconds of `RUNS` runs, including their work on a GPU."""
    seconds = []
    for _ in range(RUNS):
        start = time.perf_counter()
        work()
        wait_for_gpu()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def make_yardstick_camera(shift: float) -> Camera:
    """Make a camera along z, `shift` metres to the right."""
    K = torch.tensor([[1.2 * SIDE, 0, SIDE / 2], [0, 1.2 * SIDE, SIDE / 2], [0, 0, 1]])
    c2w = torch.eye(4)
    c2w[0, 3] = shift
    return Camera(c2w, K, SIDE, SIDE, near=1.0, far=8.0)


def make_surface(camera: Camera) -> Gaussians:
    """Make one Gaussian per pixel of a camera, on a wavy surface 3 m away."""
    x = torch.linspace(0, 12, SIDE)
    depth = 3 + 0.5 * torch.sin(x)[None] * torch.cos(x)[:, None]
    n = SIDE * SIDE
    colors = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    return make_observed(
        (camera.center + depth[..., None] * camera.z_rays()).reshape(-1, 3),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        (0.5 * depth / camera.K[0, 0]).reshape(-1, 1).repeat(1, 3),
        torch.full((n,), 0.9),
        sh_from_rgb(colors),
    )


def measure_command(words: Sequence[str], out: Path, yardstick: Yardstick) -> Sample:
    """Measure one run of a command that writes to `out`, in a process of its own."""
    (spent, cpu, peak_bytes), unit = measure_beside(yardstick, lambda: run_command(words))
    # The stages were timed by the command itself; what it needed besides is the rest.
    summary = json.loads((out / SUMMARY_FILE).read_bytes())
    stages = summary["seconds"]
    seconds = {**stages, REST: spent - stages["total"], PROCESS: spent}
    return Sample(seconds, unit, cpu, peak_bytes, summary["gaussians"])


def run_command(words: Sequence[str]) -> tuple[float, float, int | None]:
    """Return wall seconds, CPU seconds and peak bytes of `gscompleter` in a process of its own.

    Raises its InputError.
    """
    start = time.perf_counter()
    done = run_python(PROGRAM, words)
    seconds = time.perf_counter() - start
    if done.returncode == 2:
        raise InputError(done.stderr.strip().removeprefix("gscompleter: "))
    if done.returncode != 0:
        raise RuntimeError(f"gscompleter {' '.join(words)} failed:\n{done.stderr}")
    cpu, *peak = done.stdout.splitlines()[-1].split()
    return seconds, float(cpu), int(peak[0]) if peak else None


def measure_call(complete: Callable[[], Completion], device: str, yardstick: Yardstick) -> Sample:
    """Measure one completion within this process."""

    def run() -> tuple[Completion, float, float, Peak]:
        start = time.perf_counter()
        cpu_start = time.process_time()
        with measure_peak_memory(device) as peak:
            done = complete()
        return done, time.perf_counter() - start, time.process_time() - cpu_start, peak

    (done, spent, cpu, peak), unit = measure_beside(yardstick, run)
    added = sum(len(result.added) for result in done.targets)
    counts = {"context": len(done.scene) - added, "added": added}
    seconds = {**done.seconds, REST: spent - done.seconds["total"], PROCESS: spent}
    return Sample(seconds, unit, cpu, peak.bytes, counts)


def measure_in_rounds(
    tasks: Mapping[K, Callable[[], Sample]], repeats: int
) -> dict[K, list[Sample]]:
    """Repeat all measurements in rounds, so that a busy hour slows all of them alike."""
    samples: dict[K, list[Sample]] = {key: [] for key in tasks}
    for key in track([*tasks] * repeats, "measuring"):
        with show_progress(None):  # no progress lines inside a measurement
            samples[key].append(tasks[key]())
    return samples
