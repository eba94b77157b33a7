"""How many threads compute: torch, numba, OpenCV and our own share the same cores."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LIBRARIES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""What torch, numba (which our own threads follow) and OpenCV read once, when they are imported."""

QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""Where Linux says what share of its cores a container may use: microseconds of each period."""


def bound_threads(count: int | None) -> None:
    """Let every library compute with `count` threads, and the processes that are started too.

    None takes the usable cores, and leaves alone what the environment says already. torch, numba
    and OpenCV are not to be imported before.
    """
    for name in LIBRARIES:
        if count is not None or name not in os.environ:
            os.environ[name] = str(count or usable_cores())


def threads() -> int:
    """How many threads compute, as `bound_threads` or the environment says."""
    told = os.environ.get(LIBRARIES[0], "")
    return int(told) if told.isdecimal() and int(told) > 0 else usable_cores()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """torch computes with one thread meanwhile.

    Between two of its loops its other threads spin, and where the loops are short and take turns
    with kernels of our own, that takes more time from these than the threads save.
    """
    import torch

    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def usable_cores() -> int:
    """The cores that this process may run on, or as many as its share of their time amounts to."""
    pinned = hasattr(os, "sched_getaffinity")  # Windows and macOS have none
    cores = len(os.sched_getaffinity(0)) if pinned else os.cpu_count() or 1
    return max(1, round(min(cores, granted(QUOTA))))


def granted(file: Path) -> float:
    """The time that a container may use, in cores; infinite where the file sets no bound."""
    words = file.read_text().split() if file.is_file() else []
    bounded = len(words) == 2 and all(word.isdecimal() for word in words)
    return int(words[0]) / int(words[1]) if bounded else math.inf
