"""Splats in the layout of their own .ply: header, foreign columns and property order.

An input splat is completed in its own file: its rows stay byte for byte, `uchar generated` is
appended to them, and new rows follow. Removing both restores the input file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, UInt8
from numpy import ndarray
from numpy.lib.recfunctions import require_fields
from torch import Tensor

from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.ply import (
    MEANS,
    count_rest,
    iterate_blocks,
    make_rows,
    read_columns,
    read_scene,
    save_ply,
)
from gscompleter.splats.ply_file import PlyFile, write_ply_file
from gscompleter.types import Gaussians, merge

LABEL_COLUMN = "generated"
_LABEL_LINE = re.compile(rb"^property\s+\w+\s+generated\s*?\n", re.M)
_ELEMENT_LINE = re.compile(rb"^(?:element|end_header)", re.M)


def find_layout(path: Path | None) -> PlyFile | None:
    """Read the layout of the file of a splat, or None if it is no binary .ply."""
    if path is None or detect_splat_format(path) != "ply":
        return None
    layout = read_scene(path)
    return None if layout.is_ascii else layout


def split_header(header: bytes) -> tuple[bytes, bytes, bytes]:
    """Split a header into the lines of the first element, those of others, and its end."""
    starts = [line.start() for line in _ELEMENT_LINE.finditer(header)]
    return header[: starts[1]], header[starts[1] : starts[-1]], header[starts[-1] :]


def drop_generated(layout: PlyFile) -> PlyFile:
    """Remove the generated rows and the column `generated`."""
    if LABEL_COLUMN not in (layout.rows.dtype.names or ()):
        return layout
    dtype = [column for column in layout.rows.dtype.descr if column[0] != LABEL_COLUMN]
    rows = require_fields(layout.rows[layout.rows[LABEL_COLUMN] == 0], dtype)
    return replace(layout, header=_LABEL_LINE.sub(b"", layout.header), rows=rows)


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
    numbers = None if layout is None else _match_rows(layout, context, added, kept)
    if layout is None or numbers is None:
        save_ply(path, merge([context, added]), provenance=True)
        return
    header, label = _add_label_line(layout.header), [(LABEL_COLUMN, "u1")]
    if LABEL_COLUMN in (layout.rows.dtype.names or ()):
        header, label = layout.header, []
    dtype = np.dtype([*layout.rows.dtype.descr, *label])

    def write_labels(values: ndarray, labels: UInt8[Tensor, "m"]) -> ndarray:
        rows = require_fields(values, dtype)
        rows[LABEL_COLUMN] = labels.numpy()
        return rows

    def generate_blocks() -> Iterator[ndarray]:
        for block in iterate_blocks(len(context)):
            yield write_labels(layout.rows[numbers[block]], context.generated[block])
        yield write_labels(make_rows(added, provenance=False), added.generated)

    write_ply_file(path, header, len(context) + len(added), generate_blocks(), layout.trailer)


def _match_rows(
    layout: PlyFile, context: Gaussians, added: Gaussians, kept: Bool[Tensor, "n"] | None
) -> Int[ndarray, "m"] | None:
    """Find the rows of a file that its context was read from, or None if `added` do not fit in."""
    names = layout.rows.dtype.names or ()
    if LABEL_COLUMN in names and layout.rows.dtype[LABEL_COLUMN] != np.uint8:
        return None
    numbers = np.arange(len(layout.rows)) if kept is None else np.flatnonzero(kept.numpy())
    means = read_columns(layout.rows, MEANS)[numbers]
    fits = count_rest(layout) == 3 * (added.sh.shape[1] - 1)
    return numbers if fits and np.array_equal(means, context.means.numpy()) else None


def _add_label_line(header: bytes) -> bytes:
    """Add a line for `generated` at the end of the first element."""
    first, others, end = split_header(header)
    ending = b"\r\n" if end.endswith(b"\r\n") else b"\n"
    return b"".join([first, b"property uchar generated", ending, others, end])
