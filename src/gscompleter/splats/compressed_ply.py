"""The compressed .ply of SuperSplat: 16 bytes per Gaussian, and one per SH coefficient.

256 Gaussians form a chunk, which stores the bounds of its positions, log-scales and colours.
Relative to them, a Gaussian has 11, 10 and 11 bits of position and of scale and 8 bits per
channel and opacity; its rotation has 2 + 3 x 10 bits. SH of degree 1 and above are a separate
element of bytes over [-4, 4].
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt32
from numpy import ndarray

from gscompleter.errors import quote_value
from gscompleter.io.files import replace_file
from gscompleter.splats.packing import (
    assemble_sh,
    build_gaussians,
    check_size,
    drop_largest,
    make_damage_error,
    quantize,
    restore_largest,
    unpack_fraction,
)
from gscompleter.splats.ply import MODE_COMMENT, Element, encode, read_header, read_mode
from gscompleter.types import SH_C0, Gaussians

CHUNK_SIZE = 256
AXES, CHANNELS = ("x", "y", "z"), ("r", "g", "b")
CHUNK_PROPERTIES = (
    *(f"{end}_{axis}" for end in ("min", "max") for axis in AXES),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in AXES),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in CHANNELS),
)
"""Properties of a chunk. Early files lack the bounds of colours, which are then [0, 1]."""
PACKED_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
NUM_REST = (0, 9, 24, 45)
MAX_LOG_SCALE = 20.0
"""Largest absolute log-scale that is written, as in other writers."""


def read_compressed_ply(path: Path) -> Gaussians:
    """Read a compressed .ply of SH degree 0 to 3."""
    tables, is_antialiased = _read_tables(path)
    if not {"chunk", "vertex"} <= tables.keys():
        raise make_damage_error(path, "it has no chunks or no vertices")
    chunk, vertex = tables["chunk"], tables["vertex"]
    bounds = chunk.dtype.names or ()
    missing = [name for name in PACKED_PROPERTIES if name not in (vertex.dtype.names or ())]
    missing += [name for name in CHUNK_PROPERTIES[:12] if name not in bounds]
    if missing or len(chunk) * CHUNK_SIZE < len(vertex):
        raise make_damage_error(
            path, f"it lacks {', '.join(missing) or 'chunks for some of its vertices'}"
        )
    position, rotation, scale, color = (
        vertex[name].astype(np.uint32) for name in PACKED_PROPERTIES
    )
    means = _map_to_chunk_bounds(chunk, "", AXES, _unpack_three(position))
    scales = np.exp(_map_to_chunk_bounds(chunk, "scale_", AXES, _unpack_three(scale)))
    rgba = np.stack([unpack_fraction(color, shift, 8) for shift in (24, 16, 8, 0)], axis=1)
    has_colours = set(CHUNK_PROPERTIES) <= set(bounds)
    rgb = _map_to_chunk_bounds(chunk, "", CHANNELS, rgba[:, :3]) if has_colours else rgba[:, :3]
    rest = _unpack_sh_rest(path, tables.get("sh"), len(vertex))
    sh = assemble_sh(rgb, rest)
    gaussians = build_gaussians(means, _unpack_quats(rotation), scales, rgba[:, 3], sh)
    return replace(gaussians, is_antialiased=is_antialiased)


def _read_tables(path: Path) -> tuple[dict[str, ndarray], bool]:
    """Read the elements of a binary .ply by name, and if its Gaussians are antialiased."""
    with path.open("rb") as file:
        file_format, elements = read_header(file, path)
        is_antialiased = read_mode(file)
        data = file.read()
    if file_format != "binary_little_endian":
        raise make_damage_error(
            path, f"a compressed .ply is binary_little_endian, not {file_format}"
        )
    tables, start = {}, 0
    for element in elements:
        row = _make_row_dtype(path, element)
        check_size(path, len(data), start + element.count * row.itemsize)
        # An element without properties has no bytes, whatever count it claims.
        count = element.count if row.itemsize else 0
        tables[element.name] = np.frombuffer(data, row, count, start) if count else np.empty(0, row)
        start += count * row.itemsize
    return tables, is_antialiased


def _make_row_dtype(path: Path, element: Element) -> np.dtype:
    names = [p.name for p in element.properties]
    if element.has_lists or len(set(names)) < len(names):
        raise make_damage_error(
            path, f"its element '{quote_value(element.name)}' holds lists or a name twice"
        )
    return element.dtype("<")


def _unpack_three(packed: UInt32[ndarray, "n"]) -> Float[ndarray, "n 3"]:
    return np.stack(
        [
            unpack_fraction(packed, 21, 11),
            unpack_fraction(packed, 11, 10),
            unpack_fraction(packed, 0, 11),
        ],
        axis=1,
    )


def _map_to_chunk_bounds(
    chunk: ndarray, kind: str, axes: tuple[str, ...], fractions: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 3"]:
    """Map fractions to the bounds of each Gaussian's chunk; `kind` is "" or "scale_"."""
    of_chunk = np.arange(len(fractions)) // CHUNK_SIZE
    low = np.stack([chunk[f"min_{kind}{axis}"] for axis in axes], axis=1)[of_chunk]
    high = np.stack([chunk[f"max_{kind}{axis}"] for axis in axes], axis=1)[of_chunk]
    return low * (1 - fractions) + high * fractions


def _unpack_quats(packed: UInt32[ndarray, "n"]) -> Float[ndarray, "n 4"]:
    smaller = np.stack([unpack_fraction(packed, shift, 10) for shift in (20, 10, 0)], axis=1)
    return restore_largest(packed >> np.uint32(30), (smaller - 0.5) * np.float32(np.sqrt(2)))


def _unpack_sh_rest(
    path: Path, table: ndarray | None, count: int
) -> Float[ndarray, "n k 3"] | None:
    """Unpack SH of degree 1 and above; a byte stands for the middle of its interval."""
    if table is None:
        return None
    names = table.dtype.names or ()
    wanted = tuple(f"f_rest_{i}" for i in range(len(names)))
    if len(table) != count or len(names) not in NUM_REST or set(names) != set(wanted):
        raise make_damage_error(path, "its harmonics are not those of degree 0 to 3")
    if any(table.dtype[name] != np.uint8 for name in names):
        raise make_damage_error(path, "its harmonics are no bytes")
    packed = np.stack([table[name] for name in wanted], axis=1) if names else np.empty((count, 0))
    values = np.clip((packed.astype(np.float32) + 0.5) / 256, 0, 1)
    values = np.where(packed == 0, 0, np.where(packed == 255, 1, values)) * 8 - 4
    return values.reshape(count, 3, len(names) // 3).transpose(0, 2, 1)


# --------------------------------------------------------------------------------- writing


def write_compressed_ply(path: Path, gaussians: Gaussians) -> None:
    """Write a compressed .ply; the Gaussians should be sorted with `sort_along_morton`."""
    encoded = encode(gaussians).numpy()
    log_scales = np.clip(encoded[:, :3], -MAX_LOG_SCALE, MAX_LOG_SCALE)
    rgb = 0.5 + SH_C0 * gaussians.sh[:, 0].numpy()
    columns, fractions = [], []
    for values in (gaussians.means.numpy(), log_scales, rgb):
        low, high = _compute_chunk_bounds(values)
        columns += [low, high]
        fractions.append(_map_from_chunk_bounds(values, low, high))
    position, scale, color = fractions
    packed = np.stack(
        [
            _pack_three(position),
            _pack_quats(gaussians.quats.numpy()),
            _pack_three(scale),
            _pack_rgba(np.concatenate([color, gaussians.opacities.numpy()[:, None]], axis=1)),
        ],
        axis=1,
    )
    rest = _pack_sh_rest(gaussians)
    with replace_file(path) as file:
        file.write(_make_header(gaussians, len(columns[0]), rest.shape[1]))
        file.write(np.concatenate(columns, axis=1).astype("<f4").tobytes())
        file.write(packed.astype("<u4").tobytes())
        file.write(rest.tobytes())


def _compute_chunk_bounds(
    values: Float[ndarray, "n 3"],
) -> tuple[Float[ndarray, "c 3"], Float[ndarray, "c 3"]]:
    starts = np.arange(0, len(values), CHUNK_SIZE)
    return np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)


def _map_from_chunk_bounds(
    values: Float[ndarray, "n 3"], low: Float[ndarray, "c 3"], high: Float[ndarray, "c 3"]
) -> Float[ndarray, "n 3"]:
    of_chunk = np.arange(len(values)) // CHUNK_SIZE
    extent = np.where(high > low, high - low, 1)
    return (values - low[of_chunk]) / extent[of_chunk]


def _pack_three(fractions: Float[ndarray, "n 3"]) -> UInt32[ndarray, "n"]:
    a, b, c = (quantize(fractions[:, i], bits) for i, bits in enumerate((11, 10, 11)))
    return (a << np.uint32(21)) | (b << np.uint32(11)) | c


def _pack_quats(quats: Float[ndarray, "n 4"]) -> UInt32[ndarray, "n"]:
    largest, smaller = drop_largest(quats)
    a, b, c = quantize(smaller / np.sqrt(2) + 0.5, 10).T
    head = largest.astype(np.uint32) << np.uint32(30)
    return head | (a << np.uint32(20)) | (b << np.uint32(10)) | c


def _pack_rgba(fractions: Float[ndarray, "n 4"]) -> UInt32[ndarray, "n"]:
    r, g, b, a = quantize(fractions, 8).T
    return (r << np.uint32(24)) | (g << np.uint32(16)) | (b << np.uint32(8)) | a


def _pack_sh_rest(gaussians: Gaussians) -> UInt8[ndarray, "n m"]:
    """Pack SH of degree 1 and above into bytes: all of red, then green, then blue."""
    rest = gaussians.sh[:, 1:].transpose(1, 2).reshape(len(gaussians), -1).numpy()
    return np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)


def _make_header(gaussians: Gaussians, chunks: int, num_rest: int) -> bytes:
    count = len(gaussians)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [MODE_COMMENT] if gaussians.is_antialiased else []
    lines += [f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in CHUNK_PROPERTIES]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED_PROPERTIES)]
    if num_rest:
        lines += [f"element sh {count}"]
        lines += [f"property uchar f_rest_{i}" for i in range(num_rest)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def is_compressed_ply(head: bytes) -> bool:
    """Return True if a file with the first bytes `head` is a compressed .ply."""
    return head.startswith(b"ply") and b"packed_position" in head
