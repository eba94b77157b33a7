"""The .ksplat format of GaussianSplats3D, read only.

A header of 4096 bytes and a header of 1024 bytes per section, then the sections: sizes of the
partly filled buckets, centres of all buckets, and one row per Gaussian. At compression level 0
rows are float32. From level 1 on, positions are 16-bit offsets from the centre of the bucket,
scales and rotations are half floats, and SH are half floats or (level 2) bytes.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_bytes
from gscompleter.splats.packing import (
    NUM_SH_REST,
    assemble_sh,
    build_gaussians,
    check_size,
    make_damage_error,
)
from gscompleter.types import Gaussians, merge

HEADER, SECTION_HEADER = 4096, 1024
HEADER_FIELDS = struct.Struct("<BBxxI12xH14xff")
SECTION_FIELDS = struct.Struct("<IIIIfHxxI4xIIH")
DEFAULT_STEPS = 32767
"""Default number of steps from the centre of a bucket to its side."""


class KsplatHeader(NamedTuple):
    """The header of the file, valid for all sections."""

    major: int
    minor: int
    num_sections: int
    level: int
    """0: float32; 1: 16 bits; 2: 16 bits, with SH in bytes."""
    sh_min: float
    """SH value of byte 0 at level 2."""
    sh_max: float
    """SH value of byte 255 at level 2."""


class KsplatSection(NamedTuple):
    """The header of a section."""

    num_rows: int
    capacity: int
    """Rows that the section has space for."""
    bucket_size: int
    num_buckets: int
    bucket_side: float
    """Side length of a bucket, in scene units."""
    bucket_bytes: int
    num_steps: int
    """Steps from the centre of a bucket to its side; 0 stands for the default."""
    num_full: int
    """Full buckets, which come first."""
    num_partial: int
    """Partly filled buckets."""
    degree: int

    @property
    def rows_offset(self) -> int:
        """Offset of the rows of Gaussians in the section, in bytes."""
        return self.num_partial * 4 + self.num_buckets * self.bucket_bytes


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
        end += section.rows_offset + section.capacity * rows.itemsize
        check_size(path, len(data), end)
        if section.num_rows:
            parts.append(_decode_section(path, data[start:end], header, section, rows))
    if not parts:
        raise InputError(f"{quote_value(path)} is empty: it holds no Gaussian.")
    return merge(parts)


def _parse_header(path: Path, data: bytes) -> KsplatHeader:
    check_size(path, len(data), HEADER)
    header = KsplatHeader(*HEADER_FIELDS.unpack_from(data))
    if header.major != 0 or header.minor < 1 or header.level > 2:
        raise InputError(
            f"{quote_value(path)} is .ksplat version {header.major}.{header.minor} with "
            f"compression {header.level}, which cannot be read; convert it to .ply."
        )
    return header._replace(sh_min=header.sh_min or -1.5, sh_max=header.sh_max or 1.5)


def _parse_section(path: Path, data: bytes, offset: int) -> KsplatSection:
    section = KsplatSection(*SECTION_FIELDS.unpack_from(data, offset))
    if section.degree >= len(NUM_SH_REST) or section.num_rows > section.capacity:
        raise make_damage_error(path, "a section contradicts itself")
    return section._replace(num_steps=section.num_steps or DEFAULT_STEPS)


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
    rows = np.frombuffer(data, row, section.num_rows, section.rows_offset)
    rest = rows["rest"].astype(np.float64)
    if header.level == 2:
        rest = header.sh_min + rest / 255 * (header.sh_max - header.sh_min)
    means = rows["mean"].astype(np.float64)
    if header.level > 0:
        step = section.bucket_side / 2 / section.num_steps
        means = (means - section.num_steps) * step + _lookup_centers(path, data, section)
    rgba = rows["rgba"].astype(np.float32) / 255
    return build_gaussians(
        means,
        rows["quat"].astype(np.float32),
        rows["scale"].astype(np.float32),
        rgba[:, 3],
        assemble_sh(rgba[:, :3], _reorder_sh(rest, section.degree)),
    )


def _lookup_centers(path: Path, data: bytes, section: KsplatSection) -> Float[ndarray, "n 3"]:
    """Look up the centre of each Gaussian's bucket."""
    if section.bucket_bytes < 12 or section.num_full + section.num_partial > section.num_buckets:
        raise make_damage_error(path, "its buckets are too small for their centres")
    partial = np.frombuffer(data, "<u4", section.num_partial).astype(np.int64)
    ends = np.cumsum(partial) + section.num_full * section.bucket_size
    numbers = np.arange(section.num_rows)
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
