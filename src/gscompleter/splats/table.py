"""The table of splat formats, merged from the rows that the format files bring along."""

from __future__ import annotations

from pathlib import Path

from gscompleter.splats.compressed_ply import COMPRESSED_PLY
from gscompleter.splats.glb import GLB
from gscompleter.splats.ksplat import KSPLAT
from gscompleter.splats.ply import PLY
from gscompleter.splats.sog import SOG, SOG_FOLDER
from gscompleter.splats.splat import SPLAT
from gscompleter.splats.splat_format import SplatFormat
from gscompleter.splats.spz import SPZ
from gscompleter.splats.usd import USD, USDZ
from gscompleter.system.errors import InputError, quote_value

_ROWS = (COMPRESSED_PLY, PLY, SPZ, USDZ, USD, SOG, SOG_FOLDER, GLB, SPLAT, KSPLAT)

SPLAT_FORMATS: dict[str, SplatFormat] = {row.name: row for row in _ROWS}
"""Formats by name. Sentences list them in this order, which decides nothing else."""

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


def get_written_format(path: Path) -> SplatFormat:
    """Get the format that the ending of `path` names; raise InputError if none is written so."""
    row = match_ending(path)
    if row is None or row.write is None:
        raise InputError(
            f"{quote_value(path)} cannot be written in the format of its extension; end it in "
            f"{', '.join(row.endings[0] for row in _ROWS if row.write)}."
        )
    return row
