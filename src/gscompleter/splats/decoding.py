"""Checks and conversions shared by all readers of splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gscompleter.errors import InputError, quoted
from gscompleter.types import SH_C0, Gaussians, observed

SLACK = 1 << 20
"""Unpacked size in bytes that is allowed for any file, however small."""


def check_growth(path: Path, unpacked: int, packed: int, most: int) -> None:
    """Raise InputError if a file claims to unpack to over `max_growth` times its size in bytes."""
    if unpacked > SLACK + most * packed:
        raise InputError(
            f"{quoted(path)} is damaged: its {packed:,} bytes claim to hold {unpacked:,}; fetch "
            "the file again."
        )


def check_size(path: Path, found: int, needed: int) -> None:
    """Raise InputError if a file has fewer bytes than needed."""
    if found < needed:
        raise InputError(
            f"{quoted(path)} is truncated: {found:,} of {needed:,} bytes are there; fetch or write "
            "the file again."
        )


def damaged(path: Path, what: str) -> InputError:
    """Make the error for a file that contradicts itself."""
    return InputError(f"{quoted(path)} is damaged: {what}; fetch or write the file again.")


def gaussians_of(
    means: Float[ndarray, "n 3"],
    quats: Float[ndarray, "n 4"],
    scales: Float[ndarray, "n 3"],
    opacities: Float[ndarray, "n"],
    sh: Float[ndarray, "n k 3"],
) -> Gaussians:
    """Build observed Gaussians (`generated` is 0) from arrays, as float32."""
    arrays = (means, quats, scales, opacities, sh)
    return observed(
        *(torch.from_numpy(np.require(array, np.float32, ["C", "W"])) for array in arrays)
    )


def harmonics(
    rgb: Float[ndarray, "n 3"], rest: Float[ndarray, "n k 3"] | None = None
) -> Float[ndarray, "n m 3"]:
    """Assemble SH from the RGB of their constant term and the coefficients of higher degree."""
    constant = (rgb[:, None] - 0.5) / SH_C0
    return constant if rest is None else np.concatenate([constant, rest], axis=1)
