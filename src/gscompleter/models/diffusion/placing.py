"""Device and precision of diffusers pipelines."""

from __future__ import annotations

from typing import Any

import torch


def select_dtype(device: str) -> torch.dtype:
    """Select bfloat16 on a GPU and float32 on a CPU."""
    return torch.float32 if device == "cpu" else torch.bfloat16


def move_to_device(pipeline: Any, device: str, offload: bool) -> None:
    """Move a pipeline to its device, or offload its inactive parts; disables progress bars."""
    pipeline.set_progress_bar_config(disable=True)
    if offload and device != "cpu":
        pipeline.enable_model_cpu_offload(device=device)
    else:
        pipeline.to(device)
