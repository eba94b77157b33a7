"""The most memory that a computation held."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import torch


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
        yield peak
        peak.bytes = torch.cuda.max_memory_allocated()
        return
    told = False
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
        told = True
    yield peak
    if told:
        peak.bytes = peak_of_process()


def peak_of_process() -> int | None:
    """The most resident memory that this process held; None where the system does not tell."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return None
    most = re.search(r"VmHWM:\s*([0-9]+) kB", status)
    return None if most is None else 1024 * int(most[1])
