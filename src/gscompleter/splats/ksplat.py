"""The .ksplat format of GaussianSplats3D, read only.

A header of 4096 bytes and a header of 1024 bytes per section, then the sections: sizes of the
partly filled buckets, centres of all buckets, and one row per Gaussian. At compression level 0
rows are float32. From level 1 on, positions are 16-bit offsets from the centre of the bucket,
scales and rotations are half floats, and SH are half floats or (level 2) bytes.
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
"""SH coefficients per channel above degree 0, by degree."""
CENTRE_RANGE = 32767
"""Default number of steps from the centre of a bucket to its side."""


@dataclass(frozen=True)
class Header:
    """The header of the file, valid for all sections."""

    sections: int
    level: int
    """0: float32; 1: 16 bits; 2: 16 bits, with SH in bytes."""
    lowest: float
    """SH value of byte 0 at level 2."""
    highest: float
    """SH value of byte 255 at level 2."""


@dataclass(frozen=True)
class Section:
    """The header of a section."""

    count: int
    capacity: int
    """Rows that the section has space for."""
    bucket_size: int
    buckets: int
    block: float
    """Side length of a bucket, in scene units."""
    bucket_bytes: int
    steps: int
    """Steps from the centre of a bucket to its side."""
    full: int
    """Full buckets, which come first."""
    partial: int
    """Partly filled buckets."""
    degree: int


def read_ksplat(path: Path) -> Gaussians:
    """Read a .ksplat of SH degree 0 to 3."""
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
            f"{quoted(path)} is .ksplat version {major}.{minor} with compression {level}, which "
            "cannot be read; convert it to .ply."
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
    """Look up the centre of each Gaussian's bucket."""
    if section.bucket_bytes < 12 or section.full + section.partial > section.buckets:
        raise damaged(path, "its buckets are too small for their centres")
    partial = np.frombuffer(data, "<u4", section.partial).astype(np.int64)
    ends = np.cumsum(partial) + section.full * section.bucket_size
    numbers = np.arange(section.count)
    full = section.full * section.bucket_size
    of_partial = section.full + np.searchsorted(ends, numbers, side="right")
    bucket = np.where(numbers < full, numbers // max(section.bucket_size, 1), of_partial)
    if bucket.max() >= section.full + section.partial:
        raise damaged(path, "its buckets hold fewer Gaussians than it claims")
    centres = np.ndarray(
        (section.buckets, 3), "<f4", data, section.partial * 4, (section.bucket_bytes, 4)
    )
    return centres[bucket]


def _by_coefficient(rest: Float[ndarray, "n m"], degree: int) -> Float[ndarray, "n k 3"]:
    """Reorder SH, stored by degree and then by channel, to [n, k, 3]."""
    bands, start = [np.empty((len(rest), 0, 3))], 0
    for band in range(1, degree + 1):
        width = 3 * (2 * band + 1)
        part = rest[:, start : start + width].reshape(len(rest), 3, -1)
        bands.append(part.transpose(0, 2, 1))
        start += width
    return np.concatenate(bands, axis=1)
