"""Where a pipeline of diffusers computes, and how precisely."""

from __future__ import annotations

from typing import Any

import torch


def precision_on(device: str) -> torch.dtype:
    """bfloat16 on a GPU, float32 on a CPU."""
    return torch.float32 if device == "cpu" else torch.bfloat16


def place(pipeline: Any, device: str, offload: bool) -> None:
    """Bring a loaded pipeline to its device, all of it or, offloaded, what is at work; no bars."""
    pipeline.set_progress_bar_config(disable=True)
    if offload and device != "cpu":
        pipeline.enable_model_cpu_offload(device=device)
    else:
        pipeline.to(device)
