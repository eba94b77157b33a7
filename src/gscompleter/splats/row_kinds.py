"""The kinds of the rows of a splat, as the record of its edits tells them.

Labels tell fewer kinds apart: what photographs show and pieces of what was cut have one label, and
so have what was added for a target and what was only recoloured for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from gscompleter.splats.edits import Edit, Edits
from gscompleter.splats.undo import check_counts, compute_keys, count_originals, split_key
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.result_names import EDITS_FILE

GIVEN = "given"
"""Kind of rows that no edit appended."""


def count_row_kinds(path: Path, edits: Edits, total: int) -> dict[str, int] | None:
    """Count the `total` rows of a splat by their kind; None if its record does not tell.

    Raise InputError for a record that contradicts itself.
    """
    if not tells_rows(edits):
        return None
    counts: Counter[str] = Counter()
    for kind, rows in iterate_kinds(path, edits, total):
        counts[kind] += len(rows)
    return {kind: count for kind, count in counts.items() if count}


def find_rows_of_kinds(
    path: Path, edits: Edits, total: int, kinds: Collection[str]
) -> Bool[ndarray, "n"]:
    """Find the rows of some kinds; the record has to tell them.

    Raise InputError for a record that contradicts itself.
    """
    assert tells_rows(edits)
    found = np.zeros(total, bool)
    for own, rows in iterate_kinds(path, edits, total):
        found[rows] = own in kinds
    return found


def tells_kinds(edits: Edits) -> bool:
    """Return True if a record tells the kinds of all rows that its edits appended."""
    return bool(edits) and all(edit.appended for edit in edits.edits if edit.added)


def tells_rows(edits: Edits) -> bool:
    """Return True if a record tells the kind of each row of its splat, by its place.

    Not after another program changed the splat, whether since the last edit or before it.
    """
    return edits.is_unchanged and tells_kinds(edits) and not has_lost_rows(edits)


def has_lost_rows(edits: Edits) -> bool:
    """Return True if the rows of an edit have no known places in what the next edit was given.

    Another program changed the splat in between, or a format sorted its rows.
    """
    for edit, following in pairwise(edits.edits):
        # A reconstruction whose colours changed in place cannot be undone, and keeps its rows.
        is_recolored = edit.given is None and following.rows == count_rows_after(edits, edit)
        if not edit.can_be_undone and not is_recolored:
            return True
    return False


def count_rows_after(edits: Edits, edit: Edit) -> int:
    """Count the rows that an edit wrote, as its record tells."""
    return edit.rows + edit.added - count_originals(edits, edit)


def has_recolored(edits: Edits) -> bool:
    """Return True if any edit gave new colours to Gaussians that it was given."""
    return any(rows.kind == "recolored" for edit in edits.edits for rows in edit.appended)


def iterate_kinds(
    path: Path, edits: Edits, total: int
) -> Iterator[tuple[str, Int64[ndarray, "_k"]]]:
    """Yield kinds with the numbers of their rows in a splat, which has `total` rows."""
    check_counts(path, edits, total)
    states, _ = compute_keys(edits)
    numbers, places = split_key(states[-1])
    yield GIVEN, np.flatnonzero(numbers == 0)
    for number, edit in enumerate(edits.edits, start=1):
        check_appended(path, edit)
        # Rows of a kind stand together, so that the place decides.
        own = np.flatnonzero(numbers == number)
        ends = np.cumsum([part.count for part in edit.appended])
        found = np.searchsorted(ends, places[own], side="right")
        for index, part in enumerate(edit.appended):
            yield part.kind, own[found == index]


def check_appended(path: Path, edit: Edit) -> None:
    """Refuse kinds whose numbers do not add up to what an edit appended."""
    if min((part.count for part in edit.appended), default=0) < 0 or (
        sum(part.count for part in edit.appended) != edit.added
    ):
        raise InputError(
            f"The kinds of rows in {EDITS_FILE} beside {quote_value(path)} do not add up to the "
            f"{edit.added:,} that {edit.command} appended; fetch all files of its folder again."
        )
