"""Lines and tables that a completion prints on the terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rich.table import Column, Table

from gscompleter.apps.command_line.answers import print_json
from gscompleter.apps.completing.keeping import describe_size
from gscompleter.apps.inputs.holes_file import HOLES_FILE, read_holes
from gscompleter.apps.inputs.task import Opened, Target
from gscompleter.apps.report.film import VIDEO_FILE
from gscompleter.apps.report.page import REPORT_FILE
from gscompleter.apps.report.pictures import IMAGES_FOLDER
from gscompleter.apps.report.plain_words import (
    describe_replaced,
    group_target_warnings,
    list_warnings,
)
from gscompleter.apps.report.schema import CompletionSummary, find_completed, read_summary
from gscompleter.apps.requests.answer import AnswerRequest
from gscompleter.apps.requests.completion import ExportRequest, ResultsRequest
from gscompleter.evaluation.verdict.numbers import format_number, format_percent
from gscompleter.system.console import make_console
from gscompleter.system.errors import quote_value
from gscompleter.system.files.result_names import SUMMARY_FILE, TARGETS_FILE


def answer_completion(
    results: ResultsRequest, further: Mapping[str, Any] = MappingProxyType({})
) -> None:
    """Print a completion for people, or its summary and `further` entries as JSON.

    Both are read from the folder `results.out`, where the completion was written.
    """
    if results.answer.json:
        summary = json.loads((results.out / SUMMARY_FILE).read_bytes())
        print_json({"out": str(results.out), **summary, **further})
    elif not results.answer.quiet:
        print_completion(results)


def print_completion(results: ResultsRequest) -> None:
    """Print the verdict, the scores per camera, the warnings, and where the results are."""
    console = make_console()
    summary = read_summary(results.out)
    console.print(summary.outcome.headline, soft_wrap=True)
    console.print(make_score_table(summary))

    # First what holds for several targets or for all, then what holds for one. If nothing was
    # gained, the headline gives the reason for all. The facts are in the report alone.
    sentences = list(list_warnings(summary))
    if summary.outcome.status != "nothing-gained":
        for warnings, numbers in group_target_warnings(summary.targets).items():
            if len(numbers) == 1:
                sentences.append(f"Target {numbers[0]}: {' '.join(warnings)}")
    sentences += describe_completion(summary, results)
    for sentence in sentences:
        console.print(sentence, soft_wrap=True)


def make_score_table(summary: CompletionSummary) -> Table:
    """Make the table of PSNR (dB) before and after at each camera.

    Targets are numbered from 1, as in sentences and in the names of their images.
    """
    has_fitted = any(target.fitted is not None for target in summary.targets)
    columns = ["camera", "hole", "PSNR\nbefore", "PSNR\nafter"]
    # PSNR after a pose and a gain of the target's camera were fitted to its photograph.
    columns += ["camera\nfitted", "added"] if has_fitted else ["added"]
    kind = "context" if summary.scene.renders_from is None else "render"
    rows: list[list[str]] = []
    # Photographs of the context have neither a hole nor Gaussians of their own.
    for given in summary.context:
        before = format_number(given.psnr_before)
        after = format_number(given.psnr_after)
        rows.append([f"{kind} {given.photograph}", "", before, after])
    # Without targets, photographs that were not used tell how good the result is. With targets the
    # headline has their mean.
    for held_out in () if summary.targets else summary.held_out:
        before = format_number(held_out.psnr_before)
        after = format_number(held_out.psnr_after)
        rows.append([f"{held_out.use}: {held_out.photograph}", "", before, after])
    for number, target in enumerate(summary.targets, start=1):
        before = format_number(target.psnr_before)
        after = format_number(target.psnr_after)
        hole = format_percent(target.hole_fraction)
        cells = [f"target {number}: {target.name}", hole, before, after]
        if has_fitted:
            cells.append(format_number(None if target.fitted is None else target.fitted.psnr))
        rows.append([*cells, f"{target.added:,}"])

    # In a narrow terminal cameras are broken between words, and numbers are not.
    table = Table(Column(columns[0], overflow="fold"), box=None)
    for header in columns[1:]:
        table.add_column(header, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def describe_completion(summary: CompletionSummary, results: ResultsRequest) -> Iterator[str]:
    """Write the sentences below the table."""
    counts = summary.gaussians
    seconds = summary.seconds["total"]
    yield (
        f"Added {counts['added']:,} Gaussians to {counts['context']:,} in {seconds:.1f} s: "
        f"{find_completed(results.out)}"
    )
    if counts.get("replaced"):
        yield describe_replaced(counts["replaced"])
    if summary.placed_geometry is not None:
        yield summary.placed_geometry.describe()
    yield from describe_geometry_use(summary)
    yield describe_size(results.out, results.suffix is None)
    yield f"Report: {results.out / REPORT_FILE}"
    if results.has_video and summary.targets:
        yield f"Video: {results.out / VIDEO_FILE}"


def describe_geometry_use(summary: CompletionSummary) -> Iterator[str]:
    """Write the sentence on the depth that `--geometry` gives, if it was asked at a target."""
    shares = [row.geometry.share for row in summary.targets if row.geometry is not None]
    if not shares:
        return
    name = quote_value(Path(str(summary.settings["geometry"])).name)
    holes = "the hole" if len(shares) == 1 else "the holes"
    parts = ", ".join(format_percent(share) for share in shares)
    yield (
        f"{name} gives the depth of {parts} of {holes}: {summary.gaussians['on_geometry']:,} "
        "Gaussians stand where it says, in generated colours."
    )


def answer_plan(
    results: ResultsRequest, opened: Opened, targets: Sequence[Target], holes: Sequence[float]
) -> None:
    """Print the targets and `holes`, the share of holes in each image, for people or as JSON."""
    if results.answer.json:
        print_json(describe_plan(results.out, opened, targets, holes))
    elif not results.answer.quiet:
        print_plan(results.out, opened, targets, holes)


def describe_plan(
    out: Path, opened: Opened, targets: Sequence[Target], holes: Sequence[float]
) -> dict[str, Any]:
    """Describe the targets and their holes as a JSON object; without targets no file has any."""
    rows = [
        {"name": opened.name_target(target), "frame": target.frame, "hole_fraction": hole}
        for target, hole in zip(targets, holes, strict=True)
    ]
    return {
        "out": str(out),
        "cameras": str(out / TARGETS_FILE) if rows else None,
        "targets": rows,
    }


def print_plan(
    out: Path, opened: Opened, targets: Sequence[Target], holes: Sequence[float]
) -> None:
    """Print the targets and their holes."""
    console = make_console()
    if not targets:
        console.print("No camera has much to gain; there is nothing to complete.")
        return
    table = Table("camera", "hole", box=None)
    for number, (target, hole) in enumerate(zip(targets, holes, strict=True), 1):
        table.add_row(f"{number}: {opened.name_target(target)}", format_percent(hole))
    console.print(table)
    console.print(f"Edit the cameras in {quote_value(out / TARGETS_FILE)}.", soft_wrap=True)
    # A camera that was searched for stands beside a photograph, which shows where that is: a new
    # photograph from there is the best help, and `update` adds what it shows.
    is_found = any(target.derived_from is not None for target in targets)
    beside = f", and the {'photograph' if opened.renders_from is None else 'render'} beside it"
    shown = f"What each camera sees now{beside if is_found else ''}"
    console.print(f"{shown}: {quote_value(out / IMAGES_FOLDER)}", soft_wrap=True)


def answer_export(request: ExportRequest, answer: AnswerRequest, lines: Sequence[str]) -> None:
    """Print an export for people, or its `holes.json` as JSON.

    `lines` are sentences about targets that are left out.
    """
    if answer.json:
        content = json.loads((request.folder / HOLES_FILE).read_bytes())
        print_json({"out": str(request.folder), "notes": list(lines), "holes": content})
    elif not answer.quiet:
        print_export(request, lines)


def print_export(request: ExportRequest, lines: Sequence[str]) -> None:
    """Print what was exported, and how to go on."""
    console = make_console()
    folder = request.folder
    holes = read_holes(folder)
    table = Table("image", "hole", box=None)
    for row in holes.frames:
        table.add_row(row.image_path, format_percent(row.hole_fraction))
    console.print(table)
    # Options that the command with the painted images does not take.
    given = ["--export-holes"]
    given += ["--path"] if request.has_path else []
    given += ["--auto"] if request.names_number else []
    sentences = [
        *lines,
        f"Nothing was completed. The holes are in {quote_value(folder)}: paint each image where "
        "its mask is white, and save it by the same name (.png, .jpg or .webp).",
        f"Then run the same command with --images {quote_value(folder)} --painter NAME in place of "
        f"{' and '.join(given)}.",
    ]
    for sentence in sentences:
        console.print(sentence, soft_wrap=True)
