"""The command `complete`: a scene folder in, a completed scene and its report out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gscompleter.commands.options import CompleteOptions, GeneratorOptions
from gscompleter.completer import GSCompleter
from gscompleter.config import CompleterConfig, load_config
from gscompleter.data.formats import open_photographs
from gscompleter.data.origin import frame_from_photographs, told_from
from gscompleter.data.photographs import PosedPhotographs
from gscompleter.data.scene import load_cameras
from gscompleter.errors import InputError
from gscompleter.generators import DiffusionSettings, load_generator
from gscompleter.io.files import check_output, output_folder
from gscompleter.io.ply import load_ply
from gscompleter.progress import shown_on
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render import choose_device, load_renderer
from gscompleter.reports.completion import Target, write_report
from gscompleter.types import Camera, Completion, View

MIN_SIZE = 16
"""Shorter side of an image, in pixels, under which there is nothing to match and to score."""


def run_completion(options: CompleteOptions) -> None:
    """Complete the scene of `options.folder`, write `options.out` and say what was done.

    Raises:
        InputError: anything about the input that the user can mend; nothing is written then.
    """
    summary, completion = complete_folder(options)
    if not options.quiet:
        tell(summary, completion, options.out)


def complete_folder(options: CompleteOptions) -> tuple[dict[str, Any], Completion]:
    """Complete the scene of `options.folder` and write `options.out`; also returns the summary.

    Raises:
        InputError: anything about the input that the user can mend; nothing is written then.
    """
    console = Console(stderr=True, quiet=options.quiet)
    check_output(options.out, options.overwrite)
    device = choose_device(options.device)
    renderer = load_renderer(device)
    config = load_config(options.config)
    check_context(options)
    given = open_photographs(options.folder, options.format, options.near, options.far)
    views = [view.to(device) for view in read_views(given, options.context, options)]
    targets = read_targets(given, options)
    scene = None
    if options.scene is not None:
        cameras = [view.camera for view in views] + [target.camera for target in targets]
        scene = load_ply(options.scene, drop_nonfinite=options.drop_nonfinite)
        scene = told_from(given.origin, scene, cameras).to(device)

    photographs = [
        View(target.photograph, target.camera, target.frame)
        for target in targets
        if target.photograph is not None
    ]
    completer = GSCompleter(
        load_reconstructor(options.reconstructor, options.weights, device),
        load_generator(
            options.synthesis.generator,
            options.seed,
            photographs,
            device,
            generator_settings(options.synthesis),
        ),
        renderer,
        config,
        options.seed,
    )
    with output_folder(options.out, options.overwrite) as folder:
        with shown_on(None if options.quiet else console):
            completion = completer(views, [t.camera.to(device) for t in targets], scene)
        settings = settings_of(options, config)
        frame = frame_from_photographs(given.origin)
        summary = write_report(
            folder, completion, views, targets, renderer, settings, options.seed, device, frame
        )
    return summary, completion


def generator_settings(options: GeneratorOptions) -> DiffusionSettings:
    """What the generator is told."""
    return DiffusionSettings(
        path=options.generator_path,
        steps=options.generator_steps,
        retries=options.generator_retries,
        prompt=options.generator_prompt,
        depth=options.generator_depth,
        at_once=options.generator_at_once,
        offload=options.generator_offload,
    )


def check_context(options: CompleteOptions) -> None:
    """Refuse too few context frames, and the same one twice."""
    needed = 2 if options.scene is None else 1
    if len(options.context) < needed:
        raise InputError(
            f"--context names {len(options.context)} frame(s), and stereo needs at least {needed}; "
            "name more, as in --context 0 4."
        )
    if len(set(options.context)) < len(options.context):
        raise InputError(
            f"--context names a frame twice ({' '.join(map(str, options.context))}), which gives "
            "identical cameras and no baseline; name different frames."
        )
    if not options.target:
        raise InputError("--target names no frame; name at least one, as in --target 8.")


def read_views(
    photographs: PosedPhotographs, frames: Sequence[int], options: CompleteOptions
) -> list[View]:
    """The photographs of `frames` as the options want them."""
    for frame in frames:
        check_size(photographs.camera(frame, options.resolution), f"Frame {frame}")
    return photographs.views(frames, options.resolution)


def read_targets(photographs: PosedPhotographs, options: CompleteOptions) -> list[Target]:
    """The target cameras in the order of the command line, with photographs where there are any."""
    targets = []
    for word in options.target:
        if not is_whole_number(word):
            cameras = load_cameras(
                word, options.resolution, options.near, options.far, photographs.origin.tolist()
            )
            targets += [Target(camera) for camera in cameras]
        elif photographs.has_photograph(int(word)):
            (view,) = read_views(photographs, [int(word)], options)
            targets.append(Target(view.camera, view.frame, view.image))
        else:
            targets.append(Target(photographs.camera(int(word), options.resolution), int(word)))
    for number, target in enumerate(targets, start=1):
        check_size(target.camera, f"Target {number}")
    return targets


def check_size(camera: Camera, name: str) -> None:
    """Refuse images in which there is nothing to match and to score."""
    if min(camera.width, camera.height) < MIN_SIZE:
        raise InputError(
            f"{name} is {camera.width} x {camera.height} pixels, and both sides must have at least "
            f"{MIN_SIZE}; choose a larger --resolution."
        )


def is_whole_number(word: str) -> bool:
    return word.lstrip("-").isdigit()


def settings_of(options: CompleteOptions, config: CompleterConfig) -> dict[str, Any]:
    """Everything that decided the result, for `summary.json`."""
    return {
        "folder": str(options.folder),
        "format": options.format,
        "context": list(options.context),
        "target": list(options.target),
        "scene": None if options.scene is None else str(options.scene),
        "reconstructor": options.reconstructor,
        "weights": None if options.weights is None else str(options.weights),
        **asdict(options.synthesis),
        "uses_target_photographs": options.synthesis.generator == "oracle",
        "resolution": None if options.resolution is None else list(options.resolution),
        "near": options.near,
        "far": options.far,
        "config": asdict(config),
    }


def tell(summary: Mapping[str, Any], completion: Completion, out: Path) -> None:
    """Say what was done: a row per camera, and where it lies."""

    def cell(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    table = Table("camera", "hole", "PSNR before", "PSNR after", "added", box=None)
    for row in summary["context"]:
        name = f"context {row['frame']}"
        table.add_row(name, "", cell(row["psnr_before"]), cell(row["psnr_after"]), "")
    notes = []
    for row, target in zip(summary["targets"], completion.targets, strict=True):
        name = "target" if row["frame"] is None else f"target {row['frame']}"
        notes += [f"{name}: {note}" for note in target.notes]
        hole = f"{100 * row['hole_fraction']:.1f} %"
        scores = cell(row["psnr_before"]), cell(row["psnr_after"])
        table.add_row(name, hole, *scores, f"{len(target.added):,}")
    console = Console()
    console.print(table)
    for note in notes:
        console.print(note, highlight=False)
    offset = [-row[3] for row in summary["frame"]["transform"][:3]]
    if any(offset):
        console.print(
            f"The coordinates are large against the baselines, so the result is relative to "
            f"{' '.join(map(str, offset))}; summary.json has the transform.",
            highlight=False,
            soft_wrap=True,
        )
    counts = summary["gaussians"]
    seconds = summary["seconds"]["total"]
    console.print(
        f"Added {counts['added']:,} Gaussians to {counts['context']:,} in {seconds:.1f} s: "
        f"{out / 'completed.ply'}",
        highlight=False,
        soft_wrap=True,
    )
