"""The table of splat formats, merged from the rows that the format files bring along.

The import of a row puts it into the table.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gscompleter.splats.compressed_ply import COMPRESSED_PLY as COMPRESSED_PLY
from gscompleter.splats.glb import GLB as GLB
from gscompleter.splats.ksplat import KSPLAT as KSPLAT
from gscompleter.splats.ply import PLY as PLY
from gscompleter.splats.sog import SOG as SOG
from gscompleter.splats.sog import SOG_FOLDER as SOG_FOLDER
from gscompleter.splats.splat import SPLAT as SPLAT
from gscompleter.splats.splat_format import SplatFormat
from gscompleter.splats.spz import SPZ as SPZ
from gscompleter.splats.usd import USD as USD
from gscompleter.splats.usd import USDZ as USDZ
from gscompleter.system.errors import InputError, quote_value

# Every row that is imported above, the .ply before all others.
_IMPORTED = [value for value in [*globals().values()] if isinstance(value, SplatFormat)]
_ROWS = sorted(_IMPORTED, key=lambda row: row is not PLY)

SPLAT_FORMATS: dict[str, SplatFormat] = {row.name: row for row in _ROWS}
"""Formats by name. Sentences and pages list them in this order, which decides nothing else."""

FILE_ENDINGS = tuple(ending for row in _ROWS for ending in row.endings if ending.startswith("."))
"""Endings of files that are worth naming in an archive or a folder."""


def match_ending(path: Path) -> SplatFormat | None:
    """Match the name of a file with the endings of formats; the longest that fits is meant."""
    fitting = [
        (len(ending), row)
        for row in _ROWS
        for ending in row.endings
        if path.name.lower().endswith(ending)
    ]
    return max(fitting, key=lambda fit: fit[0])[1] if fitting else None


def name_endings(is_meant: Callable[[SplatFormat], object]) -> str:
    """Name the first ending of each format that is meant, as in ".ply, .spz or .sog"."""
    endings = [row.endings[0] for row in _ROWS if is_meant(row)]
    *others, last = [ending for ending in endings if ending in FILE_ENDINGS]
    return f"{', '.join(others)} or {last}"


def get_written_format(path: Path) -> SplatFormat:
    """Get the format that the ending of `path` names; raise InputError if none is written so."""
    row = match_ending(path)
    if row is None or row.write is None:
        raise InputError(
            f"{quote_value(path)} cannot be written in the format of its extension; end it in "
            f"{name_endings(lambda row: row.write)}."
        )
    return row
