"""Numerical precision of the networks."""

from __future__ import annotations

import torch

from gscompleter.system.errors import InputError


def check_precision(device: torch.device, dtype: torch.dtype) -> None:
    """Raise InputError if a network on `device` cannot run in `dtype`."""
    if dtype != torch.float32 and device.type != "cuda":
        raise InputError(
            f"The network runs on the {device.type} and {dtype} needs a GPU; use float32."
        )


def lower_precision(device: torch.device, dtype: torch.dtype) -> torch.autocast:
    """Run networks in `dtype` within this context; geometry stays in float32."""
    return torch.autocast(device.type, dtype, enabled=dtype != torch.float32)
