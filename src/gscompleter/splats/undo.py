"""Taking edits off a splat, one by one: each earlier state comes back row by row.

A row is known by a key: the number of the edit that appended it, 0 for the splat at first, and its
place among these. Every edit keeps rows in their order and appends others, so that the keys of each
state ascend. Without some of the edits, the splat has the rows that none of the others left out.

The splat at first is that before the first edit that is taken off: the edits before it stay, and
their rows need not be known.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gscompleter.splats.edits import Edit, Edits, read_edits
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.layout import LABEL_LINES, LABEL_TYPE, find_places, iterate_rows, strip
from gscompleter.splats.ply import (
    LABEL_COLUMN,
    PLY,
    SceneFile,
    has_mode_comment,
    iterate_blocks,
    read_labels,
    read_scene,
)
from gscompleter.splats.table import get_written_format
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.mapping import release_pages
from gscompleter.system.files.ply import write_ply_file
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.result_names import EDITS_FILE

Keys = Int64[ndarray, "_n"]
"""Number of the edit that appended each row, and its place among these in the lower 40 bits."""
PLACE_BITS = 40
"""Bits of the place in a key: enough for any file, and 23 are left for the number of the edit."""
NO_KEYS = np.empty(0, np.int64)


@dataclass(frozen=True)
class Originals:
    """Rows that edits left out."""

    keys: Keys
    """Key of each row, ascending."""
    scenes: Sequence[SceneFile]
    places: Int64[ndarray, "n 2"]
    """Number of the scene of each row, and the row in it."""


@dataclass(frozen=True)
class Undone:
    """What was written, and what was left out."""

    kept: int
    """Gaussians that were written."""
    dropped: int
    """Gaussians that the edits had added."""
    is_same_file: bool = False
    """True if the file is known to be byte for byte the one before these edits."""
    missing: int = 0
    """Gaussians that the splat had before all edits, and that nothing tells any more."""


def strip_edits(path: Path, out: Path, numbers: Collection[int] | None = None) -> Undone:
    """Write a splat without some of its edits, which are numbered from 1; None for all of them.

    If all edits go, a splat is stripped by its labels where these tell what its only edit added, or
    where there is no record, or its earlier states are not known. They do not tell what edits
    before the last one left out, which is then missing.

    `numbers` has one at least. Raises InputError if there is no such edit, or if the states before
    it are not known.
    """
    path = resolve_splat(path)
    edits = read_edits(path)
    every = range(1, len(edits.edits) + 1)
    chosen = every if numbers is None else numbers
    is_all = numbers is None or (bool(edits) and set(numbers) == set(every))
    # Rows of other formats than .ply have no columns that could be copied. Of a single edit, labels
    # tell as much as rows if nothing had one before it, also where its additions have harmonics of
    # a higher degree, which rows cannot lose again.
    has_rows = detect_splat_format(path) == PLY.name and bool(edits) and can_undo(edits, 1)
    if not is_all or (has_rows and (len(every) > 1 or had_generated(path, edits))):
        return undo_edits(path, edits, chosen, out)
    kept, dropped = strip(path, out)
    if not edits:
        return Undone(kept, dropped)
    first = edits.edits[0]
    is_same = first.given is not None and hash_file(out) == first.given
    return Undone(kept, dropped, is_same, max(first.rows - kept, 0))


def can_undo(edits: Edits, first: int) -> bool:
    """Return True if the rows of all states from an edit on are known."""
    return edits.is_unchanged and all(edit.can_be_undone for edit in edits.edits[first - 1 :])


def had_generated(path: Path, edits: Edits) -> bool:
    """Return True if a splat had labelled Gaussians before its only edit.

    By labels alone, these would go with what the edit added.
    """
    (edit,) = edits.edits
    layout = read_scene(path)
    # The rows that an edit appended are the last ones.
    is_given = np.arange(len(layout.rows)) < len(layout.rows) - edit.added
    if has_labels(layout, is_given):
        return True
    if edit.originals is None or not (edits.folder / edit.originals).is_file():
        return False
    left_out = read_scene(edits.find(edit.originals))
    return has_labels(left_out, np.ones(len(left_out.rows), bool))


def undo_edits(path: Path, edits: Edits, numbers: Collection[int], out: Path) -> Undone:
    """Write a splat without some of its edits, row by row; errors as those of `strip_edits`."""
    check_undone(path, edits, numbers, out)
    layout = read_scene(path)
    first = min(numbers)
    # From here on, `later` are all edits there are, and are counted from the first that goes.
    later = replace(edits, edits=edits.edits[first - 1 :])
    check_counts(path, later, len(layout.rows))
    states, left_out = compute_keys(later)

    remaining = [index for index in range(len(later.edits)) if first + index not in numbers]
    appended = [make_keys(0, later.edits[0].rows)]
    appended += [make_keys(index + 1, later.edits[index].added) for index in remaining]
    # What an edit left out comes back with it, unless another edit left it out; no row is left out
    # twice.
    gone = [left_out[index].keys for index in remaining]
    keys = np.setdiff1d(np.concatenate(appended), np.concatenate([NO_KEYS, *gone]))
    originals = join_originals(left_out)

    is_kept = np.isin(states[-1], keys, assume_unique=True)
    header, dtype = make_remaining_header(layout, later.edits, remaining, is_kept)

    def generate_blocks() -> Iterator[ndarray]:
        for block in iterate_blocks(len(keys)):
            yield copy_rows(layout, states[-1], originals, keys[block], dtype)

    write_ply_file(out, header, len(keys), generate_blocks(), layout.trailer)
    # Without all edits from the first on, it is a state that was a file once.
    earlier = None if remaining else later.edits[0].given
    dropped = int(np.count_nonzero(~is_kept))
    return Undone(len(keys), dropped, earlier is not None and hash_file(out) == earlier)


def check_undone(path: Path, edits: Edits, numbers: Collection[int], out: Path) -> None:
    """Refuse edits that there are not, or whose rows are not known."""
    count = len(edits.edits)
    if not edits:
        raise InputError(
            f"There is no {EDITS_FILE} beside {quote_value(path)}, which lists its edits; take it "
            "from the folder of results, or undo all edits at once."
        )
    for number in numbers:
        if not 1 <= number <= count:
            raise InputError(
                f"There is no edit {number} of {quote_value(path)}, whose edits are numbered from "
                f"1 to {count}.",
                "edit",
            )
    if detect_splat_format(path) != PLY.name:
        raise InputError(
            f"{quote_value(path)} is no .ply, of which alone edits can be taken off one by one; "
            "undo all edits at once."
        )
    first = min(numbers)
    if not can_undo(edits, first):
        raise InputError(
            f"{quote_value(path)} was changed by another program after edit {first}, was written "
            "in a format that sorts Gaussians, or its reconstruction got new colours, so that this "
            "edit cannot be taken off alone; undo all edits at once."
        )
    if get_written_format(out) is not PLY:
        raise InputError("An earlier state is a .ply; name such a file.", "out")


def make_keys(number: int, count: int) -> Keys:
    """Make the keys of the rows that an edit appended."""
    return (np.int64(number) << PLACE_BITS) + np.arange(count, dtype=np.int64)


def split_key(keys: Keys) -> tuple[Keys, Keys]:
    """Split keys into the number of the edit and the place among the rows that it appended."""
    return keys >> PLACE_BITS, keys & ((1 << PLACE_BITS) - 1)


def check_counts(path: Path, edits: Edits, total: int) -> None:
    """Refuse a record whose numbers of rows do not lead to the `total` of the splat.

    They may come from elsewhere, and arrays of their size are made.
    """
    count = edits.edits[0].rows
    is_right = count >= 0
    for edit in edits.edits:
        gone = count_originals(edits, edit)
        is_right &= edit.rows == count and 0 <= gone <= count and edit.added >= 0
        count += edit.added - gone
    if not is_right or count != total:
        raise InputError(
            f"{quote_value(path)} has {total:,} Gaussians, to which the numbers of {EDITS_FILE} "
            "beside it do not lead; fetch all files of its folder again."
        )


def count_originals(edits: Edits, edit: Edit) -> int:
    """Count the rows that an edit left out."""
    if edit.originals is None:
        return 0
    return len(read_scene(edits.find(edit.originals)).rows)


def compute_keys(edits: Edits) -> tuple[list[Keys], list[Originals]]:
    """Compute the keys of the rows of all states, and of those that each edit left out."""
    states = [make_keys(0, edits.edits[0].rows)]
    left_out = []
    for number, edit in enumerate(edits.edits, start=1):
        gone = read_originals(edits, edit, states[-1])
        left_out.append(gone)
        kept = np.setdiff1d(states[-1], gone.keys, assume_unique=True)
        states.append(np.concatenate([kept, make_keys(number, edit.added)]))
    return states, left_out


def read_originals(edits: Edits, edit: Edit, before: Keys) -> Originals:
    """Read the rows that an edit left out of a state."""
    none = np.empty((0, 2), np.int64)
    if edit.originals is None:
        return Originals(NO_KEYS, (), none)
    path = edits.find(edit.originals)
    scene = read_scene(path)
    num_kept = len(before) - len(scene.rows)
    places = find_places(scene, path, num_kept, has_mode_comment(scene.header))
    rows = np.stack([np.zeros_like(places), np.arange(len(places))], axis=1)
    return Originals(before[places], (scene,), rows)


def join_originals(parts: Sequence[Originals]) -> Originals:
    """Join the rows that several edits left out."""
    scenes: list[SceneFile] = []
    places = []
    for part in parts:
        places.append(part.places + np.array([len(scenes), 0]))
        scenes += part.scenes
    # In the order of their keys, in which rows are looked up.
    keys = np.concatenate([part.keys for part in parts])
    order = keys.argsort()
    return Originals(keys[order], scenes, np.concatenate(places)[order])


def has_labels(layout: SceneFile, mask: Bool[ndarray, "n"]) -> bool:
    """Return True if any of the rows in a mask is labelled as generated."""
    if LABEL_COLUMN not in (layout.rows.dtype.names or ()):
        return False
    for block in iterate_blocks(len(mask)):
        rows = layout.rows[block]
        is_found = bool(read_labels(rows)[mask[block]].any())
        release_pages(rows)
        if is_found:
            return True
    return False


def make_remaining_header(
    layout: SceneFile,
    edits: Sequence[Edit],
    remaining: Sequence[int],
    is_kept: Bool[ndarray, "n"],
) -> tuple[bytes, np.dtype]:
    """Make header and type of rows without the comments of the edits that are taken off.

    `edits` are those from the first that is taken off, and `remaining` the indices of those that
    stay. Without any, the column of labels is what it was before the first. `is_kept` marks the
    rows of the splat that stay.
    """
    had_labels = edits[0].had_labels
    found = LABEL_LINES.search(layout.header)
    if found is None:
        return layout.header, layout.rows.dtype
    columns = layout.rows.dtype.descr
    label_line = layout.header[found.start() : found.start(1)]
    # Comments of the splat before the first edit, then those of each.
    comments = found[1].splitlines(keepends=True)
    start = len(comments) - sum(edit.records for edit in edits)
    kept = comments[:start]
    for index, edit in enumerate(edits):
        if index in remaining:
            kept += comments[start : start + edit.records]
        start += edit.records
    dtype = layout.rows.dtype
    if not remaining and had_labels is None:
        # The edits added the column, unless the splat before them was of another format: it had no
        # column then, but may have had labels and comments, which are in this one since.
        if not kept and not has_labels(layout, is_kept):
            label_line = b""
            dtype = np.dtype([column for column in columns if column[0] != LABEL_COLUMN])
    elif not remaining and had_labels == "uchar":
        label_line = LABEL_TYPE.sub(rb"\g<1>uchar\g<2>", label_line, count=1)
        dtype = np.dtype([(c[0], "u1") if c[0] == LABEL_COLUMN else c for c in columns])
    parts = [layout.header[: found.start()], label_line, *kept, layout.header[found.end() :]]
    return b"".join(parts), dtype


def copy_rows(
    layout: SceneFile, final: Keys, originals: Originals, keys: Keys, dtype: np.dtype
) -> ndarray:
    """Copy rows by their keys, from the splat or from what was left out of it."""
    rows = np.zeros(len(keys), dtype)
    # Keys ascend, so that each is found by bisection.
    places = np.searchsorted(final, keys)
    is_there = places < len(final)
    is_there[is_there] = final[places[is_there]] == keys[is_there]
    for block, copied in iterate_rows(layout, places[is_there]):
        fill_columns(rows, np.flatnonzero(is_there)[block], copied)
    missing = np.flatnonzero(~is_there)
    found = originals.places[np.searchsorted(originals.keys, keys[missing])]
    for number, scene in enumerate(originals.scenes):
        chosen = found[:, 0] == number
        if chosen.any():
            check_columns(scene, layout)
            fill_columns(rows, missing[chosen], scene.rows[found[chosen, 1]])
    return rows


def fill_columns(rows: ndarray, places: Int64[ndarray, "k"], values: ndarray) -> None:
    """Fill rows at places; a row without labels has 0."""
    for name in rows.dtype.names or ():
        if name in (values.dtype.names or ()):
            rows[name][places] = values[name]


def check_columns(scene: SceneFile, layout: SceneFile) -> None:
    """Refuse originals that have other columns, as those of a splat of a lower degree."""
    columns = [set(file.rows.dtype.names or ()) - {LABEL_COLUMN} for file in (scene, layout)]
    is_same_mode = has_mode_comment(scene.header) == has_mode_comment(layout.header)
    if columns[0] != columns[1] or not is_same_mode:
        raise InputError(
            "Edits of this splat cannot be taken off: one of them changed its properties, such as "
            "the degree of its harmonics; take the file that the first of them was given."
        )
