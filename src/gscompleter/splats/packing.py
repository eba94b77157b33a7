"""Numbers in few bits, and rotations as the three smallest components of a quaternion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Integer, Shaped, UInt32
from numpy import ndarray

from gscompleter.system.damage import DamagedError
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import SH_C0, Gaussians, make_observed

NUM_SH_REST = (0, 3, 8, 15)
"""SH coefficients per channel above degree 0, by degree."""
MAX_LOG_SCALE = 20.0
"""Largest absolute log-scale that packed formats write, as in other writers."""
ZIP_MAGIC = b"PK\x03\x04"
NUMBER_KINDS = "iuf"
"""Kinds of NumPy's types that are numbers: whole ones with and without sign, and floats."""
FREE_GAUSSIANS = 1 << 22
"""Gaussians that any file may hold, however small: they take about a gigabyte at most."""


class UnsupportedError(ValueError):
    """An intact file whose content is not read; its message follows the name of the file."""


class BandError(UnsupportedError):
    """Intact bytes with harmonics of degree 4; who knows the file makes a `DegreeError` of it."""


class DegreeError(InputError):
    """A named file with harmonics of degree 4, which can be read without its fourth band."""


def unpack_fractions(packed: UInt32[ndarray, "n"], widths: Sequence[int]) -> Float[ndarray, "n k"]:
    """Unpack fields of `widths` bits, the last one in the lowest bits, as fractions in [0, 1]."""
    fractions = np.empty((len(packed), len(widths)), np.float32)
    shift = 0
    for column, bits in reversed(list(enumerate(widths))):
        most = (1 << bits) - 1
        field = (packed >> np.uint32(shift)) & np.uint32(most)
        fractions[:, column] = field.astype(np.float32) / np.float32(most)
        shift += bits
    return fractions


def pack_fractions(fractions: Float[ndarray, "n k"], widths: Sequence[int]) -> UInt32[ndarray, "n"]:
    """Quantize fractions to fields of `widths` bits; the inverse of `unpack_fractions`."""
    packed = np.zeros(len(fractions), np.uint32)
    for column, bits in enumerate(widths):
        most = (1 << bits) - 1
        field = np.rint(np.clip(fractions[:, column], 0, 1) * most).astype(np.uint32)
        packed = (packed << np.uint32(bits)) | field
    return packed


def restore_largest(
    largest: Integer[ndarray, "n"], smaller: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 4"]:
    """Restore unit quaternions whose positive component was dropped, that of number `largest`.

    Components keep the order of the file, as in `drop_largest`.
    """
    quats = np.empty((len(smaller), 4), np.float32)
    # Places of the other three: those from the dropped one on move up by one.
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
    # q and -q are the same rotation, so that the sign of the dropped component need not be stored.
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    places = np.arange(3) + (np.arange(3) >= largest[:, None])
    return largest, np.take_along_axis(unit, places, axis=1)


def check_count(count: int, stored: int, what: str = "Gaussians") -> None:
    """Raise DamagedError if `stored` bytes claim more Gaussians than any file would hold in them.

    `what` names them in the sentence, where other things than Gaussians are counted.

    What is equal for all Gaussians, such as their size, takes hardly a byte in a packed format, so
    that no ratio of sizes tells a bomb. Only where a count would fill the memory has each further
    Gaussian to be a byte: what tells Gaussians apart, such as their positions, takes several.
    """
    if count > FREE_GAUSSIANS + stored:
        raise DamagedError(f"its {stored:,} bytes claim to hold {quote_value(f'{count:,}')} {what}")


def build_gaussians(
    means: Shaped[ndarray, "..."],
    quats: Shaped[ndarray, "..."],
    scales: Shaped[ndarray, "..."],
    opacities: Shaped[ndarray, "..."],
    sh: Shaped[ndarray, "..."],
) -> Gaussians:
    """Build observed Gaussians (`generated` is 0) from arrays of numbers, as float32.

    Their shapes are [n, 3], [n, 4], [n, 3], [n] and [n, k, 3]. A reader may hand over arrays as a
    file has them: others raise DamagedError.
    """
    arrays = {
        "positions": means,
        "rotations": quats,
        "sizes": scales,
        "opacities": opacities,
        "colours": sh,
    }
    count = len(means) if means.ndim else 0
    coefficients = sh.shape[1] if sh.ndim == 3 else 0
    wanted = [(count, 3), (count, 4), (count, 3), (count,), (count, coefficients, 3)]
    for (name, array), shape in zip(arrays.items(), wanted, strict=True):
        if array.shape != shape or array.dtype.kind not in NUMBER_KINDS:
            given, needed = (" × ".join(map(str, one)) or "1" for one in (array.shape, shape))
            raise DamagedError(
                f"its {name} are no {needed} numbers" + (f" but {given}" if given != needed else "")
            )
    if coefficients - 1 not in NUM_SH_REST:
        raise DamagedError(f"its colours have {coefficients} coefficients, which no degree has")
    return make_observed(
        *[torch.from_numpy(np.require(array, np.float32, ["C", "W"])) for array in arrays.values()]
    )


def with_labels(gaussians: Gaussians, labels: Shaped[ndarray, "n"]) -> Gaussians:
    """Return Gaussians with the labels of a file, whole numbers from 0 to 255."""
    generated = labels.astype(np.uint8)
    if len(generated) != len(gaussians) or not np.array_equal(generated, labels):
        raise DamagedError("its labels of generated Gaussians are no bytes, or too few")
    return replace(gaussians, generated=torch.from_numpy(generated))


def assemble_sh(
    rgb: Float[ndarray, "n 3"], rest: Float[ndarray, "n k 3"] | None = None
) -> Float[ndarray, "n m 3"]:
    """Assemble SH from the RGB of their constant term and the coefficients of higher degree."""
    constant = (rgb[:, None] - 0.5) / SH_C0
    return constant if rest is None else np.concatenate([constant, rest], axis=1)
