"""Weights that follow from their names, with which the authors' networks made the fixtures."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path

import torch
from torch import Tensor, nn

FIXTURES = Path(__file__).parent / "fixtures"


def rule_tensor(key: str, shape: Sequence[int], plain: bool = False) -> Tensor:
    """The tensor called `key`; `plain` leaves out the rule for kernels of sparse convolutions."""
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "little")
    generator = torch.Generator().manual_seed(seed & 0x7FFFFFFFFFFFFFFF)
    n = torch.randn(tuple(shape), generator=generator)
    last = key.rsplit(".", 1)[-1]
    if last == "kernel" and not plain:
        return n / (8 * shape[1] if len(shape) == 3 else shape[0]) ** 0.5
    if len(shape) >= 2:
        return n / prod(shape[1:]) ** 0.5
    if last in ("weight", "gamma", "scale", "running_var"):
        return 1 + 0.1 * n
    return 0.05 * n


def rule_state(network: nn.Module, multipliers: Mapping[str, float] = {}) -> dict[str, Tensor]:
    """A state for `network`: every floating tensor by its name, times its multiplier."""
    return {
        key: rule_tensor(key, value.shape) * multipliers.get(key, 1.0)
        if value.is_floating_point()
        else value
        for key, value in network.state_dict().items()
    }


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Largest difference, relative to the largest absolute value expected."""
    assert found.shape == expected.shape
    return ((found - expected).abs().max() / expected.abs().max()).item()
