"""The machine that measurements are valid for."""

from __future__ import annotations

import platform
import re
from pathlib import Path

import torch

from gscompleter import __version__
from gscompleter.system.memory import read_memory_bytes
from gscompleter.system.threads import count_available_cores


def describe_machine(device: str) -> dict[str, str | int]:
    """Describe the versions and the hardware."""
    memory = read_memory_bytes()
    return {
        "gscompleter": __version__,
        "processor": get_processor_name(),
        "cores": count_available_cores(),
        "memory_gb": 0 if memory is None else round(memory / 1e9),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "device": device,
        **({"gpu": torch.cuda.get_device_name()} if device == "cuda" else {}),
    }


def get_processor_name() -> str:
    """Return the model of the processor, or its architecture if Linux does not report it."""
    try:
        model = re.search(r"(?m)^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text("utf-8"))
    except OSError:
        model = None
    return model[1] if model else platform.processor() or platform.machine()
