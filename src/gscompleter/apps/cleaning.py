"""Removal of floaters from a splat, compared with its photographs or alone."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool
from rich.console import Console
from torch import Tensor

from gscompleter import __version__
from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.clean import CleanOptions
from gscompleter.apps.completing.preparation import open_input
from gscompleter.apps.completing.run_info import describe_run, refuse_results
from gscompleter.apps.inputs.depth_range import apply_splat_range
from gscompleter.apps.inputs.describing import describe_opening, print_lines
from gscompleter.apps.inputs.named_photographs import check_context
from gscompleter.apps.inputs.reading import read_photographs
from gscompleter.apps.inputs.splat import locate_splat, move_to_splat
from gscompleter.apps.inputs.taken_out import (
    describe_taken_out,
    find_taken_out,
    hide_taken_out,
)
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.apps.report.completion import save_changed, save_completed_splat
from gscompleter.apps.warmup import compile_kernels
from gscompleter.editing.cleaning import find_superfluous
from gscompleter.editing.floaters import find_floaters
from gscompleter.evaluation.metrics.image import compute_masked_psnr
from gscompleter.evaluation.verdict.numbers import describe_measured
from gscompleter.numerics.image_ops import compute_mask_fraction
from gscompleter.render.device import choose_device
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.splats.edits import EDITS, EditDraft, record_edit
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import load_splat
from gscompleter.system.console import make_console
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.writing import COMPLETED_FILE, REMOVED_FILE, SUMMARY_FILE
from gscompleter.system.progress import show_preparation, show_progress, stage, track
from gscompleter.system.timing import record_seconds, timed_stage
from gscompleter.types import Gaussians, View

PHOTOGRAPH_OPTIONS = ("context", "format", "near", "far")
COMMAND = "clean"
RESULTS = (COMPLETED_FILE, REMOVED_FILE, SUMMARY_FILE, *EDITS)
"""Files that it may write."""


@dataclass(frozen=True)
class Cleaning:
    """A splat and what goes."""

    given: Gaussians
    removed: Bool[Tensor, "n"]
    splat_file: InputSplatFile
    run_info: Mapping[str, Any]
    """Further entries of `summary.json`."""

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of Gaussians."""
        count = int(self.removed.sum())
        return {"given": len(self.given), "kept": len(self.given) - count, "removed": count}


def clean_splat(options: CleanOptions) -> None:
    """Clean the splat, write the result, and print a summary."""
    options = replace(options, scene=resolve_splat(options.scene))
    console = make_console(stderr=True, quiet=options.quiet)
    clean = clean_alone if options.folder is None else clean_by_photographs
    with (
        show_progress(console),
        reserve_output(options.out, options.overwrite, COMMAND, RESULTS) as output,
    ):
        if options.dry_run:
            refuse_results(options.out)
        print_lines(console, *output.describe_others())
        cleaning = clean(options, console)
        if cleaning.removed.all():
            raise InputError(
                "Every Gaussian of the splat would go; check the settings, and that photographs "
                "show the same scene."
            )
        summary = {"version": __version__, **cleaning.run_info, "gaussians": cleaning.counts}
        with output.write() as folder, stage("writing"):
            if not options.dry_run:
                # `given[:0]`: a cleaning adds nothing.
                save_completed_splat(
                    folder,
                    cleaning.given,
                    cleaning.removed,
                    cleaning.given[:0],
                    cleaning.splat_file,
                )
                record_edit(
                    folder,
                    EditDraft(COMMAND),
                    len(cleaning.given),
                    0,
                    cleaning.splat_file.path,
                    has_record=False,
                )
            elif cleaning.removed.any():
                save_changed(folder, cleaning.given, cleaning.removed, cleaning.splat_file)
            (folder / SUMMARY_FILE).write_bytes(json.dumps(summary, indent=2).encode() + b"\n")
    line = f"{describe_cleaning(summary)}: {options.out / COMPLETED_FILE}"
    if options.dry_run:
        line = f"Dry run: {describe_cleaning(summary)}: {options.out / REMOVED_FILE}"
    print_answer(options, json.loads((options.out / SUMMARY_FILE).read_bytes()), [line])


def clean_by_photographs(options: CleanOptions, console: Console) -> Cleaning:
    """Find what makes the photographs worse, or what none of them needs."""
    check_context(options.context)
    device = choose_device(options.device)
    renderer = load_renderer(device)

    # The splat is also read before cameras are searched for, so that a damaged file is refused
    # within seconds: the search takes minutes.
    opened = open_input(options, console, partial(load_given_splat, options))
    with show_preparation("reading photographs"):
        task = read_photographs(opened, options.context, device)
    loaded = load_given_splat(options)
    compile_kernels([device])
    with show_preparation("aligning the scene"):
        splat_file = locate_splat(options.scene, options.drop_nonfinite)
        task = move_to_splat(task, loaded, splat_file, opened)

    # From here on the splat is that of the task, whose coordinates may have a local origin.
    given = task.scene
    assert given is not None
    task = apply_splat_range(task, given, renderer)

    print_lines(console, *describe_taken_out(options.scene, options.forget_edits))
    if not options.forget_edits:
        task = hide_taken_out(task, find_taken_out(task, renderer))

    plan = f"compared with {len(task.views)} photographs on {device}"
    plan += f", written to {quote_value(options.out)}"
    print_lines(console, *describe_opening(opened, task), f"To do: {plan}.")

    with record_seconds(()) as seconds, timed_stage("clean"):
        removed = find_superfluous(given, task.views, renderer, options.config)
    run_info = describe_run(options, opened, task, options.config)
    scores = score_cleaning(given, task.views, removed, renderer, opened.files)
    run_info = {**run_info, "photographs": scores, "seconds": seconds}
    return Cleaning(given, removed, splat_file, run_info)


def clean_alone(options: CleanOptions, console: Console) -> Cleaning:
    """Find floaters by statistics of the splat alone."""
    for name in PHOTOGRAPH_OPTIONS:
        if getattr(options, name) is not None:
            raise InputError("There are no photographs to apply this to; name their SCENE.", name)

    given = load_given_splat(options)
    floaters = options.config.floaters
    with record_seconds(()) as seconds, timed_stage("clean"):
        reasons = find_floaters(given, floaters)
    run_info = {
        "settings": {"scene": str(options.scene), "config": {"floaters": asdict(floaters)}},
        "reasons": {reason: int(mask.sum()) for reason, mask in reasons.items()},
        "seconds": seconds,
    }
    # A Gaussian can have several reasons, so their counts may exceed the number that goes.
    removed = torch.stack(list(reasons.values())).any(dim=0)
    return Cleaning(given, removed, locate_splat(options.scene, options.drop_nonfinite), run_info)


def load_given_splat(options: CleanOptions) -> Gaussians:
    """Read the splat to clean."""
    with show_preparation("reading the scene"):
        return load_splat(options.scene, options.drop_nonfinite, options.ignore_properties)


def score_cleaning(
    given: Gaussians,
    views: Sequence[View],
    taken: Bool[Tensor, "n"],
    renderer: Renderer,
    files: Mapping[int | None, str],
) -> list[dict[str, Any]]:
    """Compute PSNR (dB) of each photograph before and after, without the pixels of its mask.

    `taken` are the Gaussians that go; `files` has the file of each photograph by frame.
    """
    kept = given[~taken]
    rows = []
    for view in track(views, "scores"):
        before = renderer.render(given, view.camera).image
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
    return rows


def describe_cleaning(summary: Mapping[str, Any]) -> str:
    """Describe the numbers of Gaussians, and the change of PSNR or the reasons."""
    counts = summary["gaussians"]
    seconds = summary["seconds"]["total"]
    text = f"{counts['removed']:,} of {counts['given']:,} Gaussians removed in {seconds:.1f} s; "
    if "reasons" in summary:
        return text + ", ".join(f"{count:,} {name}" for name, count in summary["reasons"].items())

    before = torch.tensor([row["psnr_before"] for row in summary["photographs"]])
    after = torch.tensor([row["psnr_after"] for row in summary["photographs"]])
    unmasked = [1 - row["ignored"] for row in summary["photographs"]]
    return text + (
        f"mean PSNR of the photographs {before.mean():.2f} dB before, {after.mean():.2f} dB after"
        f"{describe_measured(unmasked)}, worst change {(after - before).min():+.3f} dB"
    )
