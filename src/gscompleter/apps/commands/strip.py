"""The command `strip`: undo a completion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval

from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.shared_options import WritingOptions, list_inputs
from gscompleter.system.errors import InputError
from gscompleter.system.files.overlap import refuse_input_file
from gscompleter.system.files.result_names import EDITS_FILE, EDITS_FOLDER, REMOVED_FILE
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class StripOptions(WritingOptions):
    """Undo edits: remove what was generated, and put back what was removed or recoloured.

    Without --last or --edit, all edits are undone, and the scene is as it was given.

    Example: gscompleter strip result/completed.ply --out given.ply
    """

    completed: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="COMPLETED")]
    """Completed scene, with edits.json, removed.ply and edits/ of its results beside it."""
    last: bool = False
    """Undo the last edit alone."""
    edit: Annotated[int, Interval(ge=1)] | None = None
    """Undo this edit alone, by its number in edits.json, from 1."""
    out: Path
    """Write results here. A file, for the scene without these edits."""

    def check_overlap(self) -> None:
        """Refuse to write over an input."""
        # What lies beside the completed scene is read, too. If that is a folder, all in it counts.
        folder = self.completed.parent
        beside = [folder / name for name in (REMOVED_FILE, EDITS_FILE, EDITS_FOLDER)]
        refuse_input_file(self.out, [*list_inputs(self), *beside])


def run_strip(options: StripOptions) -> None:
    """Write the scene without the chosen edits, and print the number of its Gaussians."""
    if options.last and options.edit is not None:
        raise InputError("--last and --edit both name an edit; leave one of them out.", "edit")
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.splats.edits import read_edits
        from gscompleter.splats.foreign import resolve_splat
        from gscompleter.splats.formats import reserve_splat
        from gscompleter.splats.undo import strip_edits

    with reserve_splat(options.out, options.overwrite):
        numbers = None if options.edit is None else [options.edit]
        if options.last:
            count = len(read_edits(resolve_splat(options.completed)).edits)
            # Without any edit, `strip_edits` refuses the first one with the reason.
            numbers = [max(count, 1)]
        undone = strip_edits(options.completed, options.out, numbers)
    content = {
        "out": str(options.out),
        "gaussians": undone.kept,
        "generated_removed": undone.dropped,
        "is_same_file": undone.is_same_file,
        "missing": undone.missing,
    }
    lines = [f"{undone.kept:,} Gaussians, {undone.dropped:,} generated ones removed: {options.out}"]
    if undone.is_same_file:
        before = "all edits" if numbers is None else "this edit"
        lines.append(f"The file is the one before {before}, byte for byte.")
    if undone.missing:
        lines.append(
            f"{undone.missing:,} Gaussians that the scene had before its edits are not restored: "
            f"no {REMOVED_FILE} beside it holds them."
        )
    print_answer(options.answer, content, lines)
