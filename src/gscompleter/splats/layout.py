"""Splats in the layout of their own .ply: header, foreign columns and property order.

An input splat is completed in its own file: its rows stay byte for byte, `float generated` is
appended to them, and new rows follow. A column of bytes, which earlier versions appended, becomes
one of floats. Removing both restores the input file. Gaussians that were
removed or recoloured are in `removed.ply` as they were, with their row numbers in the input scene:
a 3DGS .ply with a further element `place` that has one property `uint row`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int, Int64, UInt8
from numpy import ndarray
from numpy.lib.recfunctions import require_fields
from torch import Tensor

from gscompleter.numerics.value_checks import find_finite
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import (
    detect_splat_format,
    load_splat,
    read_provenance,
    save_splat,
)
from gscompleter.splats.ply import (
    BLOCK_ROWS,
    CHUNK_ROWS,
    LABEL_COLUMN,
    LABEL_TYPES,
    MEANS,
    PLY,
    SceneFile,
    append_labels,
    check_finite,
    count_rest,
    decode_gaussians,
    has_mode_comment,
    has_surfels,
    iterate_blocks,
    make_rows,
    make_scene_header,
    read_columns,
    read_labels,
    read_means,
    read_scene,
    require_finite,
    save_parts,
)
from gscompleter.splats.provenance import RunRecord, make_comment_lines
from gscompleter.splats.table import get_written_format
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.mapping import release_pages
from gscompleter.system.files.ply import write_ply_file
from gscompleter.system.files.result_names import REMOVED_FILE
from gscompleter.types import NUM_SH, Gaussians, merge

_STORED = ("means", "quats", "scales", "opacities", "sh", "generated")
LABEL_LINES = re.compile(
    rb"^property\s+\w+\s+generated\s*?\n((?:comment gscompleter-provenance/[^\n]*\n)*)", re.M
)
"""The line of the labels, with the comments of runs that follow it as its group."""
LABEL_TYPE = re.compile(rb"^(property\s+)\w+(\s+generated\s*?\n)", re.M)
"""The line of the labels, with its type in the middle."""
_ELEMENT_LINE = re.compile(rb"^(?:element|end_header)", re.M)


def find_layout(path: Path | None) -> SceneFile | None:
    """Read the layout of the file of a splat, or None if it is no binary .ply of usual numbers."""
    if path is None or detect_splat_format(path) != "ply":
        return None
    layout = read_scene(path)
    return None if layout.is_ascii or not layout.is_usual else layout


def split_header(header: bytes) -> tuple[bytes, bytes, bytes]:
    """Split a header into the lines of the first element, those of others, and its end."""
    starts = [line.start() for line in _ELEMENT_LINE.finditer(header)]
    return header[: starts[1]], header[starts[1] : starts[-1]], header[starts[-1] :]


def drop_generated(layout: SceneFile) -> SceneFile:
    """Remove the generated rows, the column `generated`, and who made them."""
    if LABEL_COLUMN not in (layout.rows.dtype.names or ()):
        return layout
    dtype = [column for column in layout.rows.dtype.descr if column[0] != LABEL_COLUMN]
    rows = require_fields(layout.rows[read_labels(layout.rows) == 0], dtype)
    return replace(layout, header=LABEL_LINES.sub(b"", layout.header, 1), rows=rows)


def save_like(
    path: Path,
    context: Gaussians,
    added: Gaussians,
    given: Path,
    kept: Bool[Tensor, "n"] | None = None,
    order: Int64[Tensor, "m"] | None = None,
    run: RunRecord | None = None,
) -> None:
    """Write a completed scene in the layout of the input file `given`; `run` made it.

    The standard layout is used if `given` is ASCII or no .ply, has surfels (two scales cannot hold
    `added`), a column `generated` of another type, fewer SH coefficients than `added`, or rows that
    do not match `context`. `kept` marks the rows of `given` that are written; None for all. `order`
    are the Gaussians of the context that they belong to; None for all in their order. Rows go from
    file to file, some at a time.
    """
    layout = find_layout(given)
    added = merge([context[:0].to("cpu"), added.to("cpu")])
    order = torch.arange(len(context)) if order is None else order.to("cpu")
    numbers = None
    if layout is not None and _can_hold(layout, added):
        numbers = np.arange(len(layout.rows)) if kept is None else np.flatnonzero(kept.numpy())
    if layout is None or numbers is None or not _is_read_from(layout, numbers, context, order):
        made_by = read_provenance(given)
        made_by = made_by if run is None else made_by.plus(run)
        parts = [(context, order), (added, torch.arange(len(added)))]
        save_parts(path, parts, provenance=True, made_by=made_by)
        return
    # The file's own columns stay as they are; only `generated` is added, or written anew.
    header, dtype = _add_labels(layout)
    if run is not None:
        header = _add_run(header, run)

    def write_labels(values: ndarray, labels: UInt8[Tensor, "k"]) -> ndarray:
        if values.dtype.descr == dtype.descr[:-1]:
            return append_labels(values, dtype, labels.numpy())
        rows = require_fields(values, dtype)
        rows[LABEL_COLUMN] = labels.numpy()
        return rows

    def generate_blocks() -> Iterator[ndarray]:
        for block, rows in iterate_rows(layout, numbers):
            yield write_labels(rows, context.generated[order[block]].cpu())
        for block in iterate_blocks(len(added)):
            yield write_labels(make_rows(added, False, block), added.generated[block])

    write_ply_file(path, header, len(order) + len(added), generate_blocks(), layout.trailer)


def iterate_rows(layout: SceneFile, numbers: Int[ndarray, "m"]) -> Iterator[tuple[slice, ndarray]]:
    """Yield copies of rows by ascending numbers, some at a time, with their places among these."""
    # As plain bytes: of rows with names NumPy copies property after property, twenty times as slow.
    dtype = layout.rows.dtype
    raw = layout.rows.view(np.dtype((np.void, dtype.itemsize)))
    for block in iterate_blocks(len(numbers)):
        chosen = numbers[block]
        yield block, raw[chosen].view(dtype)
        # The system maps some pages before those that are read, too, which were released already.
        release_pages(layout.rows[max(chosen[0] - BLOCK_ROWS, 0) : chosen[-1] + 1])


def _can_hold(layout: SceneFile, added: Gaussians) -> bool:
    """Return True if rows of a file can hold `added`, and their labels."""
    names = layout.rows.dtype.names or ()
    has_other_labels = LABEL_COLUMN in names and layout.rows.dtype[LABEL_COLUMN] not in LABEL_TYPES
    has_all_sh = count_rest(layout) == 3 * (added.sh.shape[1] - 1)
    return has_all_sh and not has_surfels(layout) and not has_other_labels


def _is_read_from(
    layout: SceneFile, numbers: Int[ndarray, "m"], context: Gaussians, order: Int64[Tensor, "k"]
) -> bool:
    """Return True if the positions of rows are those of Gaussians of the context, one by one.

    They tell that the order is the same. Whoever takes a scene of which other values may have been
    changed compares all of them before (`has_same_values`).
    """
    if len(numbers) != len(order) or layout.origin != context.origin:
        return False
    for block, rows in iterate_rows(layout, numbers):
        origin = layout.origin
        means = read_columns(rows, MEANS) if origin is None else read_means(rows, origin)
        if not np.array_equal(means, context.means[order[block]].cpu().numpy()):
            return False
    return True


def _add_labels(layout: SceneFile) -> tuple[bytes, np.dtype]:
    """Return header and type of rows with `float generated`, after all other columns if it is new.

    Numbers of the file have one byte order.
    """
    kind = ">f4" if b"\nformat binary_big_endian" in layout.header else "<f4"
    columns = [
        (LABEL_COLUMN, kind) if column[0] == LABEL_COLUMN else column
        for column in layout.rows.dtype.descr
    ]
    if LABEL_COLUMN in (layout.rows.dtype.names or ()):
        return LABEL_TYPE.sub(rb"\g<1>float\g<2>", layout.header, 1), np.dtype(columns)
    first, others, end = split_header(layout.header)
    ending = b"\r\n" if end.endswith(b"\r\n") else b"\n"
    header = b"".join([first, b"property float generated", ending, others, end])
    return header, np.dtype([*columns, (LABEL_COLUMN, kind)])


def _add_run(header: bytes, run: RunRecord) -> bytes:
    """Add the comment of a run after the line of the labels and the comments of earlier runs."""
    lines = LABEL_LINES.search(header)
    assert lines is not None
    ending = b"\r\n" if lines[0].endswith(b"\r\n") else b"\n"
    return header[: lines.end()] + make_comment_lines([run], ending) + header[lines.end() :]


def is_same_scene(path: Path, other: Path) -> bool:
    """Return True if two .ply hold the same Gaussians in the same order; some are read at a time.

    Their columns may have another order, and their headers other comments.
    """
    if {detect_splat_format(path), detect_splat_format(other)} != {"ply"}:
        return False
    scenes = [read_scene(path), read_scene(other)]
    if len(scenes[0].rows) != len(scenes[1].rows) or count_rest(scenes[0]) != count_rest(scenes[1]):
        return False
    for start in range(0, len(scenes[0].rows), CHUNK_ROWS):
        rows = slice(start, start + CHUNK_ROWS)
        first, second = (decode_gaussians(replace(s, rows=s.rows[rows])) for s in scenes)
        if first.origin != second.origin or not has_same_values(first, second):
            return False
    return True


def has_same_values(first: Gaussians, second: Gaussians) -> bool:
    """Return True if two splats have the same Gaussians with the same labels in the same order."""
    return first.is_antialiased == second.is_antialiased and all(
        torch.equal(getattr(first, name), getattr(second, name)) for name in _STORED
    )


def strip(path: Path, out: Path) -> tuple[int, int]:
    """Write the input scene of the completed scene at `path`.

    If both are .ply, the layout of the file is kept. Returns the numbers of Gaussians written and
    left out.
    """
    path = resolve_splat(path)
    layout = find_layout(path)
    if layout is not None and get_written_format(out) is PLY:
        counts = strip_rows(path, layout, out)
        if counts is not None:
            return counts
    # A file with properties of its own is given back; nothing is shown.
    completed = load_splat(path, ignore_properties=True)
    scene = drop_sh_padding(completed)
    layout = None if layout is None else drop_generated(layout)
    removed = path.parent / REMOVED_FILE
    if removed.is_file():
        scene, layout = reinsert(scene, layout, removed, completed.generated.numpy() > 0)
    if len(scene) == 0:
        raise InputError(
            f"{quote_value(path)} holds only generated Gaussians: there is no input scene to "
            "restore."
        )
    # The rows of the file cannot be copied if they have the SH of the generated Gaussians.
    is_padded = layout is None or count_rest(layout) != 3 * (scene.sh.shape[1] - 1)
    if layout is None or is_padded or get_written_format(out) is not PLY:
        save_splat(out, scene)
    else:
        write_ply_file(out, layout.header, len(layout.rows), [layout.rows], layout.trailer)
    return len(scene), int((completed.generated > 0).sum())


def strip_rows(path: Path, layout: SceneFile, out: Path) -> tuple[int, int] | None:
    """Write the input scene from the rows of a completed .ply, some at a time, as `strip` does.

    None if rows cannot be copied: the file has the SH of generated Gaussians of a higher degree, or
    the originals beside it have other columns. It is refused as `load_splat` refuses it.
    """
    labels = np.zeros(len(layout.rows), np.uint8)
    has_sh = np.zeros(2, np.bool_)
    count = 0
    for start in range(0, len(layout.rows), CHUNK_ROWS):
        chunk = decode_gaussians(replace(layout, rows=layout.rows[start : start + CHUNK_ROWS]))
        count += int(find_finite(chunk).sum())
        labels[start : start + CHUNK_ROWS] = chunk.generated.numpy()
        # The harmonics of the highest degree, of what was given and of what was generated.
        highest = chunk.sh[:, NUM_SH[max(chunk.sh_degree - 1, 0)] :].flatten(1).any(dim=1).numpy()
        for index, is_of_kind in enumerate((chunk.generated == 0, chunk.generated > 0)):
            has_sh[index] |= bool(highest[is_of_kind.numpy()].any())
    check_finite(count, len(labels), path, drop_nonfinite=False)
    # A scene of lower degree was padded with zeros, which the generated Gaussians fill.
    if has_sh[1] and not has_sh[0]:
        return None

    numbers = np.flatnonzero(labels == 0)
    header = LABEL_LINES.sub(b"", layout.header, 1)
    dtype = np.dtype([c for c in layout.rows.dtype.descr if c[0] != LABEL_COLUMN])
    originals = np.empty(0, dtype)
    taken = np.zeros(len(numbers), np.bool_)
    removed = path.parent / REMOVED_FILE
    if removed.is_file():
        source = read_scene(removed)
        is_antialiased = has_mode_comment(layout.header)
        rows = find_observed_places(source, removed, labels > 0, is_antialiased)
        originals = drop_generated(source).rows
        if originals.dtype != dtype or len(originals) != len(rows):
            return None
        taken = np.zeros(len(numbers) + len(rows), np.bool_)
        taken[rows] = True
    if len(taken) == 0:
        return None

    def generate_blocks() -> Iterator[ndarray]:
        kept = 0
        restored = 0
        for block in iterate_blocks(len(taken)):
            # The originals take their rows, the others the rest, in their order.
            is_original = taken[block]
            rows = np.empty(len(is_original), dtype)
            num_kept = int((~is_original).sum())
            for _, copied in iterate_rows(layout, numbers[kept : kept + num_kept]):
                rows[~is_original] = drop_generated(replace(layout, rows=copied)).rows
            num_restored = len(rows) - num_kept
            rows[is_original] = originals[restored : restored + num_restored]
            kept += num_kept
            restored += num_restored
            yield rows

    write_ply_file(out, header, len(taken), generate_blocks(), layout.trailer)
    return len(taken), len(labels) - len(numbers)


def find_places(
    source: SceneFile, path: Path, num_kept: int, is_antialiased: bool
) -> Int64[ndarray, "n"]:
    """Find the rows of the originals of the file `path` in a scene of `num_kept` others.

    Raises InputError if they are not finite, or do not say where they belong in that scene.
    """
    removed = require_finite(decode_gaussians(source), path, drop_nonfinite=False)
    total = num_kept + len(removed)
    rows = np.zeros(0, np.int64)
    if b"element place " in source.header and len(source.trailer) == 4 * len(removed):
        rows = source.trailer.view("<u4").astype(np.int64)
    # Row numbers ascend, and the last one lies within the scene.
    is_ordered = len(rows) > 0 and bool((np.diff(rows, append=total) > 0).all())
    if not is_ordered or is_antialiased != removed.is_antialiased:
        raise InputError(
            f"{quote_value(path)} does not say where its Gaussians belong in the scene beside it; "
            "fetch both files again."
        )
    return rows


def find_observed_places(
    source: SceneFile, path: Path, is_generated: Bool[ndarray, "m"], is_antialiased: bool
) -> Int64[ndarray, "_n"]:
    """Find the rows of the observed originals of a file among the observed rows of a splat.

    `is_generated` marks rows of the splat. Originals that are generated, which an edit took out
    after another one had added them, have no row. Raises the errors of `find_places`.
    """
    is_observed = np.ones(len(source.rows), np.bool_)
    if LABEL_COLUMN in (source.rows.dtype.names or ()):
        is_observed = read_labels(source.rows) == 0
    if is_observed.all():
        # All that is generated came after them.
        return find_places(source, path, int((~is_generated).sum()), is_antialiased)
    places = find_places(source, path, len(is_generated), is_antialiased)
    # Of the rows of the splat that stand before an original, only the observed ones stay.
    before = places - np.arange(len(places))
    num_observed = np.append(0, (~is_generated).cumsum())[before]
    return num_observed[is_observed] + np.arange(is_observed.sum())


def drop_sh_padding(completed: Gaussians) -> Gaussians:
    """Select the observed Gaussians, without the SH padding of a scene of lower degree."""
    observed = completed[completed.generated == 0]
    generated = completed[completed.generated > 0]
    # A scene of lower degree was padded with zeros, which the generated Gaussians fill. Where both
    # are zero, the degree is that of the file.
    k = completed.sh.shape[1]
    for lower in [width for width in (9, 4, 1) if width < k]:
        if not generated.sh[:, lower:k].any() or observed.sh[:, lower:k].any():
            break
        k = lower
    return replace(observed, sh=observed.sh[:, :k].contiguous())


def save_removed(
    path: Path,
    removed: Gaussians,
    rows: Int[Tensor, "n"],
    given: Path | None = None,
    kept: Bool[Tensor, "m"] | None = None,
) -> None:
    """Write replaced originals with their ascending row numbers in the input scene.

    The rows of a binary .ply `given` are copied with all of their properties. `kept` marks the rows
    of `given` that the scene has; None for all.
    """
    layout = find_layout(given)
    if layout is None:
        has_labels = bool((removed.generated > 0).any())
        header = make_scene_header(removed, has_labels)
        blocks: Iterable[ndarray] = [make_rows(removed, has_labels)]
    else:
        numbers = rows.numpy() if kept is None else np.flatnonzero(kept.numpy())[rows.numpy()]
        header = layout.header
        # Rows that lie all over a file would map the whole of it.
        blocks = (values for _, values in iterate_rows(layout, numbers))
    first, _, end = split_header(header)
    place = f"element place {len(rows)}\nproperty uint row\n".encode()
    trailer = rows.numpy().astype("<u4")
    write_ply_file(path, b"".join([first, place, end]), len(rows), blocks, trailer)


def reinsert(
    kept: Gaussians, layout: SceneFile | None, path: Path, is_generated: Bool[ndarray, "m"]
) -> tuple[Gaussians, SceneFile | None]:
    """Insert the replaced originals of the file `path` at their rows; None if columns differ.

    `kept` are the observed Gaussians of a splat whose generated rows are marked.
    """
    source = read_scene(path)
    rows = find_observed_places(source, path, is_generated, kept.is_antialiased)
    removed = decode_gaussians(source)
    removed = removed[removed.generated == 0]
    total = len(kept) + len(removed)
    # Place of each Gaussian: the originals take their rows, the others the rest, in their order.
    taken = torch.zeros(total, dtype=torch.bool)
    taken[torch.from_numpy(rows)] = True
    order = torch.empty(total, dtype=torch.int64)
    order[~taken] = torch.arange(len(kept))
    order[taken] = torch.arange(len(kept), total)
    restored = merge([kept, removed])[order]
    others = drop_generated(source).rows
    if layout is None or others.dtype != layout.rows.dtype or len(others) != len(removed):
        return restored, None
    joined = np.concatenate([layout.rows, others], dtype=others.dtype)
    return restored, replace(layout, rows=joined[order.numpy()])
