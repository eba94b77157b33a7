"""The command `clean`: remove floaters from a splat."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from rich.console import Console
from torch import Tensor

from gscompleter import __version__
from gscompleter.commands.opening import (
    Task,
    check_context,
    in_frame_of_splat,
    open_scene,
    read_photographs,
    say,
    with_working_range,
)
from gscompleter.commands.options import CleanOptions
from gscompleter.commands.output import (
    opened_as,
    replaceable,
    saying_what_stays,
    settings_of,
)
from gscompleter.commands.understood import found_out
from gscompleter.compilation import compile_kernels
from gscompleter.completer import Clock
from gscompleter.errors import InputError, quoted
from gscompleter.io.files import SUMMARY, check_output, output_folder
from gscompleter.metrics.image import psnr
from gscompleter.progress import preparing, shown_on, stage, track
from gscompleter.render import Renderer, choose_device, load_renderer
from gscompleter.reports.completion import save_brought
from gscompleter.splats.formats import load_splat
from gscompleter.stages.cleaning import superfluous
from gscompleter.types import Gaussians


def run_clean(options: CleanOptions) -> None:
    """Clean the splat, and print a summary."""
    with saying_what_stays(options.out):
        summary = clean_splat(options)
        if not options.quiet:
            tell(summary, options.out)


def clean_splat(options: CleanOptions) -> dict[str, Any]:
    """Clean the splat, write `options.out`, and return the summary."""
    console = Console(stderr=True, quiet=options.quiet)
    check_output(options.out, replaceable(options))
    check_context(options)
    device = choose_device(options.device)
    renderer, clock = load_renderer(device), Clock(())
    with shown_on(None if options.quiet else console):
        opened = open_scene(options, console)
        with preparing("reading photographs"):
            task = read_photographs(options, opened, device)
        with preparing("reading the scene"):
            given = load_splat(options.scene, options.drop_nonfinite)
        compile_kernels([device])
        with preparing("aligning the scene"):
            task = in_frame_of_splat(task, given, options.scene, options, opened)
        task = with_working_range(task, renderer)
        plan = f"compared with {len(task.views)} photographs on {device}"
        plan += f", written to {quoted(options.out)}"
        say(console, *found_out(options, opened, task), f"To do: {plan}.")
        with output_folder(options.out, replaceable(options)) as folder:
            with clock("clean"):
                removed = superfluous(splat_of(task), task.views, renderer, options.config)
            settings = settings_of(options, options.config, targets={}, models={})
            facts = {"settings": settings, "device": device, **opened_as(options, opened, task)}
            summary = facts | scores(task, removed, renderer) | {"seconds": clock.seconds}
            with stage("writing"):
                write(folder, task, removed, {"version": __version__, **summary})
    return summary


def splat_of(task: Task) -> Gaussians:
    """Return the input splat."""
    assert task.scene is not None
    return task.scene


def scores(task: Task, taken: Bool[Tensor, "n"], renderer: Renderer) -> dict[str, Any]:
    """Count the removed Gaussians, and compute PSNR (dB) before and after."""
    given = splat_of(task)
    rows = []
    for view in track(task.views, "scores"):
        before, after = (
            psnr(renderer.render(scene, view.camera).image, view.image)
            for scene in (given, given[~taken])
        )
        rows.append({"frame": view.frame, "psnr_before": before, "psnr_after": after})
    removed = int(taken.sum())
    counts = {"given": len(given), "kept": len(given) - removed, "removed": removed}
    return {"photographs": rows, "gaussians": counts}


def write(folder: Path, task: Task, taken: Bool[Tensor, "n"], summary: Mapping[str, Any]) -> None:
    """Write the cleaned splat, the removed Gaussians and the summary."""
    given = splat_of(task)
    if taken.all():
        raise InputError(
            "Every Gaussian of the splat makes the photographs worse; check that they show the "
            "same scene."
        )
    assert task.brought is not None
    save_brought(folder, given, taken, given[:0], task.brought)
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n")


def tell(summary: Mapping[str, Any], out: Path) -> None:
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
