"""Complete every case of a cases.json and print what it gained.

    python benchmarks/cases.py path/to/cases.json [--config NAME_OR_YAML] [--pictures FOLDER]

Every row is one case: PSNR (dB) at the target, at the frames beside it and at the context views
before and after, the error of depth (AbsRel) against true depth where the data has it, and the
difference of depth from the context at the rim of the holes.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.table import Table

from gscompleter.completer import GSCompleter
from gscompleter.config import load_config
from gscompleter.evaluation.cases import CaseScores, read_cases, run_case
from gscompleter.evaluation.metrics import psnr
from gscompleter.generators import load_generator
from gscompleter.io.image import write_image
from gscompleter.report import strip
from gscompleter.types import Completion, View

Row = tuple[str, Callable[[CaseScores], float | None]]

COLUMNS: list[Row] = [
    ("hole %", lambda s: 100 * s.hole_fraction),
    ("target", lambda s: s.target_psnr.before),
    ("> after", lambda s: s.target_psnr.after),
    ("gain", lambda s: s.target_psnr.gain),
    ("in hole", lambda s: s.hole_psnr),
    ("SSIM", lambda s: s.target_ssim.before),
    ("> after", lambda s: s.target_ssim.after),
    ("beside", lambda s: s.neighbours_psnr and s.neighbours_psnr.before),
    ("> after", lambda s: s.neighbours_psnr and s.neighbours_psnr.after),
    ("context", lambda s: statistics.mean(c.before for c in s.context_psnr)),
    ("> after", lambda s: statistics.mean(c.after for c in s.context_psnr)),
    ("worst", lambda s: min(c.gain for c in s.context_psnr)),
    ("depth seen", lambda s: s.depth_observed),
    ("in hole", lambda s: s.depth_hole),
    ("rim", lambda s: s.depth_rim),
    ("s", lambda s: s.seconds),
]


def mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.mean(known) if known else None


def cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}"


def picture(completion: Completion, target: View) -> torch.Tensor:
    """Before, after, synthesized image and photograph, side by side."""
    (result,) = completion.targets
    reference = target.image * 0 if result.reference is None else result.reference.image
    return strip([result.before.image, result.after.image, reference, target.image])


def main(
    cases: Annotated[Path, tyro.conf.Positional],
    config: str = "default",
    generator: str = "warp-inpaint",
    pictures: Path | None = None,
    out: Path | None = None,
    only: str = "",
) -> None:
    """Complete every case and print the table.

    Args:
        cases: A cases.json with its scene folders beside it.
        config: Settings of the stages, by name or from a YAML file.
        generator: The model that synthesizes images.
        pictures: Folder for a strip per case: before, after, synthesized, photograph.
        out: JSON file for all scores.
        only: Run only the cases whose name contains this.
    """
    completer = GSCompleter(generator=load_generator(generator), config=load_config(config))
    table = Table("case", *(name for name, _ in COLUMNS), box=None)
    rows: list[CaseScores] = []
    scores = []
    for case in read_cases(cases):
        if only not in case.name:
            continue
        completion, target, row = run_case(case, completer)
        (result,) = completion.targets
        reference = result.reference
        row_reference = None if reference is None else psnr(reference.image, target.image)
        rows.append(row)
        scores.append({**asdict(row), "reference_psnr": row_reference})
        table.add_row(row.name, *(cell(value(row)) for _, value in COLUMNS))
        print(row.name, " ".join(cell(value(row)) for _, value in COLUMNS), flush=True)
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            name = row.name.replace(" ", "_").replace(">", "-")
            write_image(pictures / f"{name}.png", picture(completion, target))
    table.add_section()
    table.add_row("mean", *(cell(mean(value(row) for row in rows)) for _, value in COLUMNS))
    Console(width=200).print(table)
    if out is not None:
        out.write_text(json.dumps(scores, indent=2) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
