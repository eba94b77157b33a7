"""Choice of the engine that runs many cases. Nothing here needs torch."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from gscompleter.apps.requests.batch import EngineRequest
from gscompleter.system.jobs.engines import (
    check_processes,
    choose_num_workers,
    open_local,
    open_ray,
    open_submitit,
)
from gscompleter.system.jobs.jobs import Engine
from gscompleter.system.threads import count_available_cores, limit_threads


def make_engine(request: EngineRequest, out: Path) -> Engine | None:
    """Create the engine, or None for this process.

    On this machine it also sets the threads, which workers inherit.
    """
    if request.name is None:
        return None

    # Cores of machines elsewhere are not known here, so their workers get one thread by default.
    threads = request.threads or 1
    if request.name == "ray":
        return partial(open_ray, request.workers, threads, request.gpus, request.address)
    if request.name == "submitit":
        workers = request.workers or 1
        folder = out / "submitit"
        return partial(open_submitit, workers, threads, request.gpus, folder, request.slurm)

    # Workers on this machine share its cores. With torch's default each would take all of them.
    check_processes()
    workers = request.workers or choose_num_workers()
    limit_threads(request.threads or max(1, count_available_cores() // workers))
    return partial(open_local, workers)
