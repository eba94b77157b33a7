"""The command `clean`: remove floaters from a splat."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from rich.console import Console
from torch import Tensor

from gscompleter import __version__
from gscompleter.apps.commands.options import CleanOptions
from gscompleter.apps.commands.output import describe_run, is_replaceable
from gscompleter.apps.inputs.opening import (
    apply_working_range,
    check_context,
    describe_opening,
    move_to_splat,
    open_scene,
    print_lines,
    read_photographs,
)
from gscompleter.apps.report.completion import save_completed_splat
from gscompleter.apps.warmup import compile_kernels
from gscompleter.cleaning import find_superfluous
from gscompleter.errors import InputError, quote_value
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.io.files import SUMMARY_FILE, check_output, open_output_folder
from gscompleter.progress import show_preparation, show_progress, stage, track
from gscompleter.render import Renderer, choose_device, load_renderer
from gscompleter.splats.formats import load_splat
from gscompleter.timing import record_seconds, timed_stage
from gscompleter.types import Gaussians, View


def run_clean(options: CleanOptions) -> None:
    """Clean the splat, write the result, and print a summary."""
    console = Console(stderr=True, quiet=options.quiet)
    check_output(options.out, is_replaceable(options))
    check_context(options)
    device = choose_device(options.device)
    renderer = load_renderer(device)
    with show_progress(console):
        opened = open_scene(options, console)
        with show_preparation("reading photographs"):
            task = read_photographs(options, opened, device)
        with show_preparation("reading the scene"):
            loaded = load_splat(options.scene, options.drop_nonfinite)
        compile_kernels([device])
        with show_preparation("aligning the scene"):
            task = move_to_splat(task, loaded, options.scene, options, opened)
        given, splat_file = task.scene, task.splat_file
        assert given is not None
        assert splat_file is not None
        task = apply_working_range(task, renderer)
        plan = f"compared with {len(task.views)} photographs on {device}"
        plan += f", written to {quote_value(options.out)}"
        print_lines(console, *describe_opening(options, opened, task), f"To do: {plan}.")
        with open_output_folder(options.out, is_replaceable(options)) as folder:
            with record_seconds(()) as seconds, timed_stage("clean"):
                removed = find_superfluous(given, task.views, renderer, options.config)
            summary = {
                "version": __version__,
                **describe_run(options, opened, task, options.config),
                **score_cleaning(given, task.views, removed, renderer),
                "seconds": seconds,
            }
            if removed.all():
                raise InputError(
                    "Every Gaussian of the splat makes the photographs worse; check that they show "
                    "the same scene."
                )
            with stage("writing"):
                save_completed_splat(folder, given, removed, given[:0], splat_file)
                (folder / SUMMARY_FILE).write_bytes(json.dumps(summary, indent=2).encode() + b"\n")
    if not options.quiet:
        print_cleaning(summary, options.out)


def score_cleaning(
    given: Gaussians, views: Sequence[View], taken: Bool[Tensor, "n"], renderer: Renderer
) -> dict[str, Any]:
    """Count the removed Gaussians, and compute PSNR (dB) before and after."""
    rows = []
    for view in track(views, "scores"):
        before, after = (
            psnr(renderer.render(scene, view.camera).image, view.image)
            for scene in (given, given[~taken])
        )
        rows.append({"frame": view.frame, "psnr_before": before, "psnr_after": after})
    removed = int(taken.sum())
    counts = {"given": len(given), "kept": len(given) - removed, "removed": removed}
    return {"photographs": rows, "gaussians": counts}


def print_cleaning(summary: Mapping[str, Any], out: Path) -> None:
    """Print the numbers of Gaussians and the change of PSNR."""
    rows, counts = summary["photographs"], summary["gaussians"]
    before, after = (
        torch.tensor([row[f"psnr_{when}"] for row in rows]) for when in ("before", "after")
    )
    print(
        f"{counts['removed']:,} of {counts['given']:,} Gaussians removed in "
        f"{summary['seconds']['total']:.1f} s; mean PSNR of the photographs {before.mean():.2f} dB "
        f"before, {after.mean():.2f} dB after, worst change {(after - before).min():+.3f} dB: "
        f"{out / 'completed.ply'}"
    )
