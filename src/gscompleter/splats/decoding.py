"""What all readers of splats share: bytes in, whole Gaussians out, a sentence where not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gscompleter.errors import InputError, quoted
from gscompleter.types import SH_C0, Gaussians, observed

SLACK = 1 << 20
"""Bytes that any file may unpack to, however small it is."""


def check_growth(path: Path, unpacked: int, packed: int, most: int) -> None:
    """Refuse what says that it unpacks to more than `most` times its size, in bytes.

    Raises:
        InputError: where it does, before anything is unpacked.
    """
    if unpacked > SLACK + most * packed:
        raise InputError(
            f"{quoted(path)} is damaged: its {packed:,} bytes claim to hold {unpacked:,}; fetch "
            "the file again."
        )


def check_size(path: Path, found: int, needed: int) -> None:
    """Refuse a file that ends too early.

    Raises:
        InputError: where fewer bytes were found than are needed.
    """
    if found < needed:
        raise InputError(
            f"{quoted(path)} is truncated: {found:,} of {needed:,} bytes are there; fetch or write "
            "the file again."
        )


def damaged(path: Path, what: str) -> InputError:
    """The sentence for a file whose parts contradict each other."""
    return InputError(f"{quoted(path)} is damaged: {what}; fetch or write the file again.")


def gaussians_of(
    means: Float[ndarray, "n 3"],
    quats: Float[ndarray, "n 4"],
    scales: Float[ndarray, "n 3"],
    opacities: Float[ndarray, "n"],
    sh: Float[ndarray, "n k 3"],
) -> Gaussians:
    """Observed Gaussians from arrays in our conventions, as float32."""
    arrays = (means, quats, scales, opacities, sh)
    return observed(
        *(torch.from_numpy(np.require(array, np.float32, ["C", "W"])) for array in arrays)
    )


def harmonics(
    rgb: Float[ndarray, "n 3"], rest: Float[ndarray, "n k 3"] | None = None
) -> Float[ndarray, "n m 3"]:
    """Spherical harmonics that show `rgb`, with those of degree 1 and above behind."""
    constant = (rgb[:, None] - 0.5) / SH_C0
    return constant if rest is None else np.concatenate([constant, rest], axis=1)
