"""Tables in .ply files: a header of elements and properties, then the rows of each element.

Binary files of both byte orders and ASCII are read, if they begin with the element `vertex`; binary
little-endian ones are written. What the columns mean is up to the callers: Gaussians, or points.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import UInt8
from numpy.lib.recfunctions import unstructured_to_structured

from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value, refuse_pointer
from gscompleter.system.files.reading import open_file
from gscompleter.system.files.writing import replace_file

PLY_SCALARS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
MAX_HEADER_LINE = 4096
"""Longest line of a header that is read, in bytes with its ending."""
_NAMES = {"<f4": "float", "<f8": "double", "<u4": "uint", "|u1": "uchar"}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_COUNT_LINE = re.compile(rb"^(element\s+vertex\s+)\d+", re.M)


@dataclass(frozen=True)
class Element:
    """One element: a table."""

    name: str
    count: int
    dtype: np.dtype
    """Type of a row; lists are objects, and such rows cannot be read."""
    lists: Mapping[str, tuple[str, str]]
    """Words of the header for the types of the count and of the values of each list, by name."""


@dataclass(frozen=True)
class PlyFile:
    """A .ply that begins with the element `vertex`."""

    header: bytes
    """Everything up to and including `end_header`."""
    rows: np.ndarray
    """One structured row per vertex, [n]."""
    trailer: UInt8[np.ndarray, "m"]
    """Everything after the last row of a binary file, in bytes; nothing of an ASCII one."""
    is_ascii: bool = False


def read_header(file: BinaryIO, path: Path) -> tuple[bytes, list[Element]]:
    """Read the header and its elements; the file is left at the first byte of the data."""
    refuse_pointer(path)
    lines = [file.readline(512)]
    if lines[0].strip() != b"ply":
        raise InputError(
            f"{quote_value(path)} is empty or not a PLY file (it does not begin with 'ply')."
        )
    while lines[-1].split() != [b"end_header"]:
        lines.append(file.readline(MAX_HEADER_LINE))
        if not lines[-1].endswith(b"\n"):
            raise InputError(
                f"{quote_value(path)} is truncated: its header has no end; fetch the file again."
            )
    try:
        header = b"".join(lines)
        return header, parse_elements(header)
    except DamagedError as error:
        raise InputError(
            f"{quote_value(path)} has a broken header ({quote_value(describe_damage(error))}); "
            "export it again."
        ) from error


def parse_elements(header: bytes) -> list[Element]:
    """Parse the elements of a header that ends with `end_header`; DamagedError for a broken one."""
    tables: list[tuple[str, int, list[tuple[str, str]], dict[str, tuple[str, str]]]] = []
    byte_order: str | None = None
    # Without the first line, `ply`, and the last one.
    for line in header.split(b"\n")[1:-2]:
        words = line.decode("latin-1").split()
        # The header is changed by expressions that look for words at the beginnings of lines.
        if words and line[:1].isspace():
            raise DamagedError(f"'{' '.join(words)}' is indented")
        if words[:1] == ["element"] and byte_order is None:
            raise DamagedError("no format is named before the first element")
        try:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", name, *_] if byte_order is None:
                    byte_order = _BYTE_ORDERS[name]
                case ["element", name, count] if count.isdecimal():
                    tables.append((name, int(count), [], {}))
                case ["property", "list", count_type, value_type, name]:
                    tables[-1][2].append((name, "O"))
                    tables[-1][3][name] = (count_type, value_type)
                case ["property", kind, name]:
                    tables[-1][2].append((name, f"{byte_order}{PLY_SCALARS[kind]}"))
                case _:
                    raise DamagedError
        except (LookupError, ValueError) as error:
            # An unknown format or a second one, an unknown type, a property of no element, or other
            # words.
            raise DamagedError(" ".join(words)) from error
    for name, _, columns, _ in tables:
        if len({column for column, _ in columns}) < len(columns):
            raise DamagedError(f"'{name}' has a property more than once")
    return [
        Element(name, count, np.dtype(columns), lists) for name, count, columns, lists in tables
    ]


def read_ply_file(
    path: Path,
    needed: Sequence[str],
    kind: str,
    describe_content: Callable[[Sequence[Element], Sequence[str]], str | None] | None = None,
    unit: str = "points",
) -> PlyFile:
    """Read a file whose vertices have the properties `needed`.

    Errors name the `kind` of file, and the `unit` that a row is. `describe_content` says what a
    file holds instead, from its elements and the missing properties; None if it does not know.
    """
    with open_file(path) as file:
        header, elements = read_header(file, path)
        vertex = elements[0] if elements and elements[0].name == "vertex" else None
        names = () if vertex is None else vertex.dtype.names or ()
        missing = [name for name in needed if name not in names]
        if vertex is None or missing or vertex.dtype.hasobject:
            content = describe_content(elements, missing) if describe_content else None
            if content is not None:
                raise InputError(f"{quote_value(path)} is no {kind} but {content}.")
            properties = ", ".join(missing or names)
            raise InputError(
                f"{quote_value(path)} is no {kind}: it does not begin with vertices that have "
                f"{properties} and no lists."
            )
        is_ascii = re.search(rb"^format\s+ascii", header, re.M) is not None
        if is_ascii:
            rows = _read_ascii_rows(file, vertex, path)
            trailer = np.empty(0, np.uint8)
        else:
            rows = _map_rows(file, vertex.dtype, len(header), vertex.count)
            trailer = _map_rows(file, np.dtype(np.uint8), len(header) + rows.nbytes)
        if len(rows) < vertex.count:
            raise InputError(
                f"{quote_value(path)} is truncated: it ends after {len(rows):,} of "
                f"{quote_value(f'{vertex.count:,}')} {unit}; fetch or write the file again."
            )
        return PlyFile(header, rows, trailer, is_ascii)


def _map_rows(file: BinaryIO, dtype: np.dtype, start: int, count: int | None = None) -> np.ndarray:
    """Map rows of a binary file into memory: those that it has, at most `count`."""
    # The header may claim any count; no memory is taken for rows that are not there.
    available = max(os.fstat(file.fileno()).st_size - start, 0) // dtype.itemsize
    number = available if count is None else min(count, available)
    if number == 0:
        return np.empty(0, dtype)
    return np.asarray(np.memmap(file, dtype, "r", start, (number,)))


def _read_ascii_rows(file: BinaryIO, vertex: Element, path: Path) -> np.ndarray:
    lines = (line.split() for line in file if line.strip())
    rows = list(islice(lines, vertex.count))
    width = len(vertex.dtype.names or ())
    try:
        table = np.array(rows, np.float64).reshape(len(rows), width)
    except ValueError as error:
        raise InputError(
            f"{quote_value(path)} holds rows that are not {width} numbers each; write it anew."
        ) from error
    # Digits that a float cannot hold are kept, such as those of map coordinates.
    columns: Mapping[str, Any] = vertex.dtype.fields or {}
    kinds = {name: columns[name][0] for name in vertex.dtype.names or ()}
    wide = [(name, "f8" if kind == np.dtype("f4") else kind) for name, kind in kinds.items()]
    # Values out of range become infinite or wrong; relevant ones are checked later.
    with np.errstate(over="ignore", invalid="ignore"):
        return unstructured_to_structured(table, np.dtype(wide))


def make_header(elements: Mapping[str, tuple[int, np.dtype]], comment: str | None = None) -> bytes:
    """Make the header of a binary .ply from the number and type of the rows of each element."""
    lines = ["ply", "format binary_little_endian 1.0"]
    if comment is not None:
        lines.append(f"comment {comment}")
    for name, (count, dtype) in elements.items():
        lines.append(f"element {name} {count}")
        lines += [f"property {_NAMES[dtype[column].str]} {column}" for column in dtype.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def write_ply_file(
    path: Path | str,
    header: bytes,
    count: int,
    blocks: Iterable[np.ndarray],
    trailer: np.ndarray | None = None,
) -> None:
    """Write a .ply with `count` rows in total, which replaces the number in the header."""
    with replace_file(path) as file:
        file.write(_COUNT_LINE.sub(rb"\g<1>" + str(count).encode(), header, count=1))
        for rows in chain(blocks, () if trailer is None else [trailer]):
            file.write(rows.view(np.uint8).data)
