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

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_bytes
from gscompleter.splats.packing import assemble_sh, build_gaussians, check_size, make_damage_error
from gscompleter.types import Gaussians, merge

HEADER, SECTION_HEADER = 4096, 1024
NUM_SH_REST = (0, 3, 8, 15)
"""SH coefficients per channel above degree 0, by degree."""
DEFAULT_STEPS = 32767
"""Default number of steps from the centre of a bucket to its side."""


@dataclass(frozen=True)
class KsplatHeader:
    """The header of the file, valid for all sections."""

    num_sections: int
    level: int
    """0: float32; 1: 16 bits; 2: 16 bits, with SH in bytes."""
    sh_min: float
    """SH value of byte 0 at level 2."""
    sh_max: float
    """SH value of byte 255 at level 2."""


@dataclass(frozen=True)
class KsplatSection:
    """The header of a section."""

    count: int
    capacity: int
    """Rows that the section has space for."""
    bucket_size: int
    num_buckets: int
    bucket_side: float
    """Side length of a bucket, in scene units."""
    bucket_bytes: int
    num_steps: int
    """Steps from the centre of a bucket to its side."""
    num_full: int
    """Full buckets, which come first."""
    num_partial: int
    """Partly filled buckets."""
    degree: int


def read_ksplat(path: Path) -> Gaussians:
    """Read a .ksplat of SH degree 0 to 3."""
    data = read_bytes(path)
    header = _parse_header(path, data)
    end = HEADER + header.num_sections * SECTION_HEADER
    check_size(path, len(data), end)
    parts = []
    for number in range(header.num_sections):
        section = _parse_section(path, data, HEADER + number * SECTION_HEADER)
        rows = _make_row_dtype(header.level, section.degree)
        start = end
        end += section.num_partial * 4 + section.num_buckets * section.bucket_bytes
        end += section.capacity * rows.itemsize
        check_size(path, len(data), end)
        if section.count:
            parts.append(_decode_section(path, data[start:end], header, section, rows))
    if not parts:
        raise InputError(f"{quote_value(path)} is empty: it holds no Gaussian.")
    return merge(parts)


def _parse_header(path: Path, data: bytes) -> KsplatHeader:
    check_size(path, len(data), HEADER)
    major, minor, sections = struct.unpack_from("<BBxxI", data)
    (level,) = struct.unpack_from("<H", data, 20)
    lowest, highest = struct.unpack_from("<ff", data, 36)
    if major != 0 or minor < 1 or level > 2:
        raise InputError(
            f"{quote_value(path)} is .ksplat version {major}.{minor} with compression {level}, "
            "which "
            "cannot be read; convert it to .ply."
        )
    return KsplatHeader(sections, level, lowest or -1.5, highest or 1.5)


def _parse_section(path: Path, data: bytes, offset: int) -> KsplatSection:
    count, capacity, bucket_size, buckets, block, bucket_bytes = struct.unpack_from(
        "<IIIIfH", data, offset
    )
    (steps,) = struct.unpack_from("<I", data, offset + 24)
    full, partial, degree = struct.unpack_from("<IIH", data, offset + 32)
    if degree >= len(NUM_SH_REST) or count > capacity:
        raise make_damage_error(path, "a section contradicts itself")
    return KsplatSection(
        count,
        capacity,
        bucket_size,
        buckets,
        block,
        bucket_bytes,
        steps or DEFAULT_STEPS,
        full,
        partial,
        degree,
    )


def _make_row_dtype(level: int, degree: int) -> np.dtype:
    centre, number = ("<f4", "<f4") if level == 0 else ("<u2", "<f2")
    return np.dtype(
        [
            ("mean", centre, 3),
            ("scale", number, 3),
            ("quat", number, 4),
            ("rgba", "u1", 4),
            ("rest", ("<f4", "<f2", "u1")[level], 3 * NUM_SH_REST[degree]),
        ]
    )


def _decode_section(
    path: Path, data: bytes, header: KsplatHeader, section: KsplatSection, row: np.dtype
) -> Gaussians:
    start = section.num_partial * 4 + section.num_buckets * section.bucket_bytes
    rows = np.frombuffer(data, row, section.count, start)
    rest = rows["rest"].astype(np.float64)
    if header.level == 2:
        rest = header.sh_min + rest / 255 * (header.sh_max - header.sh_min)
    rgba = rows["rgba"].astype(np.float32) / 255
    return build_gaussians(
        _decode_means(path, data, header, section, rows),
        rows["quat"].astype(np.float32),
        rows["scale"].astype(np.float32),
        rgba[:, 3],
        assemble_sh(rgba[:, :3], _reorder_sh(rest, section.degree)),
    )


def _decode_means(
    path: Path, data: bytes, header: KsplatHeader, section: KsplatSection, rows: ndarray
) -> Float[ndarray, "n 3"]:
    positions = rows["mean"].astype(np.float64)
    if header.level == 0:
        return positions
    step = section.bucket_side / 2 / section.num_steps
    return (positions - section.num_steps) * step + _lookup_centers(path, data, section)


def _lookup_centers(path: Path, data: bytes, section: KsplatSection) -> Float[ndarray, "n 3"]:
    """Look up the centre of each Gaussian's bucket."""
    if section.bucket_bytes < 12 or section.num_full + section.num_partial > section.num_buckets:
        raise make_damage_error(path, "its buckets are too small for their centres")
    partial = np.frombuffer(data, "<u4", section.num_partial).astype(np.int64)
    ends = np.cumsum(partial) + section.num_full * section.bucket_size
    numbers = np.arange(section.count)
    full = section.num_full * section.bucket_size
    of_partial = section.num_full + np.searchsorted(ends, numbers, side="right")
    bucket = np.where(numbers < full, numbers // max(section.bucket_size, 1), of_partial)
    if bucket.max() >= section.num_full + section.num_partial:
        raise make_damage_error(path, "its buckets hold fewer Gaussians than it claims")
    centres = np.ndarray(
        (section.num_buckets, 3), "<f4", data, section.num_partial * 4, (section.bucket_bytes, 4)
    )
    return centres[bucket]


def _reorder_sh(rest: Float[ndarray, "n m"], degree: int) -> Float[ndarray, "n k 3"]:
    """Reorder SH, stored by degree and then by channel, to [n, k, 3]."""
    bands, start = [np.empty((len(rest), 0, 3))], 0
    for band in range(1, degree + 1):
        width = 3 * (2 * band + 1)
        part = rest[:, start : start + width].reshape(len(rest), 3, -1)
        bands.append(part.transpose(0, 2, 1))
        start += width
    return np.concatenate(bands, axis=1)
