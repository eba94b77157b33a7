"""Choice of the engine that runs many cases. Nothing here needs torch."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from gscompleter.apps.commands.shared_options import EngineOptions
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.jobs.engines import (
    check_processes,
    choose_num_workers,
    open_local,
    open_ray,
    open_submitit,
)
from gscompleter.system.jobs.jobs import Engine
from gscompleter.system.threads import count_available_cores, limit_threads


def make_engine(options: EngineOptions, out: Path) -> Engine | None:
    """Create the engine, or None for this process.

    On this machine it also sets the threads, which workers inherit.
    """
    if options.engine is None:
        return None

    # Cores of machines elsewhere are not known here, so their workers get one thread by default.
    threads = options.threads or 1
    if options.engine == "ray":
        return partial(open_ray, options.workers, threads, options.gpus, options.address)
    if options.engine == "submitit":
        slurm = parse_pairs(options.slurm, "slurm")
        workers = options.workers or 1
        return partial(open_submitit, workers, threads, options.gpus, out / "submitit", slurm)

    # Workers on this machine share its cores. With torch's default each would take all of them.
    check_processes()
    workers = options.workers or choose_num_workers()
    limit_threads(options.threads or max(1, count_available_cores() // workers))
    return partial(open_local, workers)


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
