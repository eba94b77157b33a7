"""Images that were painted elsewhere, as options of a completion."""

from __future__ import annotations

from dataclasses import replace

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.inputs.holes_file import HOLES_FILE, has_holes, read_holes
from gscompleter.apps.inputs.paintings import check_paintings, read_paintings
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.config.generators import GeneratorOptions, PaintedOptions
from gscompleter.system.errors import InputError

PAINTED = "painted"
"""Name of the generator."""


def choose_paintings(options: CompleteOptions) -> CompleteOptions:
    """Refuse wrong options for painted images; return those of the completion with them.

    Without named targets and context, those of `holes.json` are taken: of another context Ψ makes
    another scene, with other holes.
    """
    refuse_combinations(options)
    folder = options.images
    if folder is None:
        return options
    check_paintings(folder, len(options.target))
    options = replace(options, synthesis=PaintedOptions(generator_painter=options.painter))
    if not has_holes(folder):
        return options
    if not options.target:
        options = replace(options, target=(str(folder / HOLES_FILE),))
    context = read_holes(folder).context
    # None is listed where renders take the place of photographs, at cameras that are found.
    if options.context is None and context:
        options = replace(options, context=context)
    return options


def refuse_combinations(options: CompleteOptions) -> None:
    """Refuse options for exported holes and painted images that exclude others."""
    is_export = options.export_holes is not None
    if options.path and not is_export:
        raise InputError(
            "--path is a video of what --export-holes writes; name its folder.", "export-holes"
        )
    if options.images is None:
        if options.painter is not None:
            raise InputError("--painter names who painted --images; name their folder.", "images")
        if options.synthesis.generator == PAINTED:
            raise InputError(
                "The generator 'painted' needs painted images; name their folder.", "images"
            )
    elif is_export:
        raise InputError(
            "--export-holes and --images are both given; export the holes, paint them, and run the "
            "command again with the images alone.",
            "images",
        )
    elif options.synthesis not in (GeneratorOptions(), GeneratorOptions(PAINTED)):
        raise InputError(
            "--images takes the place of a generator; leave --generator and its options out.",
            "generator",
        )
    elif options.auto is not None:
        raise InputError(
            "--images needs the targets that the images were painted for; leave --auto out.",
            "images",
        )
    if is_export and (options.dry_run or options.video):
        raise InputError(
            "--export-holes completes nothing; leave --dry-run and --video out.",
            "export-holes",
        )


def add_paintings(task: CompletionTask, options: CompleteOptions, opened: Opened) -> CompletionTask:
    """Add the painted images to the targets of a task, if there are any."""
    if options.images is None:
        return task
    resolution = opened.request.resolution
    targets = read_paintings(task.targets, opened.photographs, resolution, options.images)
    return replace(task, targets=targets)
