"""The command `batch`: many completions on several processes and machines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from gscompleter.apps.commands.engines import decide_engine, parse_pairs
from gscompleter.apps.commands.shared_options import EngineOptions, list_inputs
from gscompleter.apps.requests.batch import BatchRequest
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.jobs.engine_names import EngineName
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class BatchOptions(EngineOptions):
    """Complete many scenes, on several processes or machines.

    Run the same command again to continue. OUT contains a folder per scene in jobs/, table.csv
    (with the reason where a scene could not be completed) and index.html.

    Example: gscompleter batch scenes.csv --workers 4 --out results
    """

    manifest: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MANIFEST")]
    """A .csv or .jsonl file with a row per scene, whose columns are `folder` (SCENE, relative to
    the file), `name` and options of `complete`; or a folder of scenes."""
    out: Path
    """Write results here. A folder; that of an earlier run is continued."""
    engine: EngineName = "local"
    """Engine that runs jobs or cases: processes of this machine, Ray, or SLURM."""
    retries: Annotated[int, Interval(ge=0, le=100)] = 2
    """Further attempts for a job that was killed or that failed unexpectedly."""
    rerun: Literal["nothing", "failures"] = "nothing"
    """Repeat this part of an earlier run in OUT. Nothing, or the jobs that failed."""
    each: tuple[str, ...] = ()
    """Options of `complete` for every row that does not set them, as in --each resolution=256."""

    def check_overlap(self) -> None:
        """Refuse an output that is, holds or lies in an input."""
        # Results may lie in a folder of scenes; `prepare_batch` compares the scenes themselves when
        # it has read the manifest.
        refuse_overlap(self.out, [path for path in list_inputs(self) if not path.is_dir()])


def decide_batch(options: BatchOptions) -> BatchRequest:
    """Decide which scenes are completed, and where."""
    return BatchRequest(
        manifest=options.manifest,
        out=options.out,
        common=parse_pairs(options.each, "each", "resolution=256"),
        engine=decide_engine(options),
        retries=options.retries,
        repeats_failures=options.rerun == "failures",
        answer=options.answer,
    )


def run_batch(options: BatchOptions) -> int:
    """Complete the scenes of a manifest, write the table and the page, and return the exit code."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.batch.running import complete_batch
        from gscompleter.apps.commands.batch_rows import decide_row
    return complete_batch(decide_batch(options), decide_row)
