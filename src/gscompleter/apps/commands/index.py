"""The command `index`: write the frames that a protocol selects in a data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.commands.shared_options import WritingOptions, list_inputs, replace_by_scenes
from gscompleter.apps.requests.evaluation import IndexRequest
from gscompleter.system.files.overlap import refuse_input_file
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class IndexOptions(WritingOptions):
    """Write the frames that a protocol selects in a data set.

    Example: gscompleter index scenes --protocol n-10 --out index.json
    """

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Scenes as in `evaluate`."""
    protocol: str
    """Choice of context and target frames. One, as in `evaluate`."""
    out: Path
    """Write results here. A JSON file, for the evaluation index."""

    def check_overlap(self) -> None:
        """Refuse to write over an input."""
        refuse_input_file(self.out, replace_by_scenes(list_inputs(self), [self.path]))


def run_index(options: IndexOptions) -> None:
    """Write the evaluation index of a protocol for a data set."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.evaluating.index import write_index
    write_index(
        IndexRequest(
            path=options.path,
            protocol=options.protocol,
            out=options.out,
            overwrite=options.overwrite,
            answer=options.answer,
        )
    )
