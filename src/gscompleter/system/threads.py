"""Number of CPU threads of torch, numba and OpenCV."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gscompleter.system.process import use_one_arena

THREAD_VARIABLES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Environment variables that torch, numba and OpenCV read on import."""

QUOTA_FILE = Path("/sys/fs/cgroup/cpu.max")
"""File of a Linux container's CPU quota: microseconds per period."""


def limit_threads(count: int | None) -> None:
    """Limit the threads of all libraries and of new processes.

    None means all usable cores, unless the environment has a number. Call it before the libraries
    are imported.
    """
    for name in THREAD_VARIABLES:
        if count is not None or name not in os.environ:
            os.environ[name] = str(count or count_available_cores())
    use_one_arena()


def get_thread_count() -> int:
    """Return the number of threads."""
    value = os.environ.get(THREAD_VARIABLES[0], "")
    return int(value) if value.isdecimal() and int(value) > 0 else count_available_cores()


@contextmanager
def use_one_torch_thread() -> Iterator[None]:
    """Let torch compute with one thread inside the block.

    Its waiting threads otherwise slow down our own kernels, which run between short torch loops.
    """
    import torch

    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def count_available_cores() -> int:
    """Count the cores of this process, limited by its CPU quota."""
    if hasattr(os, "sched_getaffinity"):  # Windows and macOS have none
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(1, round(min(cores, read_quota(QUOTA_FILE))))


def read_quota(file: Path) -> float:
    """Read a CPU quota in cores; infinite if there is none."""
    words = file.read_text("ascii").split() if file.is_file() else []
    # "max" stands for no quota.
    if len(words) != 2 or not all(word.isdecimal() for word in words):
        return math.inf
    return int(words[0]) / int(words[1])
