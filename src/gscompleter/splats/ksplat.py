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

from gscompleter.splats.packing import (
    NUM_SH_REST,
    UnsupportedError,
    assemble_sh,
    build_gaussians,
)
from gscompleter.splats.splat_format import FormatTexts, SplatFormat
from gscompleter.system.damage import DamagedError, check_rows
from gscompleter.system.files.reading import read_bytes
from gscompleter.types import Gaussians, merge

HEADER_BYTES = 4096
SECTION_HEADER_BYTES = 1024
KSPLAT_HEADER = struct.Struct("<BBxxI12xH14xff")
"""Version, number of sections, level of compression, SH values of bytes 0 and 255 at level 2."""
SECTION_HEADER = struct.Struct("<IIIIfHxxI4xIIH")
DEFAULT_STEPS = 32767
"""Default number of steps from the centre of a bucket to its side."""


class Section(NamedTuple):
    """The header of a section."""

    num_rows: int
    capacity: int
    """Rows that the section has space for."""
    bucket_size: int
    num_buckets: int
    bucket_side: float
    """In scene units."""
    bucket_bytes: int
    num_steps: int
    """Steps from the centre of a bucket to its side; 0 stands for the default."""
    num_full: int
    """Full buckets, which come first; partly filled ones follow."""
    num_partial: int
    degree: int

    @property
    def rows_offset(self) -> int:
        """Offset of the rows of Gaussians in the section, in bytes."""
        return self.num_partial * 4 + self.num_buckets * self.bucket_bytes


def read_ksplat(path: Path) -> Gaussians:
    """Read a .ksplat of SH degree 0 to 3."""
    data = memoryview(read_bytes(path))
    if len(data) < HEADER_BYTES:
        raise DamagedError("it ends within its header")
    major, minor, num_sections, level, *sh_range = KSPLAT_HEADER.unpack_from(data)
    if major != 0 or minor < 1 or level > 2:
        raise UnsupportedError(
            f"is .ksplat version {major}.{minor} with compression {level}, and version 0.1 with "
            "compression 0 to 2 is read"
        )
    parts = []
    check_rows(len(data) - HEADER_BYTES, SECTION_HEADER_BYTES, num_sections, "headers of sections")
    start = HEADER_BYTES + num_sections * SECTION_HEADER_BYTES
    for number in range(num_sections):
        header = SECTION_HEADER.unpack_from(data, HEADER_BYTES + number * SECTION_HEADER_BYTES)
        section = Section(*header)
        if section.degree >= len(NUM_SH_REST):
            raise DamagedError(f"its harmonics have degree {section.degree}")
        row = _make_row_dtype(level, section.degree)
        end = start + section.rows_offset + section.capacity * row.itemsize
        if section.num_rows:
            num_bytes = len(data) - start - section.rows_offset
            check_rows(num_bytes, row.itemsize, section.num_rows)
            parts.append(_decode_section(data[start:end], section, row, sh_range))
        start = end
    if not parts:
        raise DamagedError("it holds no Gaussians")
    return merge(parts)


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
    data: memoryview, section: Section, row: np.dtype, sh_range: list[float]
) -> Gaussians:
    rows = np.frombuffer(data, row, section.num_rows, section.rows_offset)
    rest = rows["rest"].astype(np.float64)
    if rows["rest"].dtype == np.uint8:
        # 0 stands for the default range.
        low = sh_range[0] or -1.5
        high = sh_range[1] or 1.5
        rest = low + rest / 255 * (high - low)
    # Level 0 has positions, the others steps from the centre of a bucket, from -num_steps on.
    means = rows["mean"].astype(np.float64)
    if rows["mean"].dtype == np.uint16:
        num_steps = section.num_steps or DEFAULT_STEPS
        step = section.bucket_side / 2 / num_steps
        means = (means - num_steps) * step + _lookup_centers(data, section)
    rgba = rows["rgba"].astype(np.float32) / 255
    return build_gaussians(
        means,
        rows["quat"].astype(np.float32),
        rows["scale"].astype(np.float32),
        rgba[:, 3],
        assemble_sh(rgba[:, :3], _reorder_sh(rest)),
    )


def _lookup_centers(data: memoryview, section: Section) -> Float[ndarray, "n 3"]:
    """Look up the centre of each Gaussian's bucket."""
    # Full buckets have `bucket_size` rows each; the file lists the sizes of the others.
    partial = np.frombuffer(data, "<u4", section.num_partial).astype(np.int64)
    full = section.num_full * section.bucket_size
    numbers = np.arange(section.num_rows)
    of_partial = section.num_full + np.searchsorted(full + partial.cumsum(), numbers, side="right")
    bucket = np.where(numbers < full, numbers // max(section.bucket_size, 1), of_partial)
    # Centres are three float32 at the start of each bucket's bytes.
    centers = np.ndarray(
        (section.num_buckets, 3),
        "<f4",
        data,
        offset=section.num_partial * 4,
        strides=(section.bucket_bytes, 4),
    )
    return centers[bucket]


def _reorder_sh(rest: Float[ndarray, "n m"]) -> Float[ndarray, "n k 3"]:
    """Reorder SH, stored by degree and then by channel, to [n, k, 3]."""
    # Degrees 1 to 3 have 3, 5 and 7 coefficients of three channels.
    degrees = np.split(rest, [9, 24], axis=1)
    return np.concatenate(
        [degree.reshape(len(rest), 3, -1).transpose(0, 2, 1) for degree in degrees], axis=1
    )


KSPLAT = SplatFormat(
    name="ksplat",
    endings=(".ksplat",),
    texts=FormatTexts(read="compression 0, 1 and 2, SH degree 0 to 3", precision=""),
    read=read_ksplat,
)
