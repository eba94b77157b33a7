"""CPU seconds to read and write files of Gaussians, in turns with gsply.

    python benchmarks/bench_files.py --gaussians 1000000 --pairs 5

Both read the same .ply of degree 3 and write it again. gsply keeps the rows that it read and writes
them back as they are; "from arrays" is what it takes to write Gaussians that were made in memory.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gsply
import torch

from gscompleter.splats.formats import load_splat, save_splat
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.types import Gaussians, make_observed

OTHER_FORMATS = (".spz", ".compressed.ply")


def make_scene(count: int) -> Gaussians:
    random = torch.Generator().manual_seed(0)

    def draw(*size: int) -> torch.Tensor:
        return torch.randn(count, *size, generator=random)

    return make_observed(
        draw(3) * 6, draw(4), draw(3).exp() / 99, draw().sigmoid(), draw(16, 3) / 9
    )


def measure(work: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Measure the CPU seconds of this process, of all threads and of the system."""
    before = resource.getrusage(resource.RUSAGE_SELF)
    result = work(*arguments)
    after = resource.getrusage(resource.RUSAGE_SELF)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--other-formats", action="store_true")
    given = parser.parse_args()
    seconds: dict[str, list[float]] = {}

    def note(name: str, work: Callable[..., Any], *arguments: Any) -> Any:
        taken, result = measure(work, *arguments)
        seconds.setdefault(name, []).append(taken)
        return result

    with tempfile.TemporaryDirectory() as folder:
        source, ours, theirs = (Path(folder, name) for name in ("in.ply", "ours.ply", "gsply.ply"))
        save_ply(source, make_scene(given.gaussians))
        # The first round is not counted: it compiles kernels and fills caches.
        for number in range(given.pairs + 1):
            rows = note("gsply reads", gsply.plyread, source)
            note("gsply writes its rows", gsply.plywrite, theirs, rows)
            names = ("means", "scales", "quats", "opacities", "sh0", "shN")
            arrays = gsply.GSData(**{name: getattr(rows, name).copy() for name in names})
            del rows
            note("gsply writes from arrays", gsply.plywrite, theirs, arrays)
            del arrays
            scene = note("we read", load_ply, source)
            note("we write", save_ply, ours, scene)
            if number == 0:
                seconds.clear()
        for suffix in OTHER_FORMATS if given.other_formats else ():
            path = Path(folder, f"ours{suffix}")
            note(f"we write {suffix}", save_splat, path, scene)
            note(f"we read {suffix}", load_splat, path)
    for name, values in seconds.items():
        print(f"{name:26} {statistics.median(values):.2f} s")


if __name__ == "__main__":
    main()
