"""Cases that are kept apart: no setting is decided on them, and every use of them is written down.

A file of cases or of scenes says by its key `apart` what it keeps apart. `evaluate` leaves that out
unless it is asked for, so that nobody chooses by it unawares; and a use appends a row to the ledger
`apart_uses.md` beside the file, so that its readers can count how often it was looked at.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from gscompleter.evaluation.measured_code import find_commit
from gscompleter.system.errors import InputError, OutputError, quote_value

LEDGER = "apart_uses.md"
"""Table of uses: that in the folder of the file, or else the first one in a folder above it."""
APART_HEAD = """# Uses of what is kept apart

A row for each run that computed scores of cases which their file keeps apart. `gscompleter evaluate
--apart` and the scripts in `benchmarks` append to it.

| date | commit | file | cases | used by |
|---|---|---|---:|---|
"""


@runtime_checkable
class Apartable(Protocol):
    """A case, a task or a scene."""

    @property
    def apart_by(self) -> Path | None:
        """File that keeps it apart, or None."""


Item = TypeVar("Item", bound=Apartable)


def leave_out_apart(
    items: Iterable[Item], uses_apart: bool, left_out: list[Apartable]
) -> Iterator[Item]:
    """Iterate over the items that may be used, and append the others to `left_out`."""
    for item in items:
        if item.apart_by is None or uses_apart:
            yield item
        else:
            left_out.append(item)


def describe_left_out(left_out: Sequence[Apartable], kept: int, kind: str = "cases") -> list[str]:
    """Describe what was left out, in a line or none; raise InputError if nothing else is there."""
    if not left_out:
        return []
    file = quote_value(left_out[0].apart_by)
    if not kept:
        raise InputError(
            f"All of the {len(left_out)} {kind} are kept apart by {file}, for reports of what was "
            f"decided without them; ask for them, and the use is noted in {LEDGER}.",
            "apart",
        )
    if len(left_out) == 1:
        return [f"1 {kind.removesuffix('s')} is left out, because {file} keeps it apart."]
    return [f"{len(left_out)} {kind} are left out, because {file} keeps them apart."]


def find_ledger(file: Path) -> Path:
    """Find the table of uses of a file: beside it, or in the nearest folder above that has one."""
    folders = Path(os.path.realpath(file)).parents
    known = (folder / LEDGER for folder in folders)
    return next((ledger for ledger in known if ledger.is_file()), folders[0] / LEDGER)


def record_uses(items: Sequence[Apartable], used_by: str) -> None:
    """Append a row for each file that keeps one of `items` apart, before they are used.

    Raise OutputError where the ledger cannot be written: an uncounted use is none.
    """
    files = [item.apart_by for item in items if item.apart_by is not None]
    for file in dict.fromkeys(files):
        ledger = find_ledger(file)
        cells = (
            datetime.now().astimezone().date().isoformat(),
            find_commit() or "not a checkout",
            file.name,
            str(files.count(file)),
            used_by,
        )
        row = "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"
        try:
            # Opened for appending, a row is one write, which other runs cannot tear.
            with open(ledger, "a", encoding="utf-8") as out:
                out.write(row if out.tell() else APART_HEAD + row)
        except OSError as error:
            raise OutputError(
                f"The use of {quote_value(file)} cannot be noted in {quote_value(ledger)} "
                f"({error.strerror}); copy the file to a folder that can be written."
            ) from None
