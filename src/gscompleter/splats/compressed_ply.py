"""The compressed .ply of SuperSplat: 16 bytes per Gaussian, and one per SH coefficient.

256 Gaussians form a chunk, which stores the bounds of its positions, log-scales and colours.
Relative to them, a Gaussian has 11, 10 and 11 bits each for x, y and z of its position and of its
scale, and 8 bits each for red, green and blue; relative to [0, 1], it has 8 bits for its opacity.
Its rotation has 2 + 3 x 10 bits. SH of degree 1 and above are a separate element of bytes over
[-4, 4].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt32
from numpy import ndarray

from gscompleter.splats.packing import (
    MAX_LOG_SCALE,
    NUM_SH_REST,
    assemble_sh,
    build_gaussians,
    drop_largest,
    pack_fractions,
    restore_largest,
    unpack_fractions,
)
from gscompleter.splats.ply import (
    MODE_COMMENT,
    encode,
    has_mode_comment,
    is_packed,
    iterate_blocks,
    read_ply_record,
)
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance, add_comments
from gscompleter.splats.splat_format import PLY_MAGIC, FormatTexts, SplatFormat
from gscompleter.system.damage import DamagedError, check_rows
from gscompleter.system.files.ply import make_header, read_header
from gscompleter.system.files.writing import replace_file
from gscompleter.types import SH_C0, Gaussians

CHUNK_SIZE = 256
POSITION_BOUNDS = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
SCALE_BOUNDS = (
    *("min_scale_x", "min_scale_y", "min_scale_z"),
    *("max_scale_x", "max_scale_y", "max_scale_z"),
)
"""Bounds of log-scales."""
COLOR_BOUNDS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
"""Bounds of colours. Early files lack all of them, which are then [0, 1]."""
PACKED_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
VECTOR_BITS = (11, 10, 11)
"""Bits of positions and log-scales."""
QUAT_BITS = (10, 10, 10)
"""Bits of the three smaller components of a rotation. The upper two of its 32 bits are the number
of the largest component, which is not stored."""
COLOR_BITS = (8, 8, 8, 8)
"""Bits of red, green, blue and opacity."""


def tabulate_rest() -> Float32[ndarray, "256"]:
    """Tabulate the coefficient that each byte stands for: the middle of its interval.

    The first and the last byte stand for the ends, so that they are reached exactly.
    """
    shares = (np.arange(256, dtype=np.float32) + 0.5) / 256
    shares[[0, -1]] = [0, 1]
    return shares * 8 - 4


PLY_REST_VALUES = tabulate_rest()
"""Coefficient of SH of degree 1 and above that each byte stands for."""


def read_compressed_ply(path: Path) -> Gaussians:
    """Read a compressed .ply of SH degree 0 to 3."""
    header, tables = _read_tables(path)
    chunk = tables["chunk"]
    vertex = tables["vertex"]
    # The last chunk may have fewer Gaussians than the others.
    if len(chunk) * CHUNK_SIZE < len(vertex):
        raise DamagedError(
            f"its {len(chunk):,} chunks have too few bounds for its {len(vertex):,} Gaussians"
        )
    position, rotation, scale, color = [_get_packed(vertex, name) for name in PACKED_PROPERTIES]
    means = _map_to_chunk(chunk, POSITION_BOUNDS, unpack_fractions(position, VECTOR_BITS))
    log_scales = _map_to_chunk(chunk, SCALE_BOUNDS, unpack_fractions(scale, VECTOR_BITS))

    rgba = unpack_fractions(color, COLOR_BITS)
    rgb = rgba[:, :3]
    # A file with some of these bounds is refused for those that it lacks.
    if set(COLOR_BOUNDS) & set(chunk.dtype.names or ()):
        rgb = _map_to_chunk(chunk, COLOR_BOUNDS, rgb)

    # The three smaller components of a unit quaternion are at most sqrt(1/2) in size.
    smaller = (unpack_fractions(rotation, QUAT_BITS) - 0.5) * np.float32(np.sqrt(2))
    quats = restore_largest(rotation >> np.uint32(30), smaller)
    sh = assemble_sh(rgb, _unpack_sh_rest(tables["sh"]) if "sh" in tables else None)
    gaussians = build_gaussians(means, quats, np.exp(log_scales), rgba[:, 3], sh)
    return replace(gaussians, is_antialiased=has_mode_comment(header))


def list_compressed_names(path: Path) -> list[str]:
    """List the properties of the Gaussians that are not read."""
    with path.open("rb") as file:
        _, elements = read_header(file, path)
    vertex = next(element for element in elements if element.name == "vertex")
    return [name for name in vertex.dtype.names or () if name not in PACKED_PROPERTIES]


def _get_packed(vertex: ndarray, name: str) -> UInt32[ndarray, "n"]:
    """Return a property of the Gaussians as 32 bits; raise DamagedError if it is none."""
    _require_properties(vertex, [name])
    kind = vertex.dtype[name]
    if kind.kind not in "iu" or kind.itemsize != 4:
        raise DamagedError(f"its property '{name}' is no integer of 32 bits")
    return vertex[name].astype(np.uint32)


def _require_properties(table: ndarray, names: Sequence[str]) -> None:
    """Raise DamagedError if the rows of an element lack a property."""
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise DamagedError(f"it lacks the property '{missing[0]}'")


def _map_to_chunk(
    chunk: ndarray, bounds: Sequence[str], fractions: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 3"]:
    """Map fractions to the bounds of each Gaussian's chunk: three minima, then three maxima."""
    _require_properties(chunk, bounds)
    of_chunk = np.arange(len(fractions)) // CHUNK_SIZE
    limits = np.stack([chunk[name] for name in bounds], axis=1)[of_chunk]
    return limits[:, :3] * (1 - fractions) + limits[:, 3:] * fractions


def _read_tables(path: Path) -> tuple[bytes, dict[str, ndarray]]:
    """Read the header and the elements of a binary .ply by name."""
    with path.open("rb") as file:
        header, elements = read_header(file, path)
        data = file.read()
    if b"\nformat binary" not in header:
        raise DamagedError("it is no binary file")
    tables = {}
    start = 0
    for element in elements:
        if element.dtype.itemsize > 0:
            what = "Gaussians" if element.name == "vertex" else f"rows of '{element.name}'"
            check_rows(len(data) - start, element.dtype.itemsize, element.count, what)
            rows = np.frombuffer(data, element.dtype, element.count, start)
            tables[element.name] = rows
            start += rows.nbytes
    return header, tables


def _unpack_sh_rest(table: ndarray) -> Float[ndarray, "n k 3"]:
    """Unpack SH of degree 1 and above."""
    fields: Mapping[str, Any] = table.dtype.fields or {}
    if len(fields) not in [3 * k for k in NUM_SH_REST]:
        raise DamagedError(
            f"it has {len(fields)} properties of spherical harmonics, and 9, 24 or 45 are those of "
            "degree 1 to 3"
        )
    # The file has one channel after the other.
    names = [f"f_rest_{i}" for i in range(len(fields))]
    _require_properties(table, names)
    if any(fields[name][0] != np.uint8 for name in names):
        raise DamagedError("its spherical harmonics are no bytes")
    columns = np.array([fields[name][1] for name in names]).reshape(3, -1).T
    rows = table.view(np.uint8).reshape(len(table), table.dtype.itemsize)
    rest = np.empty((len(table), *columns.shape), np.float32)
    for block in iterate_blocks(len(table)):
        rest[block] = PLY_REST_VALUES[rows[block][:, columns]]
    return rest


def write_compressed_ply(
    path: Path, gaussians: Gaussians, made_by: Provenance = NOTHING_KNOWN
) -> None:
    """Write a compressed .ply; the Gaussians should be sorted with `sort_along_morton`."""
    log_scales = np.clip(encode(gaussians)[:, :3].numpy(), -MAX_LOG_SCALE, MAX_LOG_SCALE)
    rgb = 0.5 + SH_C0 * gaussians.sh[:, 0].numpy()
    # Row of the first Gaussian of each chunk, and chunk of each Gaussian.
    starts = np.arange(0, len(gaussians), CHUNK_SIZE)
    of_chunk = np.arange(len(gaussians)) // CHUNK_SIZE
    bounds = []
    fractions = []
    for values in (gaussians.means.numpy(), log_scales, rgb):
        low = np.minimum.reduceat(values, starts)
        high = np.maximum.reduceat(values, starts)
        # A chunk without extent has the fraction 0 instead of 0 / 0.
        extent = np.where(high > low, high - low, 1)
        bounds += [low, high]
        fractions.append((values - low[of_chunk]) / extent[of_chunk])
    position, scale, color = fractions
    rgba = np.concatenate([color, gaussians.opacities.numpy()[:, None]], axis=1)
    largest, smaller = drop_largest(gaussians.quats.numpy())
    rotation = pack_fractions(smaller / np.sqrt(2) + 0.5, QUAT_BITS)
    columns = [
        pack_fractions(position, VECTOR_BITS),
        (largest.astype(np.uint32) << np.uint32(30)) | rotation,
        pack_fractions(scale, VECTOR_BITS),
        pack_fractions(rgba, COLOR_BITS),
    ]
    num_rest = 3 * (gaussians.sh.shape[1] - 1)
    with replace_file(path) as file:
        header = _make_header(gaussians, len(starts), num_rest)
        file.write(add_comments(header, made_by))
        file.write(np.concatenate(bounds, axis=1).astype("<f4").tobytes())
        file.write(np.stack(columns, axis=1).astype("<u4").tobytes())
        # Some at a time, so that all steps find their numbers in the cache.
        for block in iterate_blocks(len(gaussians)):
            rest = gaussians.sh[block, 1:].transpose(1, 2).numpy()
            # The byte of the interval that a value in [-4, 4] lies in.
            places = np.floor((rest / 8 + 0.5) * 256)
            file.write(np.clip(places, 0, 255).astype(np.uint8).tobytes())


def _make_header(gaussians: Gaussians, num_chunks: int, num_rest: int) -> bytes:
    """Make the header of a file, with `num_rest` SH coefficients of degree 1 and above."""
    count = len(gaussians)
    bounds = (*POSITION_BOUNDS, *SCALE_BOUNDS, *COLOR_BOUNDS)
    rest = [(f"f_rest_{i}", "u1") for i in range(num_rest)]
    elements = {
        "chunk": (num_chunks, np.dtype([(name, "<f4") for name in bounds])),
        "vertex": (count, np.dtype([(name, "<u4") for name in PACKED_PROPERTIES])),
    }
    if rest:
        elements["sh"] = (count, np.dtype(rest))
    return make_header(elements, MODE_COMMENT if gaussians.is_antialiased else None)


COMPRESSED_PLY = SplatFormat(
    name="compressed-ply",
    endings=(".compressed.ply",),
    texts=FormatTexts(
        title="SuperSplat",
        read="with and without bounds of colours and harmonics",
        written="with both, along a Morton curve",
        precision="position and log-scale 11, 10, 11 bits within 256 neighbours; rotation 10 bits "
        "a component; colour and opacity 8 bits; harmonics in steps of 1/32 up to ±4",
        places={
            "read_record": "the comments of a .ply",
            "marks_antialiased": "the comments of a .ply",
            "list_names": "those of Gaussians",
        },
    ),
    read=read_compressed_ply,
    starts=(PLY_MAGIC,),
    recognize=lambda path, head: is_packed(head),
    write=write_compressed_ply,
    read_record=read_ply_record,
    list_names=list_compressed_names,
    marks_antialiased=True,
    is_sorted=True,
    rounds_geometry=True,
)
