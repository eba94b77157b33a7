"""Time and memory of all reconstructors for two photographs, next to the default.

    python benchmarks/bench_models.py [--size 256] [--only mvsplat-re10k ...]

Networks have random weights, and a process each, so that peak memory is their own.
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

from bench_render import measure_median_seconds
from gscompleter.data.demo_scene import write_motorcycle_scene
from gscompleter.data.scene import load_views
from gscompleter.evaluation.memory import measure_peak_memory
from gscompleter.models.weights.published import PUBLISHED
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.types import View

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
"""One of each network, after the default, which the ratios refer to."""


@dataclass(frozen=True)
class ModelCost:
    seconds: float
    peak_bytes: int | None


def load_motorcycle_pair(size: int) -> list[View]:
    """Load the centre of the Middlebury motorcycle pair of scikit-image."""
    with TemporaryDirectory() as folder:
        write_motorcycle_scene(Path(folder))
        return load_views(folder, resolution=(size, size), near=1.0, far=20.0)


def load_model(
    name: str, device: str = "cpu", dtype: torch.dtype = torch.float32
) -> tuple[Reconstructor, int]:
    """Load a reconstructor, with random weights if it has any, and their number."""
    if name not in PUBLISHED:
        return load_reconstructor(name, device=device), 0
    from gscompleter.models.feed_forward.build import create_network, wrap_network

    torch.manual_seed(0)
    network = create_network(PUBLISHED[name]).eval().requires_grad_(False).to(device)
    return wrap_network(network, dtype), sum(p.numel() for p in network.parameters())


def measure_repeatedly(
    reconstruct: Reconstructor, views: list[View], repetitions: int
) -> ModelCost:
    with measure_peak_memory(views[0].image.device) as peak:
        seconds = measure_median_seconds(lambda: reconstruct(views), repetitions)
    return ModelCost(seconds, peak.bytes)


def measure(name: str, size: int, repetitions: int) -> tuple[int, ModelCost]:
    """Return the number of parameters of a model, and its measurement on a CPU."""
    reconstruct, parameters = load_model(name)
    return parameters, measure_repeatedly(reconstruct, load_motorcycle_pair(size), repetitions)


def main(size: int = 256, repetitions: int = 3, only: tuple[str, ...] = MODELS) -> None:
    """Measure all models and print the table.

    Args:
        size: Sides of the two photographs in pixels, a multiple of 64.
        repetitions: Timed runs per model.
        only: Models to measure; ratios refer to the first.
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
