"""Checks and conversions shared by all readers of splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gscompleter.errors import InputError, quote_value
from gscompleter.types import SH_C0, Gaussians, make_observed

MIN_ALLOWED_BYTES = 1 << 20
"""Unpacked size in bytes that is allowed for any file, however small."""


def check_growth(path: Path, unpacked: int, packed: int, max_growth: int) -> None:
    """Raise InputError if a file claims to unpack to over `max_growth` times its size in bytes."""
    if unpacked > MIN_ALLOWED_BYTES + max_growth * packed:
        raise InputError(
            f"{quote_value(path)} is damaged: its {packed:,} bytes claim to hold {unpacked:,}; "
            "fetch "
            "the file again."
        )


def check_size(path: Path, found: int, needed: int) -> None:
    """Raise InputError if a file has fewer bytes than needed."""
    if found < needed:
        raise InputError(
            f"{quote_value(path)} is truncated: {found:,} of {needed:,} bytes are there; fetch or "
            "write "
            "the file again."
        )


def make_damage_error(path: Path, defect: str) -> InputError:
    """Make the error for a file that contradicts itself."""
    return InputError(f"{quote_value(path)} is damaged: {defect}; fetch or write the file again.")


def build_gaussians(
    means: Float[ndarray, "n 3"],
    quats: Float[ndarray, "n 4"],
    scales: Float[ndarray, "n 3"],
    opacities: Float[ndarray, "n"],
    sh: Float[ndarray, "n k 3"],
) -> Gaussians:
    """Build observed Gaussians (`generated` is 0) from arrays, as float32."""
    arrays = (means, quats, scales, opacities, sh)
    return make_observed(
        *(torch.from_numpy(np.require(array, np.float32, ["C", "W"])) for array in arrays)
    )


def assemble_sh(
    rgb: Float[ndarray, "n 3"], rest: Float[ndarray, "n k 3"] | None = None
) -> Float[ndarray, "n m 3"]:
    """Assemble SH from the RGB of their constant term and the coefficients of higher degree."""
    constant = (rgb[:, None] - 0.5) / SH_C0
    return constant if rest is None else np.concatenate([constant, rest], axis=1)
