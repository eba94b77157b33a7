"""Ψ by Ψ: seconds and memory for two photographs, beside the embedded default.

    python benchmarks/bench_models.py [--size 256] [--only mvsplat-re10k ...]

The networks hold random weights, which take as long as learned ones. Each runs in a process of its
own, so that its peak of memory is its own: the process, torch and the weights included.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import tyro
from rich.console import Console
from rich.table import Table

from bench_render import median_seconds
from gscompleter.commands.demo import write_motorcycle_scene
from gscompleter.data.scene import load_views
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.runs.memory import peak_memory
from gscompleter.types import View
from gscompleter.weights.published import PUBLISHED

MODELS = (
    "plane-sweep",
    "mvsplat-re10k",
    "depthsplat-small-re10k",
    "depthsplat-base-re10k",
    "depthsplat-large-re10k",
    "volsplat-re10k",
    "da3-small",
    "da3-base",
)
"""One of each network; the default comes first, for the ratios."""


@dataclass(frozen=True)
class Measured:
    seconds: float
    """Median of the repetitions."""
    peak_bytes: int | None


def photographs(size: int) -> list[View]:
    """The centre of the Middlebury motorcycle pair, which scikit-image carries."""
    with TemporaryDirectory() as folder:
        write_motorcycle_scene(Path(folder))
        return load_views(folder, resolution=(size, size), near=1.0, far=20.0)


def model(
    name: str, device: str = "cpu", dtype: torch.dtype = torch.float32
) -> tuple[Reconstructor, int]:
    """The reconstructor, with random weights if it has any, and how many."""
    if name not in PUBLISHED:
        return load_reconstructor(name), 0
    from gscompleter.reconstructors.feed_forward.build import around, network_of

    torch.manual_seed(0)
    network = network_of(PUBLISHED[name]).eval().requires_grad_(False).to(device)
    return around(network, dtype), sum(p.numel() for p in network.parameters())


def repeated(reconstruct: Reconstructor, views: list[View], repetitions: int) -> Measured:
    """Run it once to warm up, then a few times with a clock."""
    with peak_memory(views[0].image.device) as peak:
        seconds = median_seconds(lambda: reconstruct(views), repetitions)
    return Measured(seconds, peak.bytes)


def measure(name: str, size: int, repetitions: int) -> tuple[int, Measured]:
    """Parameters of a model, and what it takes on a CPU."""
    reconstruct, parameters = model(name)
    return parameters, repeated(reconstruct, photographs(size), repetitions)


def main(size: int = 256, repetitions: int = 3, only: tuple[str, ...] = MODELS) -> None:
    """Measure and print.

    Args:
        size: Sides of the two photographs, in pixels: a multiple of 64.
        repetitions: Timed runs of each model.
        only: Which models; ratios are to the first.
    """
    table = Table("model", "parameters", "seconds", "ratio", "memory (GiB)", "ratio", box=None)
    first = None
    for name in only:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            parameters, found = pool.submit(measure, name, size, repetitions).result()
        first = first or found
        peak, base = found.peak_bytes or float("nan"), first.peak_bytes or float("nan")
        table.add_row(
            name,
            f"{parameters / 1e6:.1f} M",
            f"{found.seconds:.2f}",
            f"{found.seconds / first.seconds:.1f}",
            f"{peak / 2**30:.2f}",
            f"{peak / base:.1f}",
        )
    Console(width=120).print(table)


if __name__ == "__main__":
    tyro.cli(main)
