"""The command `strip`: undo a completion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.shared_options import WritingOptions, list_inputs
from gscompleter.system.files.overlap import refuse_input_file
from gscompleter.system.files.writing import REMOVED_FILE
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class StripOptions(WritingOptions):
    """Undo a completion: remove what was generated and put the originals back.

    Example: gscompleter strip result/completed.ply --out given.ply
    """

    completed: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="COMPLETED")]
    """Completed scene. Gaussians of a removed.ply beside it are put back."""
    out: Path
    """File for the original scene."""

    def check_overlap(self) -> None:
        """Refuse to write over an input."""
        # The originals beside the completed scene are read, too.
        originals = self.completed.with_name(REMOVED_FILE)
        refuse_input_file(self.out, [*list_inputs(self), originals])


def run_strip(options: StripOptions) -> None:
    """Write the original scene and print the number of Gaussians."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.splats.formats import reserve_splat
        from gscompleter.splats.layout import strip

    with reserve_splat(options.out, options.overwrite):
        num_given, num_generated = strip(options.completed, options.out)
    content = {"out": str(options.out), "gaussians": num_given, "generated_removed": num_generated}
    line = f"{num_given:,} Gaussians, {num_generated:,} generated ones removed: {options.out}"
    print_answer(options, content, [line])
