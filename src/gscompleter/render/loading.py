"""Renderers by name, and the device on which they run."""

from __future__ import annotations

import importlib.util
from typing import Literal

import torch

from gscompleter.render.protocols import Renderer
from gscompleter.system.errors import InputError, quote_value


def load_renderer(name: str) -> Renderer:
    """Load the renderer called `name`: reference, cpu or cuda."""
    if not isinstance(name, str):
        raise InputError(
            f"A renderer is named by a str, got '{quote_value(name)}'; choose reference, cpu or "
            "cuda."
        )
    if name == "cpu":
        from gscompleter.render.cpu import CpuRenderer

        return CpuRenderer()
    if name == "reference":
        from gscompleter.render.reference import ReferenceRenderer

        return ReferenceRenderer()
    if name == "cuda":
        from gscompleter.render.gsplat import CudaRenderer

        return CudaRenderer()
    raise InputError(f"There is no renderer '{quote_value(name)}'; choose reference, cpu or cuda.")


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
