"""The engine selected by a command's options."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from gscompleter.apps.commands.options import EngineOptions
from gscompleter.cpu_threads import count_available_cores, limit_threads
from gscompleter.errors import InputError, quote_value
from gscompleter.jobs.engines import choose_num_workers, open_local, open_ray, open_submitit
from gscompleter.jobs.jobs import Engine


def parse_pairs(words: Sequence[str], option: str) -> dict[str, str]:
    """Parse `NAME=VALUE` words."""
    pairs = {}
    for word in words:
        name, sign, value = word.partition("=")
        if not name or not sign:
            raise InputError(
                f"'{quote_value(word)}' is not NAME=VALUE, as in resolution=256.", option
            )
        pairs[name] = value
    return pairs


def make_engine(options: EngineOptions, out: Path) -> Engine | None:
    """Create the engine, or None for this process.

    On this machine it also sets the threads, which workers inherit.
    """
    if options.engine is None:
        return None
    threads = options.threads or 1
    if options.engine == "ray":
        return partial(open_ray, options.workers, threads, options.gpus, options.address)
    if options.engine == "submitit":
        slurm, folder = parse_pairs(options.slurm, "slurm"), out / "submitit"
        workers = options.workers or 1
        return partial(open_submitit, workers, threads, options.gpus, folder, slurm)
    workers = options.workers or choose_num_workers()
    limit_threads(options.threads or max(1, count_available_cores() // workers))
    return partial(open_local, workers)
