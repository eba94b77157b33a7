"""The .ksplat format of GaussianSplats3D, read only.

A header of 4096 bytes, a header of 1024 for each section, then the sections: sizes of the buckets
that are not full, centres of all buckets, and a row for each Gaussian. At compression level 0 rows
are float32; from level 1 on positions are 16 bits from the centre of their bucket, scales and
rotations half floats, and harmonics half floats or (level 2) bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gscompleter.errors import InputError, quoted
from gscompleter.reading import read_bytes
from gscompleter.splats.decoding import (
    check_size,
    damaged,
    gaussians_of,
    harmonics,
)
from gscompleter.types import Gaussians, merge

HEADER, SECTION_HEADER = 4096, 1024
COEFFICIENTS = (0, 3, 8, 15)
"""Harmonics of degree 1 and above, for each channel, by degree."""
CENTRE_RANGE = 32767
"""Steps from the centre of a bucket to its side, where the file does not say."""


@dataclass(frozen=True)
class Header:
    """What the file says of all its sections."""

    sections: int
    level: int
    """0: float32; 1: 16 bits; 2: 16 bits, and harmonics in bytes."""
    lowest: float
    """What byte 0 of a harmonic means at level 2."""
    highest: float
    """What byte 255 means."""


@dataclass(frozen=True)
class Section:
    """The header of a section."""

    count: int
    capacity: int
    """Rows that it has room for."""
    bucket_size: int
    buckets: int
    block: float
    """Length of the side of a bucket, in scene units."""
    bucket_bytes: int
    steps: int
    """Steps from the centre of a bucket to its side."""
    full: int
    """Buckets that are full. They come first."""
    partial: int
    """Buckets that are not."""
    degree: int


def read_ksplat(path: Path) -> Gaussians:
    """The Gaussians of a .ksplat, of SH degree 0 to 3.

    Raises:
        InputError: where it cannot be read, is truncated, or contradicts itself.
    """
    data = read_bytes(path)
    header = _header(path, data)
    end = HEADER + header.sections * SECTION_HEADER
    check_size(path, len(data), end)
    parts = []
    for number in range(header.sections):
        section = _section(path, data, HEADER + number * SECTION_HEADER)
        rows = _row(header.level, section.degree)
        start = end
        end += section.partial * 4 + section.buckets * section.bucket_bytes
        end += section.capacity * rows.itemsize
        check_size(path, len(data), end)
        if section.count:
            parts.append(_decoded(path, data[start:end], header, section, rows))
    if not parts:
        raise InputError(f"{quoted(path)} is empty: it holds no Gaussian.")
    return merge(parts)


def _header(path: Path, data: bytes) -> Header:
    check_size(path, len(data), HEADER)
    major, minor, sections = struct.unpack_from("<BBxxI", data)
    (level,) = struct.unpack_from("<H", data, 20)
    lowest, highest = struct.unpack_from("<ff", data, 36)
    if major != 0 or minor < 1 or level > 2:
        raise InputError(
            f"{quoted(path)} is no .ksplat that is known (version {major}.{minor}, compression "
            f"{level}); convert it to .ply."
        )
    return Header(sections, level, lowest or -1.5, highest or 1.5)


def _section(path: Path, data: bytes, offset: int) -> Section:
    count, capacity, bucket_size, buckets, block, bucket_bytes = struct.unpack_from(
        "<IIIIfH", data, offset
    )
    (steps,) = struct.unpack_from("<I", data, offset + 24)
    full, partial, degree = struct.unpack_from("<IIH", data, offset + 32)
    if degree >= len(COEFFICIENTS) or count > capacity:
        raise damaged(path, "a section contradicts itself")
    return Section(
        count,
        capacity,
        bucket_size,
        buckets,
        block,
        bucket_bytes,
        steps or CENTRE_RANGE,
        full,
        partial,
        degree,
    )


def _row(level: int, degree: int) -> np.dtype:
    centre, number = ("<f4", "<f4") if level == 0 else ("<u2", "<f2")
    return np.dtype(
        [
            ("mean", centre, 3),
            ("scale", number, 3),
            ("quat", number, 4),
            ("rgba", "u1", 4),
            ("rest", ("<f4", "<f2", "u1")[level], 3 * COEFFICIENTS[degree]),
        ]
    )


def _decoded(path: Path, data: bytes, header: Header, section: Section, row: np.dtype) -> Gaussians:
    start = section.partial * 4 + section.buckets * section.bucket_bytes
    rows = np.frombuffer(data, row, section.count, start)
    rest = rows["rest"].astype(np.float64)
    if header.level == 2:
        rest = header.lowest + rest / 255 * (header.highest - header.lowest)
    rgba = rows["rgba"].astype(np.float32) / 255
    return gaussians_of(
        _means(path, data, header, section, rows),
        rows["quat"].astype(np.float32),
        rows["scale"].astype(np.float32),
        rgba[:, 3],
        harmonics(rgba[:, :3], _by_coefficient(rest, section.degree)),
    )


def _means(
    path: Path, data: bytes, header: Header, section: Section, rows: ndarray
) -> Float[ndarray, "n 3"]:
    positions = rows["mean"].astype(np.float64)
    if header.level == 0:
        return positions
    step = section.block / 2 / section.steps
    return (positions - section.steps) * step + _centres(path, data, section)


def _centres(path: Path, data: bytes, section: Section) -> Float[ndarray, "n 3"]:
    """The centre of the bucket that each Gaussian is in."""
    if section.bucket_bytes < 12 or section.full + section.partial > section.buckets:
        raise damaged(path, "its buckets have no room for their centres")
    partial = np.frombuffer(data, "<u4", section.partial).astype(np.int64)
    ends = np.cumsum(partial) + section.full * section.bucket_size
    numbers = np.arange(section.count)
    full = section.full * section.bucket_size
    of_partial = section.full + np.searchsorted(ends, numbers, side="right")
    bucket = np.where(numbers < full, numbers // max(section.bucket_size, 1), of_partial)
    if bucket.max() >= section.full + section.partial:
        raise damaged(path, "its buckets hold fewer Gaussians than it says")
    centres = np.ndarray(
        (section.buckets, 3), "<f4", data, section.partial * 4, (section.bucket_bytes, 4)
    )
    return centres[bucket]


def _by_coefficient(rest: Float[ndarray, "n m"], degree: int) -> Float[ndarray, "n k 3"]:
    """Harmonics degree by degree and in each channel by channel, as [n, k, 3]."""
    bands, start = [np.empty((len(rest), 0, 3))], 0
    for band in range(1, degree + 1):
        width = 3 * (2 * band + 1)
        part = rest[:, start : start + width].reshape(len(rest), 3, -1)
        bands.append(part.transpose(0, 2, 1))
        start += width
    return np.concatenate(bands, axis=1)
