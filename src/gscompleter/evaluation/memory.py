"""Peak memory of a computation."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import torch


class Peak:
    """Result of `measure_peak_memory`: None until its body ends, or if the system has none."""

    bytes: int | None = None


@contextmanager
def measure_peak_memory(device: torch.device | str = "cpu") -> Iterator[Peak]:
    """Measure peak memory while the body runs: torch's on a GPU, the whole process's on a CPU."""
    peak = Peak()
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        yield peak
        peak.bytes = torch.cuda.max_memory_allocated()
        return
    is_reset = False
    with suppress(OSError):
        # Linux: this value resets the peak of resident memory (`man 5 proc`). Containers may forbid
        # it.
        Path("/proc/self/clear_refs").write_bytes(b"5")
        is_reset = True
    yield peak
    peak.bytes = read_process_peak() if is_reset else None


def read_process_peak() -> int | None:
    """Read the peak resident memory of this process, or None if the system does not report it."""
    with suppress(OSError):
        status = Path("/proc/self/status").read_bytes()
        peak = re.search(rb"VmHWM:\s*([0-9]+) kB", status)
        if peak is not None:
            return 1024 * int(peak[1])
    return None
