"""A .ply with the layout of its writer: header, extra columns and property order.

An input splat is completed in its own file: its rows stay byte for byte, `uchar generated` is
appended to them, and new rows follow. Removing both restores the input file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, UInt8
from numpy import ndarray
from numpy.lib.recfunctions import require_fields
from torch import Tensor

from gscompleter.io.files import replace_file
from gscompleter.splats.ply import (
    iterate_blocks,
    make_header,
    make_rows,
    read_header,
    save_ply,
)
from gscompleter.types import Gaussians, merge

LABEL_COLUMN = "generated"
_COUNT_LINE = re.compile(rb"^(element\s+vertex\s+)\d+", re.M)
_LABEL_LINE = re.compile(rb"^property\s+\w+\s+generated\s*?\n", re.M)


@dataclass(frozen=True)
class PlyLayout:
    """A binary .ply whose first element contains Gaussians."""

    header: bytes
    """Everything up to and including `end_header`."""
    rows: ndarray
    """One structured row per Gaussian, [n]."""
    trailer: bytes = b""
    """Everything after the last row."""

    @property
    def is_labelled(self) -> bool:
        """True if there is a column `generated`."""
        return LABEL_COLUMN in (self.rows.dtype.names or ())

    @property
    def num_rest(self) -> int:
        """Number of properties for SH of degree 1 and above."""
        return sum(name.startswith("f_rest_") for name in self.rows.dtype.names or ())

    def split_header(self) -> tuple[list[bytes], list[bytes]]:
        """Split the header into lines before and after the end of the vertex element."""
        lines = self.header.splitlines(keepends=True)
        starts = [i for i, line in enumerate(lines) if line.startswith((b"element", b"end_header"))]
        return lines[: starts[1]], lines[starts[1] :]


def read_layout(path: Path) -> PlyLayout | None:
    """Read the layout of a .ply, or None if it is ASCII or begins with another element."""
    with path.open("rb") as file:
        file_format, (vertex, *_) = read_header(file, path)
        if file_format == "ascii" or vertex.name != "vertex":
            return None
        size = file.tell()
        file.seek(0)
        header = file.read(size)
        byte_order = "<" if file_format == "binary_little_endian" else ">"
        rows = np.memmap(file, vertex.dtype(byte_order), "r", size, vertex.count)
        file.seek(size + rows.nbytes)
        return PlyLayout(header, rows, file.read())


def find_layout(given: Path | None) -> PlyLayout | None:
    """Read the layout of the file of a scene, or None if it is no binary .ply."""
    is_ply = given is not None and given.name.lower().endswith(".ply")
    return read_layout(given) if given is not None and is_ply else None


def make_layout(gaussians: Gaussians) -> PlyLayout:
    """Make the standard layout, with `generated` if anything was generated."""
    rows = make_rows(gaussians, bool((gaussians.generated > 0).any()))
    header = make_header({"vertex": (len(rows), rows.dtype)}, gaussians.is_antialiased)
    return PlyLayout(header, rows)


def write_layout(path: Path, layout: PlyLayout) -> None:
    """Write a .ply, with the number of its rows in the header."""
    write_rows(path, layout, len(layout.rows), [layout.rows])


def write_rows(path: Path, layout: PlyLayout, count: int, rows: Iterable[ndarray]) -> None:
    """Write a .ply with other `rows` of the same type, `count` in total, block by block."""
    with replace_file(path) as file:
        file.write(_COUNT_LINE.sub(rb"\g<1>" + str(count).encode(), layout.header, count=1))
        for part in rows:
            file.write(part.view(np.uint8).data)
        file.write(layout.trailer)


def drop_generated(layout: PlyLayout) -> PlyLayout:
    """Remove the generated rows and the column `generated`."""
    if not layout.is_labelled:
        return layout
    dtype = [column for column in layout.rows.dtype.descr if column[0] != LABEL_COLUMN]
    rows = require_fields(layout.rows[layout.rows[LABEL_COLUMN] == 0], dtype)
    return replace(layout, header=_LABEL_LINE.sub(b"", layout.header), rows=rows)


def insert_rows(
    layout: PlyLayout, others: PlyLayout, row_numbers: Int[Tensor, "m"]
) -> PlyLayout | None:
    """Insert the rows of `others` at the indices `row_numbers`; None if their columns differ."""
    if others.rows.dtype != layout.rows.dtype:
        return None
    total = len(layout.rows) + len(others.rows)
    taken = np.zeros(total, bool)
    taken[row_numbers.numpy()] = True
    rows = np.empty(total, layout.rows.dtype)
    rows[taken], rows[~taken] = others.rows, layout.rows
    return replace(layout, rows=rows)


def save_like(
    path: Path,
    context: Gaussians,
    added: Gaussians,
    given: Path,
    kept: Bool[Tensor, "n"] | None = None,
) -> None:
    """Write a completed scene in the layout of the input file `given`.

    The standard layout is used if `given` is ASCII or no .ply, has a column `generated` of another
    type, fewer SH coefficients than `added`, or rows that do not match `context`. `kept` marks the
    rows of `given` that the context has; None for all.
    """
    context, layout = context.to("cpu"), find_layout(given)
    added = merge([context[:0], added.to("cpu")])
    numbers = _match_rows(context, layout, kept) if layout and _can_hold(layout, added) else None
    if layout is None or numbers is None:
        save_ply(path, merge([context, added]), provenance=True)
        return
    label = [] if layout.is_labelled else [(LABEL_COLUMN, "u1")]
    dtype = np.dtype([*layout.rows.dtype.descr, *label])

    def labelled(values: ndarray, labels: UInt8[Tensor, "m"]) -> ndarray:
        rows = require_fields(values, dtype)
        rows[LABEL_COLUMN] = labels.numpy()
        return rows

    given_rows = (
        labelled(layout.rows[numbers[block]], context.generated[block])
        for block in iterate_blocks(len(context))
    )
    added_rows = labelled(make_rows(added, provenance=False), added.generated)
    header = layout.header if layout.is_labelled else _add_label_line(layout)
    count = len(context) + len(added)
    write_rows(path, replace(layout, header=header), count, chain(given_rows, [added_rows]))


def _can_hold(layout: PlyLayout, scene: Gaussians) -> bool:
    labels = not layout.is_labelled or layout.rows.dtype[LABEL_COLUMN] == np.uint8
    return labels and layout.num_rest == 3 * (scene.sh.shape[1] - 1)


def _match_rows(
    context: Gaussians, layout: PlyLayout, kept: Bool[Tensor, "n"] | None
) -> Int[ndarray, "m"] | None:
    """Find the rows of a file that its context was read from, or None if positions differ."""
    numbers = np.arange(len(layout.rows)) if kept is None else np.flatnonzero(kept.numpy())
    if len(numbers) != len(context):
        return None
    means = context.means.numpy()
    stands = all(
        np.array_equal(layout.rows[axis][numbers[block]].astype(np.float32), means[block, column])
        for block in iterate_blocks(len(numbers))
        for column, axis in enumerate("xyz")
    )
    return numbers if stands else None


def _add_label_line(layout: PlyLayout) -> bytes:
    """Add a line for `generated` after the last vertex property of the header."""
    lines, after = layout.split_header()
    last = max(i for i, line in enumerate(lines) if line.startswith(b"property"))
    ending = b"\r\n" if lines[last].endswith(b"\r\n") else b"\n"
    lines.insert(last + 1, b"property uchar generated" + ending)
    return b"".join(lines + after)
