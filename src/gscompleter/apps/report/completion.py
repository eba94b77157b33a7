"""The output folder of a completion: scenes, images, report.json and summary.json."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gscompleter import __version__
from gscompleter.apps.inputs.task import InputSplatFile, Target
from gscompleter.apps.report.pictures import (
    IMAGES_FOLDER,
    make_writing_draw,
    write_images,
    write_pictures,
)
from gscompleter.apps.report.record import MAX_PHOTOGRAPHS, make_record, thin_evenly
from gscompleter.apps.report.removal_pictures import draw_removal
from gscompleter.apps.report.scenes import write_scenes
from gscompleter.apps.report.schema import (
    RECORD_FILE,
)
from gscompleter.apps.report.score_rows import count_changes, make_score_rows, measure_gaps
from gscompleter.evaluation.gap_pictures import draw_gap
from gscompleter.evaluation.metrics.coverage import RenderPair, compute_coverage
from gscompleter.evaluation.verdict.held_out import HeldOut, make_drawing, render_before_after
from gscompleter.evaluation.verdict.kept import measure_kept
from gscompleter.render.protocols import Renderer
from gscompleter.splats.edits import EditDraft
from gscompleter.splats.provenance import RunRecord
from gscompleter.state import Completion
from gscompleter.system.files.image import write_pixels
from gscompleter.system.files.result_format import RESULT_MARK
from gscompleter.system.files.result_names import SUMMARY_FILE
from gscompleter.types import Camera


def write_report(
    folder: Path,
    completion: Completion,
    targets: Sequence[Target],
    renderer: Renderer,
    run_info: Mapping[str, Any],
    input_splat: InputSplatFile | None = None,
    photographs: Sequence[Camera] = (),
    render_around: Callable[[], Sequence[RenderPair]] = list,
    held_out: Sequence[HeldOut] = (),
    files: Mapping[int | None, str] = MappingProxyType({}),
    has_searched: bool = True,
    run: RunRecord | None = None,
    testing: Sequence[Camera] = (),
    edit: EditDraft | None = None,
) -> dict[str, Any]:
    """Write the scenes, `images/`, `report.json` and `summary.json`; return the summary.

    `photographs` are the cameras of all, in the frame of the result. `render_around` renders the
    views whose coverage is measured. `files` are those of the photographs by frame. `has_searched`
    is False if targets were neither named nor searched for. `run` is what the files say about who
    made them. `testing` are cameras that decided nothing, at which what is kept is measured.
    `edit` is the command for `edits.json`.
    """
    at_targets = [
        render_before_after(completion, result.target, renderer) for result in completion.targets
    ]
    gaps = measure_gaps(completion, renderer)
    (folder / IMAGES_FOLDER).mkdir()
    draw = make_drawing(completion, renderer)
    # Without targets, the photographs are what there is to look at.
    if not completion.targets:
        photos = [photo.view for photo in completion.photos]
        shown = [*photos, *(photograph.view for photograph in held_out)]
        draw = make_writing_draw(folder / IMAGES_FOLDER, shown, draw)
    scores = make_score_rows(
        completion, targets, at_targets, gaps, renderer, held_out, files, has_searched, draw
    )
    write_scenes(folder, completion, input_splat, run, edit or EditDraft("complete"))
    around = render_around()
    has_renders = run_info.get("scene", {}).get("renders_from") is not None
    write_pictures(folder / IMAGES_FOLDER, completion, targets, at_targets, has_renders)
    for number, found in enumerate(gaps, start=1):
        write_pixels(folder / IMAGES_FOLDER / f"target{number}_gaps.png", draw_gap(found.worst))
    removal = draw_removal(completion, renderer, files)
    if removal is not None:
        write_images(folder / IMAGES_FOLDER, "removal", removal.name_images())
    record = make_record(completion, thin_evenly(photographs, MAX_PHOTOGRAPHS))
    (folder / RECORD_FILE).write_bytes(
        json.dumps({**RESULT_MARK, **asdict(record)}).encode() + b"\n"
    )
    coverage = {"coverage": asdict(compute_coverage(around))} if around else {}
    left = {} if removal is None else {"removal": asdict(removal.row)}
    kept = measure_kept(completion, testing, renderer)
    left |= {} if kept is None else {"kept": asdict(kept)}
    placed = None if completion.geometry is None else completion.geometry.placement
    left |= {} if placed is None else {"placed_geometry": asdict(placed)}
    notes = {"context_notes": completion.context_notes} if completion.context_notes else {}
    counts = {**count_changes(completion), **notes, **left, "seconds": dict(completion.seconds)}
    summary = {
        "version": __version__,
        "outcome": scores.pop("outcome"),
        **run_info,
        **coverage,
        **scores,
        **counts,
    }
    (folder / SUMMARY_FILE).write_bytes(json.dumps(summary, indent=2).encode() + b"\n")
    return summary
