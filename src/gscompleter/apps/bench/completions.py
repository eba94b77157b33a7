"""A case completed by the command line, in its own process."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gscompleter.apps.bench.crowding import multiply_gaussians
from gscompleter.apps.bench.manifest import BenchCase
from gscompleter.apps.bench.processes import run_command
from gscompleter.apps.bench.samples import Sample
from gscompleter.apps.bench.yardstick import Yardstick
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation.methods import Models
from gscompleter.io.files import SUMMARY_FILE
from gscompleter.splats.ply import save_ply

PROCESS, REST = "process", "rest"
"""Seconds of the whole process, and those outside the stages: start, imports, files, scores."""


def measure_command(arguments: Sequence[str], out: Path, yardstick: Yardstick) -> Sample:
    """Measure one run of a command that writes to `out`, next to the yardstick."""
    ended, unit = yardstick.measure_beside(lambda: run_command(arguments))
    summary = json.loads((out / SUMMARY_FILE).read_text())
    stages = summary["seconds"]
    seconds = {**stages, REST: ended.seconds - stages["total"], PROCESS: ended.seconds}
    return Sample(seconds, unit, ended.peak_bytes, summary["gaussians"])


def write_input_splat(case: BenchCase, folder: Path, models: Models, device: str) -> Path | None:
    """Write the input splat of a case to `folder` once; None if the context is reconstructed."""
    if case.gaussians is None:
        return None
    alike = replace(case, name="", targets=(0,))
    path = folder / f"{abs(hash(alike)):x}.ply"
    if not path.exists():
        photographs = open_photographs(case.scene, near=case.near, far=case.far)
        views = [view.to(device) for view in photographs.views(case.context, case.resolution)]
        context = models.make_completer().begin(views).context
        save_ply(path, multiply_gaussians(context, case.gaussians, models.seed))
    return path
