"""Description of the machine that the measurements are valid for."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

import torch

from gscompleter import __version__
from gscompleter.memory import read_memory_bytes


def describe_machine(device: str) -> dict[str, str | int]:
    """Describe the versions and the hardware."""
    memory = read_memory_bytes()
    found: dict[str, str | int] = {
        "gscompleter": __version__,
        "processor": get_processor_name(),
        "cores": count_usable_cores(),
        "memory_gb": 0 if memory is None else round(memory / 1e9),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "device": device,
    }
    return {**found, "gpu": torch.cuda.get_device_name()} if device == "cuda" else found


def count_usable_cores() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def get_processor_name() -> str:
    """Return the model of the processor, or its architecture if Linux does not report it."""
    try:
        model = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.M)
    except OSError:
        model = None
    return model[1] if model else platform.processor() or platform.machine()
