"""The machine that measurements hold for."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

import torch

from gscompleter import __version__
from gscompleter.memory import memory_bytes


def machine(device: str) -> dict[str, str | int]:
    """What a reader needs to know of it."""
    memory = memory_bytes()
    found: dict[str, str | int] = {
        "gscompleter": __version__,
        "processor": processor(),
        "cores": usable_cores(),
        "memory_gb": 0 if memory is None else round(memory / 1e9),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "device": device,
    }
    return {**found, "gpu": torch.cuda.get_device_name()} if device == "cuda" else found


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor() -> str:
    """The model of the processor as Linux tells it, else its architecture."""
    try:
        told = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.M)
    except OSError:
        told = None
    return told[1] if told else platform.processor() or platform.machine()
