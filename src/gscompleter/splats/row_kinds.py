"""The kinds of the rows of a splat, as the record of its edits tells them.

Labels tell fewer kinds apart: what photographs show and pieces of what was cut have one label, and
so have what was added for a target and what was only recoloured for it.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from gscompleter.splats.edits import Edit, Edits
from gscompleter.splats.undo import Keys, check_counts, compute_keys, split_key
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.writing import EDITS_FILE

GIVEN = "given"
"""Kind of rows that no edit appended."""


def count_row_kinds(path: Path, edits: Edits, total: int) -> dict[str, int] | None:
    """Count the `total` rows of a splat by their kind; None if its record does not tell.

    Raise InputError for a record that contradicts itself.
    """
    appending = [edit for edit in edits.edits if edit.added]
    if not edits or not edits.is_unchanged or not all(edit.appended for edit in appending):
        return None
    check_counts(path, edits, total)
    states, _ = compute_keys(edits)
    numbers, places = split_key(states[-1])
    counts = Counter({GIVEN: int((numbers == 0).sum())})
    for number, edit in enumerate(edits.edits, start=1):
        counts += count_appended(path, edit, places[numbers == number])
    return {kind: count for kind, count in counts.items() if count}


def count_appended(path: Path, edit: Edit, places: Keys) -> Counter[str]:
    """Count those rows by their kind that are left of what an edit appended, by their places."""
    if min((part.count for part in edit.appended), default=0) < 0 or (
        sum(part.count for part in edit.appended) != edit.added
    ):
        raise InputError(
            f"The kinds of rows in {EDITS_FILE} beside {quote_value(path)} do not add up to the "
            f"{edit.added:,} that {edit.command} appended; fetch all files of its folder again."
        )
    # Rows of a kind stand together, so that the place decides.
    ends = np.cumsum([part.count for part in edit.appended])
    found = np.searchsorted(ends, places, side="right")
    counts: Counter[str] = Counter()
    for index, part in enumerate(edit.appended):
        counts[part.kind] += int((found == index).sum())
    return counts
