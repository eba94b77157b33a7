"""A scene that an earlier command reconstructed from photographs of the same folder.

Ψ fits a scene to its photographs. Seen from elsewhere such a scene is full of shards, and where it
is covered, photographs of a second command would only be added around them. So Ψ makes it anew,
from the photographs of both commands (decision 145).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gscompleter.apps.requests.completion import WorkRequest
from gscompleter.splats.edits import Edit, read_edits
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.row_kinds import tells_kinds
from gscompleter.stages.add_observed import limit_part_photos

ADDING_COMMANDS = ("complete", "update")
"""Commands that only add. What others took out, photographs still show: Ψ would bring it back."""
OWN_PSI = "plane-sweep"
"""Ψ that fits a scene to many photographs together; networks were trained with few."""


def find_own_photographs(work: WorkRequest, files: Mapping[int | None, str]) -> tuple[int, ...]:
    """Find the frames from which earlier commands reconstructed the input splat.

    `files` are those of the photographs of the folder, by frame. Returns none of them if a person
    edited the splat since, if another program changed it, or if one of its photographs is not in
    the folder.
    """
    assert work.splat is not None
    if work.splat.forget_edits or work.models.reconstructor != OWN_PSI:
        return ()
    edits = read_edits(work.splat.path)
    if not (edits.is_unchanged and tells_kinds(edits) and is_ply(work.splat.path)):
        return ()
    if edits.edits[0].given is not None or not all(map(has_only_added, edits.edits)):
        return ()
    number_by_name = {name: frame for frame, name in files.items() if frame is not None}
    names = {name for edit in edits.edits for name in edit.settings.get("photographs", [None])}
    if not names <= number_by_name.keys():
        return ()
    return tuple(sorted(number_by_name[name] for name in names))


def has_only_added(edit: Edit) -> bool:
    """Return True if a command of ours took nothing out, and its photographs are known."""
    return (
        edit.command in ADDING_COMMANDS
        and edit.taken_out is None
        and edit.can_be_undone
        and edit.settings.get("reconstructor") == OWN_PSI
    )


def is_ply(path: Path) -> bool:
    """Return True for a .ply, whose rows the record tells apart."""
    return detect_splat_format(path) == "ply"


def join_photographs(
    own: Sequence[int], chosen: Sequence[int], scoring: set[int | None], pixels: int
) -> tuple[int, ...]:
    """Join the photographs of a scene with those that were chosen for this command.

    `scoring` are those that score the result, which Ψ must not see; an image has `pixels`. Returns
    none if there is nothing new, or too much for one reconstruction.
    """
    joined = sorted({*own, *chosen} - scoring)
    if set(joined) <= set(own) or len(joined) > limit_part_photos(pixels):
        return ()
    return tuple(joined)
