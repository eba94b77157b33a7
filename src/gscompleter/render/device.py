"""The device on which renderers and networks run."""

from __future__ import annotations

import importlib.util
from typing import Literal

import torch

from gscompleter.system.errors import InputError


def choose_device(device: Literal["auto", "cpu", "cuda"] = "auto") -> Literal["cpu", "cuda"]:
    """Choose the device; `auto` uses a GPU if torch finds one and gsplat is installed."""
    is_ready = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None
    if device == "cuda" and not is_ready:
        raise InputError(
            "The device cuda needs a GPU that torch sees, and gsplat from "
            "`pip install gscompleter[cuda]`; without them, choose the device cpu.",
            "device",
        )
    if device == "auto":
        return "cuda" if is_ready else "cpu"
    return device
