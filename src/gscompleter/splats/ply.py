"""Reader and writer of 3DGS .ply files.

Written is the standard layout (binary little-endian float32: x y z nx ny nz f_dc_* f_rest_*
opacity scale_* rot_*), then `uchar generated`. Read are the same properties in any order, type
and byte order, and ASCII. In the file scales are logarithms, opacities are logits, and f_rest_*
has all coefficients of red, then green, then blue. A comment marks antialiased Gaussians: Brush's
is written, Postshot's are read too.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.lib.recfunctions import require_fields, unstructured_to_structured
from torch import Tensor

from gscompleter.errors import InputError, quote_value, refuse_pointer
from gscompleter.io.files import replace_file
from gscompleter.io.reading import open_file
from gscompleter.kernels.parallel import map_in_parallel
from gscompleter.types import Gaussians

_SCALARS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_KINDS = {"<f4": "float", "<u4": "uint", "|u1": "uchar"}
_COUNTS = {name: kind for name, kind in _SCALARS.items() if kind[0] in "iu"}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = (*_MEANS, *_DC, "opacity", *_SCALES, *_QUATS)
_NUM_REST = (0, 9, 24, 45)
"""Number of properties f_rest_* for SH of degree 0 to 3."""

_MAX_LOGIT = 30.0
"""Opacities of 0 are written as this logit, negated."""

_MAX_SCALE = 1e38
"""Larger scales are clamped to this one, which is finite in float32."""

MODE_COMMENT = "comment SplatRenderMode: mip"
"""Header line that marks antialiased Gaussians."""
_MODE_LINE = re.compile(
    r"(?:comment|obj_info)\s+(?:SplatRenderMode|(?:postshot[._])?anti[-_ ]?alias(?:ed|ing)?)"
    r"\s*[:=\s]\s*(\w+)\s*",
    re.IGNORECASE,
)
_ANTIALIASED = ("mip", "antialiased", "1", "true")

BLOCK_ROWS = 8192
"""Rows processed at a time, so that all their columns stay in the cache."""


@dataclass(frozen=True)
class Property:
    """One property of an element."""

    name: str
    kind: str
    """numpy name of the type, without byte order."""
    count_kind: str | None = None
    """Type of the count of a list property."""


@dataclass(frozen=True)
class Element:
    """One element: a table."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)

    def dtype(self, byte_order: str) -> np.dtype:
        """Make the dtype of a row of a binary file without lists."""
        return np.dtype([(p.name, byte_order + p.kind) for p in self.properties])

    @property
    def has_lists(self) -> bool:
        """True if a property is a list."""
        return any(p.count_kind is not None for p in self.properties)


def read_header(file: BinaryIO, path: Path) -> tuple[str, list[Element]]:
    """Read format and elements; the file is left at the first byte of the data."""
    refuse_pointer(path)
    first = file.readline(512)
    if not first:
        raise InputError(f"{path} is empty; a 3DGS .ply is needed.")
    if first.strip() != b"ply":
        raise InputError(f"{path} is not a PLY file (it does not begin with 'ply').")

    file_format, elements = None, []
    while True:
        line = file.readline(4096)
        if not line.endswith(b"\n"):
            raise InputError(f"{path} is truncated: its header has no end; fetch the file again.")
        words = line.decode("latin-1").split()
        if words == ["end_header"]:
            break
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                file_format = words[1]
            elif words[0] == "element" and words[2].isdecimal():
                elements.append(Element(words[1], int(words[2])))
            elif words[0] == "property":
                elements[-1].properties.append(_parse_property(words[1:]))
            else:
                raise ValueError
        except (IndexError, KeyError, ValueError) as error:
            raise InputError(
                f"{path} has a broken header: the line '{quote_value(' '.join(words))}' is "
                "invalid; export it again."
            ) from error
    if file_format not in _BYTE_ORDERS:
        raise InputError(
            f"{path} has the PLY format '{quote_value(file_format)}'; ascii, "
            "binary_little_endian and binary_big_endian are known."
        )
    return file_format, elements


def read_mode(file: BinaryIO) -> bool:
    """Read from the header, up to the current position, if the Gaussians are antialiased."""
    end = file.tell()
    file.seek(0)
    lines = file.read(end).decode("latin-1").splitlines()
    modes = [found[1].lower() for line in lines if (found := _MODE_LINE.fullmatch(line.strip()))]
    return bool(modes) and modes[-1] in _ANTIALIASED


def _parse_property(words: list[str]) -> Property:
    if words[0] == "list":
        return Property(words[3], _SCALARS[words[2]], _COUNTS[words[1]])
    return Property(words[1], _SCALARS[words[0]])


def read_vertices(
    file: BinaryIO, file_format: str, ahead: list[Element], vertex: Element, path: Path
) -> np.ndarray:
    """Read the rows of `vertex` as a structured array, skipping the elements `ahead`."""
    for element in ahead:
        _check_claim(file, element, file_format, path)
    if file_format == "ascii":
        return _read_ascii_vertices(file, ahead, vertex, path)
    byte_order = _BYTE_ORDERS[file_format]
    for element in ahead:
        _skip(file, element, byte_order, path)
    dtype = vertex.dtype(byte_order)
    remaining = _count_bytes_left(file)
    if remaining < vertex.count * dtype.itemsize:
        raise _make_truncation_error(path, remaining // dtype.itemsize, vertex.count)
    if vertex.count == 0:
        return np.empty(0, dtype)
    # Rows are copied into columns directly from the memory map.
    return np.asarray(np.memmap(file, dtype, "r", file.tell(), (vertex.count,)))


def _check_claim(file: BinaryIO, element: Element, file_format: str, path: Path) -> None:
    """Refuse an element with more rows than fit into the rest of the file."""
    sizes = [np.dtype(p.count_kind or p.kind).itemsize for p in element.properties]
    # A number of an ASCII file has at least a digit and a separator.
    least = 2 * max(len(sizes), 1) if file_format == "ascii" else sum(sizes)
    remaining = _count_bytes_left(file) + 1  # the last line may lack its end
    if element.count * least > remaining:
        raise _make_truncation_error(path, remaining // least, element.count, element.name)


def _count_bytes_left(file: BinaryIO) -> int:
    return max(os.fstat(file.fileno()).st_size - file.tell(), 0)


def _skip(file: BinaryIO, element: Element, byte_order: str, path: Path) -> None:
    if not element.has_lists:
        file.seek(element.count * element.dtype(byte_order).itemsize, io.SEEK_CUR)
        return
    for row in range(element.count):
        for prop in element.properties:
            length = 1
            if prop.count_kind is not None:
                size = np.dtype(prop.count_kind).itemsize
                counted = file.read(size)
                if len(counted) < size:
                    raise _make_truncation_error(path, row, element.count, element.name)
                length = int(np.frombuffer(counted, byte_order + prop.count_kind)[0])
                if length < 0:
                    raise InputError(f"{path} holds a list of negative length; write it anew.")
            file.seek(length * np.dtype(prop.kind).itemsize, io.SEEK_CUR)


def _read_ascii_vertices(
    file: BinaryIO, ahead: list[Element], vertex: Element, path: Path
) -> np.ndarray:
    lines = (line for line in file if line.strip())
    for _ in range(sum(element.count for element in ahead)):
        next(lines, None)
    rows = [line.split() for _, line in zip(range(vertex.count), lines, strict=False)]
    width = len(vertex.properties)
    whole = len(rows) - (1 if rows and len(rows[-1]) < width else 0)
    if whole < vertex.count:
        raise _make_truncation_error(path, whole, vertex.count)
    try:
        table = np.array(rows, dtype=np.float64).reshape(vertex.count, width)
    except ValueError as error:
        raise InputError(
            f"{path} holds rows that are not {width} numbers each; write it anew."
        ) from error
    # Values out of range become infinite or wrong; relevant ones are checked later.
    with np.errstate(over="ignore", invalid="ignore"):
        return unstructured_to_structured(table, vertex.dtype("="))


def _make_truncation_error(
    path: Path, found: int, expected: int, what: str = "Gaussian"
) -> InputError:
    return InputError(
        f"{path} is truncated: {found:,} of {quote_value(f'{expected:,}')} {quote_value(what)}s "
        "are there; fetch or write the file again."
    )


def load_ply(path: Path | str, drop_nonfinite: bool = False) -> Gaussians:
    """Load the Gaussians of a 3DGS .ply of SH degree 0 to 3.

    With `drop_nonfinite`, Gaussians with NaN, infinity or a zero quaternion are dropped; otherwise
    the file is refused. Infinite opacity logits are valid: converters write them for opacities of 1
    and 0.

    Raises:
        InputError: The file is missing, no 3DGS .ply, empty, truncated or has invalid values.
    """
    path = Path(path)
    return require_finite(_read_gaussians(path), path, drop_nonfinite)


def find_finite_rows(path: Path) -> Bool[Tensor, "n"]:
    """Mark the Gaussians of a 3DGS .ply that `load_ply` keeps with `drop_nonfinite`."""
    return find_finite(_read_gaussians(path))


def _read_gaussians(path: Path) -> Gaussians:
    """Read all Gaussians of a file, non-finite ones included."""
    try:
        with open_file(path) as file:
            file_format, elements = read_header(file, path)
            is_antialiased = read_mode(file)
            vertex = _find_gaussian_element(elements, path)
            ahead = elements[: elements.index(vertex)]
            vertices = read_vertices(file, file_format, ahead, vertex, path)
    except OSError as error:
        raise InputError(f"Cannot read {quote_value(path)}: {error.strerror}.") from error
    return _decode_gaussians(vertices, vertex, is_antialiased)


def _find_gaussian_element(elements: list[Element], path: Path) -> Element:
    """Find the vertex element and check that it contains Gaussians."""
    found = {element.name: element for element in elements}
    vertex = found.get("vertex")
    if vertex is None:
        raise InputError(f"{path} has no vertices; a 3DGS .ply is needed.")
    names = [p.name for p in vertex.properties]
    for element in elements:
        if len({p.name for p in element.properties}) < len(element.properties):
            raise InputError(
                f"{path} has a broken header: a property of its element "
                f"'{quote_value(element.name)}' is named twice; write it anew."
            )
    if "chunk" in found or "packed_position" in names:
        raise InputError(
            f"{path} is a compressed PLY; convert it to a standard 3DGS .ply first, for example "
            "with SuperSplat or splat-transform."
        )
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise InputError(
            f"{path} is not a 3DGS scene but a mesh or point cloud: it lacks {', '.join(missing)}."
        )
    if vertex.has_lists:
        raise InputError(
            f"{path} is not a 3DGS scene: its vertices hold lists; write it anew without them."
        )
    num_rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    if num_rest not in _NUM_REST or any(f"f_rest_{i}" not in names for i in range(num_rest)):
        raise InputError(
            f"{path} has {num_rest} properties f_rest_*; spherical harmonics of degree 0 to 3 "
            "have 0, 9, 24 or 45, numbered from 0."
        )
    if vertex.count == 0:
        raise InputError(f"{path} is empty: it holds no Gaussian.")
    return vertex


def _decode_gaussians(vertices: np.ndarray, vertex: Element, is_antialiased: bool) -> Gaussians:
    def columns(names: tuple[str, ...]) -> Float[Tensor, "n c"]:
        table = np.empty((len(vertices), len(names)), np.float32)
        # A double beyond the range of float32 becomes infinite, and is checked later.
        with np.errstate(over="ignore"):
            for rows in iterate_blocks(len(vertices)):
                for column, name in enumerate(names):
                    table[rows, column] = vertices[name][rows]
        return torch.from_numpy(table)

    names = {p.name for p in vertex.properties}
    num_rest = sum(name.startswith("f_rest_") for name in names)
    rests = tuple(f"f_rest_{i}" for i in range(num_rest))
    tables = map_in_parallel(columns, [rests, _MEANS, _QUATS, (*_SCALES, "opacity"), _DC])
    rest, means, quats, encoded, dc = tables
    rest = rest.view(len(vertices), 3, num_rest // 3).transpose(1, 2)
    generated = np.zeros(len(vertices), np.uint8)
    if "generated" in names:
        with np.errstate(invalid="ignore"):
            generated = vertices["generated"].astype(np.uint8)
    return Gaussians(
        means=means,
        quats=quats,
        scales=_decode_scales(encoded),
        opacities=_decode_opacities(encoded),
        sh=torch.cat([dc[:, None], rest], dim=1).contiguous(),
        generated=torch.from_numpy(generated),
        encoded=encoded,
        is_antialiased=is_antialiased,
    )


def require_finite(gaussians: Gaussians, path: Path, drop_nonfinite: bool) -> Gaussians:
    """Refuse non-finite Gaussians of the file `path`, or drop them if some are finite."""
    good = find_finite(gaussians)
    bad = int((~good).sum())
    if bad == 0:
        return gaussians
    if not drop_nonfinite:
        raise InputError(
            f"{quote_value(path)} has {bad:,} of {len(good):,} Gaussians with NaN, infinity or a "
            "rotation of zeros; repair it, or drop what is not finite.",
            "drop_nonfinite",
        )
    if bad == len(good):
        raise InputError(
            f"{quote_value(path)} holds no Gaussian without NaN or infinity; write it anew."
        )
    return gaussians[good]


def find_finite(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Mark Gaussians without NaN, infinity (except in logits) and zero quaternions."""
    scales = gaussians.scales if gaussians.encoded is None else gaussians.encoded[:, :3]
    opacities, good = gaussians.opacities, (gaussians.quats != 0).any(1)
    tables = (gaussians.means, gaussians.quats, gaussians.scales, scales, gaussians.sh, opacities)
    for values in tables:
        if not values.sum().isfinite():  # ten times faster than a test of each value
            good &= values.isfinite().reshape(len(values), -1).all(1)
    return good


def iterate_blocks(count: int) -> Iterator[slice]:
    """Yield slices of `BLOCK_ROWS` rows from 0 to `count`."""
    return (slice(start, start + BLOCK_ROWS) for start in range(0, count, BLOCK_ROWS))


def _decode_scales(encoded: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3"]:
    return encoded[:, :3].double().exp_().float()


def _decode_opacities(encoded: Float[Tensor, "n 4"]) -> Float[Tensor, "n"]:
    return encoded[:, 3].double().sigmoid_().float()


def encode(gaussians: Gaussians) -> Float[Tensor, "n 4"]:
    """Compute log-scales and logit opacities for a file, always finite.

    Values read from a file are reused where they still decode to the values in memory.
    """
    tiny = torch.finfo(torch.float32).tiny
    scales = gaussians.scales.double().clamp(tiny, _MAX_SCALE).log()
    # The largest float32 below 1 has a logit of 16.6; a larger one could not be read back.
    opacities = gaussians.opacities.double().clamp(0, 1 - 2**-24).logit()
    anew = torch.cat([scales, opacities.clamp_min(-_MAX_LOGIT)[:, None]], dim=1).float()
    if gaussians.encoded is None:
        return anew
    held = gaussians.encoded
    same_scales = _decode_scales(held) == gaussians.scales
    same_opacities = _decode_opacities(held) == gaussians.opacities
    same = torch.cat([same_scales, same_opacities[:, None]], dim=1)
    return torch.where(same & held.isfinite(), held, anew)


def save_ply(path: Path | str, gaussians: Gaussians, provenance: bool | None = None) -> None:
    """Write a standard 3DGS .ply, with `uchar generated` after the standard properties.

    `provenance` decides if `generated` is written; the default is yes if anything was generated.
    Some readers (such as gsply 0.4) misread rows that end in a byte; False writes the plain layout.

    Raises:
        InputError: The file cannot be written; an existing one is kept.
    """
    if provenance is None:
        provenance = bool((gaussians.generated > 0).any())
    gaussians = gaussians.to("cpu")
    dtype = make_rows(gaussians[:0], provenance).dtype
    header = make_header({"vertex": (len(gaussians), dtype)}, gaussians.is_antialiased)
    with replace_file(path) as file:
        file.write(header)
        for block in iterate_blocks(len(gaussians)):
            file.write(make_rows(gaussians[block], provenance).view(np.uint8).data)


def make_header(elements: Mapping[str, tuple[int, np.dtype]], is_antialiased: bool) -> bytes:
    """Make the header of a binary .ply from the number and type of the rows of each element."""
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [MODE_COMMENT] if is_antialiased else []
    for name, (count, dtype) in elements.items():
        lines.append(f"element {name} {count}")
        lines += [f"property {_KINDS[dtype[column].str]} {column}" for column in dtype.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def make_rows(gaussians: Gaussians, provenance: bool) -> np.ndarray:
    """Make one row per Gaussian in the standard layout, with or without `generated`."""
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    encoded = encode(gaussians)
    columns = {
        _MEANS: gaussians.means,
        _NORMALS: torch.zeros_like(gaussians.means),
        _DC: gaussians.sh[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): encoded[:, 3:],
        _SCALES: encoded[:, :3],
        _QUATS: gaussians.quats,
    }
    dtype = [(name, "<f4") for names in columns for name in names]
    table = torch.cat(list(columns.values()), dim=1).detach().float().numpy()
    rows = np.ascontiguousarray(table, "<f4").view(dtype)[:, 0]
    if provenance:
        rows = require_fields(rows, [*dtype, ("generated", "u1")])
        rows["generated"] = gaussians.generated.numpy()
    return rows
