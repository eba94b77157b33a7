"""Numbers in few bits, and rotations as the three smallest components of a quaternion."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Integer, UInt32
from numpy import ndarray


def unpack_fraction(packed: UInt32[ndarray, "*n"], shift: int, bits: int) -> Float[ndarray, "*n"]:
    """Unpack `bits` bits of each number from bit `shift` on, as a fraction in [0, 1]."""
    most = (1 << bits) - 1
    return ((packed >> np.uint32(shift)) & np.uint32(most)).astype(np.float32) / np.float32(most)


def quantize(fractions: Float[ndarray, "*n"], bits: int) -> UInt32[ndarray, "*n"]:
    """Quantize fractions to integers of `bits` bits; the inverse of `unpack_fraction`."""
    most = (1 << bits) - 1
    return np.rint(np.clip(fractions, 0, 1) * most).astype(np.uint32)


def restore_largest(
    largest: Integer[ndarray, "n"], smaller: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 4"]:
    """Restore unit quaternions whose positive component `largest` was dropped."""
    quats = np.empty((len(smaller), 4), np.float32)
    places = np.arange(3) + (np.arange(3) >= largest[:, None])
    np.put_along_axis(quats, places, smaller.astype(np.float32), axis=1)
    rest = np.sqrt(np.maximum(0, 1 - np.square(smaller).sum(1, keepdims=True)))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), rest.astype(np.float32), axis=1)
    return quats


def drop_largest(
    quats: Float[ndarray, "n 4"],
) -> tuple[Integer[ndarray, "n"], Float[ndarray, "n 3"]]:
    """Drop the largest component, made positive; return its number and the other three."""
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(1)
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    places = np.arange(3) + (np.arange(3) >= largest[:, None])
    return largest, np.take_along_axis(unit, places, axis=1)
