"""Results that are kept: the completed scene in a small format, and no copy of the input."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gscompleter.apps.report.schema import find_completed
from gscompleter.splats.conversion import convert_splat
from gscompleter.splats.edits import rename_edited
from gscompleter.splats.layout import is_same_scene
from gscompleter.system.files.output_folder import read_listing
from gscompleter.system.files.result_names import COMPLETED_FILE, CONTEXT_FILE, SUMMARY_FILE

LARGE_BYTES = 100 * 10**6
"""Size of results, in bytes, from which on the terminal says how to keep them smaller."""


def save_compactly(
    folder: Path, suffix: str, summary: Mapping[str, Any], given: Path | None
) -> dict[str, Any]:
    """Replace what is large in an output folder, and return the summary with the changes.

    The completed scene becomes a file with the ending `suffix`, with its labels. `given` is the
    file of the input splat if it outlasts the run: if it holds the Gaussians of `context.ply`, that
    copy is removed and the summary names the file instead.
    """
    small = folder / f"completed{suffix}"
    if small.name != COMPLETED_FILE:
        # The input was read as it is, whatever further properties it has.
        losses = convert_splat(folder / COMPLETED_FILE, small, ignore_properties=True).notes
        if losses:
            notes = [*summary["scene"]["notes"], " ".join(losses)]
            summary = {**summary, "scene": {**summary["scene"], "notes": notes}}
        (folder / COMPLETED_FILE).unlink()
        rename_edited(folder, small)
    context = None
    if given is not None and is_same_scene(given, folder / CONTEXT_FILE):
        (folder / CONTEXT_FILE).unlink()
        context = str(given.resolve())
    changed = {**summary, "scene": {**summary["scene"], "context": context}}
    (folder / SUMMARY_FILE).write_bytes(json.dumps(changed, indent=2).encode() + b"\n")
    return changed


def describe_size(out: Path, can_be_smaller: bool) -> str:
    """Write the sentence on the size of the results, and on what to do if they are large.

    `can_be_smaller` is False if the user chose the format.
    """
    sizes = [(out / name).stat().st_size for name in read_listing(out)]
    total = sum(sizes)
    sentence = f"The results take {max(round(total / 1e6), 1):,} MB."
    if total < LARGE_BYTES or not can_be_smaller:
        return sentence
    size = find_completed(out).stat().st_size / 1e6
    return (
        f"{sentence} With --save-as .spz the completed scene takes about a seventh of {size:,.0f} "
        "MB, rounded as that format is."
    )
