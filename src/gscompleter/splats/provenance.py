"""Who made what of a splat: the record of runs that files carry beside the labels `generated`.

The labels say which Gaussians a run added; this record says which program and models they come
from, and what was given. A .ply has a comment per run; other formats hold the whole record where
they keep remarks, or beside the file (docs/provenance.md). It has no time and no paths, so that the
same input gives the same bytes, and tells nothing about the machine.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.ply import MAX_HEADER_LINE
from gscompleter.system.files.typed_json import validate_typed

SCHEMA = "gscompleter-provenance/1"
"""Name and version of the schema; another number means other fields."""
KEY = "provenance"
"""Name of the record in JSON and in OpenUSD."""
MAX_NOTE_LENGTH = 100
"""Longest name or licence, in characters."""
MAX_NOTE_BYTES = 300
"""Most bytes of a name or licence in JSON, where a character beyond ASCII takes 6 or 12: the ten of
a run fit into a line of `MAX_HEADER_LINE`."""
DROP = "drop the record (`gscompleter convert --plain`)"
PROVENANCE_ADVICE = f"export the file again, or {DROP}"
_LINE = re.compile(rb"^comment (gscompleter-provenance/\d+) (.*?)\r?\n", re.MULTILINE)


@dataclass(frozen=True)
class ModelRecord:
    """A model that took part."""

    name: str
    """Name on the command line, or the class of an object of the user."""
    weights: str | None = None
    """Published weights, or the name of a file or repository that was given."""
    licence: str | None = None
    """Licence as its authors state it; None if it is not known here."""


@dataclass(frozen=True)
class RunRecord:
    """A run of a program that added to a splat, or recoloured it."""

    tool: str
    version: str
    labels: tuple[int, int] | None
    """First and last value of `generated` that the run gave to what it invented; None for none.
    What photographs show has the value 255, whichever run added it."""
    reconstructor: ModelRecord | None = None
    """Ψ, which gave the added Gaussians their places."""
    depth: ModelRecord | None = None
    """Monocular depth that helped Ψ; None without one."""
    generator: ModelRecord | None = None
    """Φ, which invented the images; None if nothing was invented."""
    painter: str | None = None
    """Who painted the images, in place of a generator."""
    seed: int | None = None
    given: str | None = None
    """SHA-256 of the file that was given, in hexadecimal digits; None without a splat."""


@dataclass(frozen=True)
class Provenance:
    """All runs of a file, in their order."""

    runs: tuple[RunRecord, ...]

    def plus(self, run: RunRecord) -> Provenance:
        """Append one more run."""
        return Provenance((*self.runs, run))

    def to_json(self) -> dict[str, Any]:
        """Convert to values of JSON."""
        return {"schema": SCHEMA, "runs": [asdict(run) for run in self.runs]}


NOTHING_KNOWN = Provenance(())
"""The record of a file that has none."""


def shorten(text: str) -> str:
    """Shorten a name that a user chose to `MAX_NOTE_LENGTH` characters and `MAX_NOTE_BYTES`."""
    if _is_short(text):
        return text
    kept = text[: MAX_NOTE_LENGTH - 1]
    while not _is_short(f"{kept}…"):
        kept = kept[:-1]
    return f"{kept}…"


def _is_short(text: str) -> bool:
    num_bytes = len(json.dumps(text)) - len('""')
    return len(text) <= MAX_NOTE_LENGTH and num_bytes <= MAX_NOTE_BYTES


def parse_provenance(table: object, name: str) -> Provenance:
    """Parse the record of the file `name` from values of JSON; an absent one is None.

    Raise InputError if the record is of another version or damaged, or has a run that no line of a
    .ply holds.
    """
    if table is None:
        return NOTHING_KNOWN
    schema = table.get("schema") if isinstance(table, Mapping) else None
    if schema != SCHEMA:
        later = re.fullmatch(r"gscompleter-provenance/([1-9]\d{0,5})", str(schema))
        if later is not None:
            raise InputError(
                f"{name} was written by a later version of gscompleter ({quote_value(schema)}, and "
                f"{SCHEMA} is read); update gscompleter, or {DROP}."
            )
        raise InputError(
            f"{name} says who made it by the schema {quote_value(str(schema))}, and {SCHEMA} is "
            f"read; {PROVENANCE_ADVICE}."
        )
    made_by = validate_typed(Provenance, table, f"The record of {name}", PROVENANCE_ADVICE)
    if any(len(make_comment_lines([run], b"\r\n")) > MAX_HEADER_LINE for run in made_by.runs):
        raise InputError(
            f"The record of {name} has names that are too long for a .ply; {PROVENANCE_ADVICE}."
        )
    return made_by


def make_comment_lines(runs: Sequence[RunRecord], ending: bytes = b"\n") -> bytes:
    """Make the lines for the header of a .ply, one for each run; `ending` is that of its lines."""
    texts = [json.dumps(asdict(run), separators=(",", ":")) for run in runs]
    return b"".join(f"comment {SCHEMA} {text}".encode("ascii") + ending for text in texts)


def parse_comments(header: bytes, name: str) -> object:
    """Parse the comments of the .ply file `name` to values of JSON; None if none is a record.

    Raise InputError if one is no JSON. `parse_provenance` checks the values.
    """
    runs = []
    # A later run adds its line behind the others. So the last one tells the version of the file.
    schema = SCHEMA
    for found, text in _LINE.findall(header):
        schema = found.decode()
        try:
            runs.append(json.loads(text))
        except (ValueError, RecursionError):
            raise InputError(f"The record of {name} is no JSON; {PROVENANCE_ADVICE}.") from None
    return {"schema": schema, "runs": runs} if runs else None


def add_comments(header: bytes, made_by: Provenance) -> bytes:
    r"""Add the comments at the end of a header that was made here, whose lines end in \n."""
    start, end, rest = header.rpartition(b"end_header")
    return start + make_comment_lines(made_by.runs) + end + rest
