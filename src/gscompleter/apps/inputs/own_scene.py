"""A scene that an earlier command reconstructed from photographs of the same folder.

Ψ fits a scene to its photographs. Seen from elsewhere such a scene is full of shards, and where it
is covered, photographs of a second command would only be added around them. So Ψ makes it anew,
from the photographs of both commands (decision 145).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gscompleter.apps.requests.completion import WorkRequest
from gscompleter.splats.edits import Edit, Edits
from gscompleter.splats.formats import detect_splat_format
from gscompleter.splats.row_kinds import tells_kinds
from gscompleter.stages.add_observed import limit_part_photos

LIFTING_COMMANDS = ("complete", "update")
"""Commands that use photographs for the scene itself; in others they may only check it."""
TRACED_COMMANDS = (*LIFTING_COMMANDS, "remove", "repair")
"""Commands whose record tells what they took out. Photographs still show that, and it is hidden in
them; what the others took out Ψ would bring back."""
OWN_PSI = "plane-sweep"
"""Ψ that fits a scene to many photographs together; networks were trained with few."""


def find_own_photographs(
    work: WorkRequest, edits: Edits, files: Mapping[int | None, str]
) -> tuple[int, ...]:
    """Find the frames from which earlier commands reconstructed the input splat, to remake it.

    `edits` are those of the splat, and `files` those of the photographs of the folder, by frame.
    Returns none of them if another command or program changed the splat since, or if one of its
    photographs is not in the folder.
    """
    assert work.splat is not None
    if work.splat.forget_edits or work.models.reconstructor != OWN_PSI:
        return ()
    if not (edits.is_unchanged and tells_kinds(edits) and is_ply(work.splat.path)):
        return ()
    if edits.edits[0].given is not None or not all(map(is_traced, edits.edits)):
        return ()
    number_by_name = {name: frame for frame, name in files.items() if frame is not None}
    sources = filter(has_lifted, edits.edits)
    names = {name for edit in sources for name in edit.settings.get("photographs", [None])}
    if not names <= number_by_name.keys():
        return ()
    return tuple(sorted(number_by_name[name] for name in names))


def find_source_frames(edits: Edits, files: Mapping[int | None, str]) -> tuple[int, ...]:
    """Find those frames of a folder from which our commands made a splat, whatever came after.

    `edits` are those of the splat, and `files` those of the photographs, by frame. Returns none for
    a splat that came from elsewhere: its record does not tell what it was trained on.
    """
    if not edits or edits.edits[0].given is not None:
        return ()
    sources = filter(has_lifted, edits.edits)
    names = {name for edit in sources for name in edit.settings.get("photographs", ())}
    return tuple(frame for frame, name in files.items() if frame is not None and name in names)


def is_traced(edit: Edit) -> bool:
    """Return True if the record tells all that a command of ours did, which used our Ψ or none."""
    # A cleaning takes out what no photograph shows or needs, so that Ψ brings nothing back.
    if edit.command == "clean":
        return edit.can_be_undone
    return (
        edit.command in TRACED_COMMANDS
        and edit.can_be_undone
        and edit.settings.get("reconstructor") == OWN_PSI
    )


def has_lifted(edit: Edit) -> bool:
    """Return True if photographs of a command became Gaussians."""
    shows_behind = any(rows.kind == "photographs" for rows in edit.appended)
    return edit.command in LIFTING_COMMANDS or shows_behind


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
