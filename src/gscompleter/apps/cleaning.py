"""Removal of floaters from a splat, compared with its photographs or alone."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool
from rich.console import Console
from torch import Tensor

from gscompleter import __version__
from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.completing.preparation import open_input
from gscompleter.apps.completing.run_info import describe_run_values
from gscompleter.apps.inputs.depth_range import apply_splat_range
from gscompleter.apps.inputs.describing import describe_opening, print_lines
from gscompleter.apps.inputs.reading import read_photographs
from gscompleter.apps.inputs.refined_poses import read_at_refined_poses, write_refined_poses
from gscompleter.apps.inputs.splat import (
    file_harmonics,
    locate_splat,
    move_to_splat,
    read_splat,
)
from gscompleter.apps.inputs.taken_out import take_over_edits
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile, Opened
from gscompleter.apps.report.cleaning_picture import (
    REMOVED_PICTURE_FILE,
    RemovalVisibility,
    choose_most_removed,
    choose_outside_cameras,
    draw_removal_rows,
    measure_removal_visibility,
)
from gscompleter.apps.report.scenes import save_changed, save_completed_splat
from gscompleter.apps.report.schema import refuse_completed
from gscompleter.apps.requests.cleaning import CleaningRequest
from gscompleter.apps.requests.scene import PhotographsRequest
from gscompleter.apps.requests.splat import SplatRequest
from gscompleter.apps.warmup import compile_kernels
from gscompleter.editing.cleaning import find_superfluous
from gscompleter.editing.floaters import find_floaters
from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.evaluation.verdict.numbers import describe_measured
from gscompleter.numerics.image_ops import compute_mask_fraction
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.splats.alignment.trainer_files import TRAINER_FILES, keep_trainer_files
from gscompleter.splats.edits import EDITS, EditDraft, record_edit
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import write_image
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.reading import check_file
from gscompleter.system.files.result_names import COMPLETED_FILE, REMOVED_FILE, SUMMARY_FILE
from gscompleter.system.progress import show_progress, stage, track
from gscompleter.system.timing import record_seconds, timed_stage
from gscompleter.types import Camera, Gaussians, View

CLEAN_COMMAND = "clean"
CLEANING_FILES = (
    COMPLETED_FILE,
    REMOVED_FILE,
    REMOVED_PICTURE_FILE,
    SUMMARY_FILE,
    *EDITS,
    *TRAINER_FILES,
)
"""Files that it may write."""


@dataclass(frozen=True)
class Cleaning:
    """A splat and what goes."""

    given: Gaussians
    removed: Bool[Tensor, "n"]
    splat_file: InputSplatFile
    run_info: Mapping[str, Any]
    """Further entries of `summary.json`: the settings, the reasons with their numbers, the seconds,
    and what photographs, or cameras from outside, say of what goes."""
    cameras: Sequence[Camera]
    """Cameras that see most of what goes."""
    renderer: Renderer
    opened: Opened | None = None
    """The photographs that decided; None for a splat alone."""

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of Gaussians."""
        count = int(self.removed.sum())
        return {"given": len(self.given), "kept": len(self.given) - count, "removed": count}


def clean_splat(request: CleaningRequest) -> None:
    """Clean the splat, write the result, and print a summary.

    Raises:
        InputError: The splat or the photographs cannot be used, all of the splat would go, or the
            output folder holds something else.
    """
    results = request.results
    console = make_console(stderr=True, quiet=results.answer.quiet)
    with (
        show_progress(console),
        reserve_output(results.out, results.overwrite, CLEAN_COMMAND, CLEANING_FILES) as output,
    ):
        if request.dry_run:
            refuse_completed(results.out)
        print_lines(console, *output.describe_others())
        if request.photographs is None:
            cleaning = clean_alone(request)
        else:
            cleaning = clean_by_photographs(request, request.photographs, console)
        if cleaning.removed.all():
            raise InputError(
                "Every Gaussian of the splat would go; check the settings, and that photographs "
                "show the same scene."
            )
        summary = {"version": __version__, **cleaning.run_info, "gaussians": cleaning.counts}
        with output.write() as folder, stage("writing"):
            if not request.dry_run:
                # `given[:0]`: a cleaning adds nothing.
                save_completed_splat(
                    folder,
                    cleaning.given,
                    cleaning.removed,
                    cleaning.given[:0],
                    cleaning.splat_file,
                )
                keep_trainer_files(cleaning.splat_file.path, folder)
                record_edit(
                    folder,
                    EditDraft(CLEAN_COMMAND),
                    rows=len(cleaning.given),
                    appended=(),
                    given=cleaning.splat_file.path,
                    earlier=cleaning.splat_file.edits,
                    run=None,
                )
                if cleaning.opened is not None:
                    write_refined_poses(folder, cleaning.opened)
            elif cleaning.removed.any():
                save_changed(folder, cleaning.given, cleaning.removed, cleaning.splat_file)
            if cleaning.removed.any():
                picture = draw_removal_rows(
                    cleaning.given, cleaning.removed, cleaning.cameras, cleaning.renderer
                )
                write_image(folder / REMOVED_PICTURE_FILE, picture)
            (folder / SUMMARY_FILE).write_bytes(json.dumps(summary, indent=2).encode() + b"\n")
    lines = describe_cleaned_files(summary, request)
    print_answer(results.answer, json.loads((results.out / SUMMARY_FILE).read_bytes()), lines)


def clean_by_photographs(
    request: CleaningRequest, photographs: PhotographsRequest, console: Console
) -> Cleaning:
    """Find what makes the photographs worse, or what none of them needs."""
    splat = request.splat
    device = request.device
    renderer = load_renderer(device)

    # The splat is also read before cameras are searched for, so that a damaged file is refused
    # within seconds: the search takes minutes.
    opened = open_input(photographs, splat, console, partial(load_given_splat, splat))
    loaded = file_harmonics(load_given_splat(splat), splat, device)
    splat_file = locate_splat(splat.path, splat.drop_nonfinite)

    def read(opened: Opened) -> CompletionTask:
        """Read the photographs in the frame of the splat."""
        with stage("reading photographs"):
            task = read_photographs(opened, photographs.context, device)
        compile_kernels([device])
        with stage("aligning the scene"):  # on the device of the task
            return move_to_splat(task, loaded, splat_file, opened)

    if photographs.scene.refines_poses:
        opened, task = read_at_refined_poses(opened, read, console)
    else:
        task = read(opened)

    # From here on the splat is that of the task, whose coordinates may have a local origin.
    given = task.scene
    assert given is not None
    task = apply_splat_range(task, given, renderer)

    task, notes = take_over_edits(task, splat.forget_edits, renderer)
    print_lines(console, *notes)

    plan = f"compared with {len(task.views)} photographs on {device}"
    plan += f", written to {quote_value(request.results.out)}"
    print_lines(console, *describe_opening(opened, task), f"To do: {plan}.")

    # Photographs decide, so that nothing reads `config.floaters`.
    config = request.config.strengthen(request.strength)
    with record_seconds(()) as seconds, timed_stage("clean"):
        reasons = find_superfluous(given, task.views, renderer, config)
    removed = torch.stack(list(reasons.values())).any(dim=0)
    run_info = describe_run_values(
        photographs,
        splat,
        opened,
        task,
        config,
        {"strength": request.strength},
        photographs.scene.masks.is_inverted,
    )
    scores, seen = score_cleaning(given, task.views, removed, renderer, opened.files)
    counts = {reason: int(mask.sum()) for reason, mask in reasons.items()}
    run_info = {**run_info, "reasons": counts, "photographs": scores, "seconds": seconds}
    assert task.splat_file is not None
    return Cleaning(
        given, removed, task.splat_file, run_info, choose_most_removed(seen), renderer, opened
    )


def clean_alone(request: CleaningRequest) -> Cleaning:
    """Find floaters by statistics of the splat alone."""
    splat = request.splat
    device = request.device
    given = file_harmonics(load_given_splat(splat).to(device), splat, device)
    renderer = load_renderer(device)
    compile_kernels([device])
    # Without photographs nothing reads the rest of the config.
    floaters = request.config.strengthen(request.strength).floaters
    with record_seconds(()) as seconds, timed_stage("clean"):
        reasons = find_floaters(given, floaters, renderer)
    # A Gaussian can have several reasons, so their counts may exceed the number that goes.
    removed = torch.stack(list(reasons.values())).any(dim=0)
    cameras: list[Camera] = []
    share = 0.0
    # If every Gaussian would go, nothing is left to draw, and the caller refuses it.
    if removed.any() and not removed.all():
        with stage("looking from outside"):
            cameras, share = choose_outside_cameras(given, removed, renderer)
    run_info = {
        "settings": {
            "scene": str(splat.path),
            "drop_nonfinite": splat.drop_nonfinite,
            "strength": request.strength,
            "device": device,
            "config": {"floaters": asdict(floaters)},
        },
        "reasons": {reason: int(mask.sum()) for reason, mask in reasons.items()},
        "seen_from_outside": share,
        "seconds": seconds,
    }
    splat_file = locate_splat(splat.path, splat.drop_nonfinite)
    return Cleaning(given, removed, splat_file, run_info, cameras, renderer)


def load_given_splat(splat: SplatRequest) -> Gaussians:
    """Read the splat to clean."""
    # A file that is not there is refused before a line says that it is read. A folder may be an
    # unpacked .sog.
    if not os.path.isdir(splat.path):
        check_file(splat.path)
    with stage("reading the scene"):
        return read_splat(splat)


def score_cleaning(
    given: Gaussians,
    views: Sequence[View],
    taken: Bool[Tensor, "n"],
    renderer: Renderer,
    files: Mapping[int | None, str],
) -> tuple[list[dict[str, Any]], list[RemovalVisibility]]:
    """Compute PSNR (dB) of each photograph before and after, without the pixels of its mask.

    It is None for a photograph that is ignored everywhere. `taken` are the Gaussians that go;
    `files` has the file of each photograph by frame. Also returns what each photograph sees of
    them.
    """
    kept = given.hide(taken)
    rows = []
    seen = []
    for view in track(views, "scores"):
        frozen = renderer.freeze(given, view.camera)
        seen.append(measure_removal_visibility(frozen, taken, view.camera))
        before = frozen.render.image
        del frozen  # before the next render, since both take memory
        after = renderer.render(kept, view.camera).image
        rows.append(
            {
                "frame": view.frame,
                "file": files.get(view.frame),
                "psnr_before": compute_masked_psnr(before, view.image, view.valid_mask),
                "psnr_after": compute_masked_psnr(after, view.image, view.valid_mask),
                "ignored": compute_mask_fraction(view.ignore_mask),
            }
        )
    return rows, seen


def describe_cleaned_files(summary: Mapping[str, Any], request: CleaningRequest) -> list[str]:
    """Describe what went, and which file is what; the last line names the cleaned splat."""
    counts = summary["gaussians"]
    out = request.results.out
    if request.dry_run:
        lines = [f"Dry run: {describe_cleaning(summary, 'would be removed, found')}"]
    else:
        lines = [describe_cleaning(summary, "removed")]
    if counts["removed"] > 0:
        goes = "would go" if request.dry_run else "went"
        lines.append(
            f"What {goes}: {out / REMOVED_FILE}; {out / REMOVED_PICTURE_FILE} shows it in red."
        )
    if request.dry_run:
        lines.append(f"Nothing was cleaned; leave out --dry-run to write {COMPLETED_FILE}.")
    else:
        lines.append(f"The cleaned splat: {out / COMPLETED_FILE}")
    return lines


def describe_cleaning(summary: Mapping[str, Any], done: str) -> str:
    """Describe the numbers of Gaussians, and the change of PSNR or the reasons.

    `done` says what happened to what goes.
    """
    counts = summary["gaussians"]
    seconds = summary["seconds"]["total"]
    text = f"{counts['removed']:,} of {counts['given']:,} Gaussians {done} in {seconds:.1f} s; "
    reasons = ", ".join(f"{count:,} {name}" for name, count in summary["reasons"].items())
    if "photographs" not in summary:
        share = summary["seen_from_outside"]
        return f"{text}{reasons}; they are {share:.1%} of what is seen from outside"

    # A photograph that is ignored everywhere has no scores.
    rows = [row for row in summary["photographs"] if row["psnr_before"] is not None]
    if not rows:
        return f"{text}{reasons}; the photographs are ignored everywhere, and tell no PSNR"
    before = torch.tensor([row["psnr_before"] for row in rows])
    after = torch.tensor([row["psnr_after"] for row in rows])
    change = (
        f"mean PSNR of the photographs {before.mean():.2f} dB before, {after.mean():.2f} dB after"
        f"{describe_measured([1 - row['ignored'] for row in rows])}, worst change "
        f"{(after - before).min():+.3f} dB"
    )
    return f"{text}{reasons}; {change}"
