"""The most memory that a computation held."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

_CLEAR = Path("/proc/self/clear_refs")
_STATUS = Path("/proc/self/status")


class Peak:
    """What `peak_memory` found, once it is over."""

    bytes: int | None = None
    """None where the system does not tell."""


@contextmanager
def peak_memory(device: torch.device | str = "cpu") -> Iterator[Peak]:
    """Measure the most memory held while the body ran.

    On a GPU, what torch held there. Else the resident memory of the whole process, which counts
    the program and all that was loaded before; Linux alone tells its peak over a span of time.
    """
    peak = Peak()
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    told = on_gpu or _reset()
    yield peak
    if told:
        peak.bytes = torch.cuda.max_memory_allocated() if on_gpu else _most_resident()


def _reset() -> bool:
    try:
        _CLEAR.write_text("5")
    except OSError:
        return False
    return True


def _most_resident() -> int | None:
    match = re.search(r"VmHWM:\s*([0-9]+) kB", _STATUS.read_text())
    return None if match is None else 1024 * int(match[1])
