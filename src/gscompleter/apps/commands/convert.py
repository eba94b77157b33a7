"""The commands `convert` and `strip`: the same Gaussians in another file."""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console

from gscompleter.apps.commands.options import ConvertOptions, StripOptions
from gscompleter.splats.formats import describe_mode_loss, get_writer, load_splat, save_splat
from gscompleter.splats.layout import strip
from gscompleter.system.files.output_file import reserve_file
from gscompleter.system.progress import show_preparation, show_progress


def run_convert(options: ConvertOptions) -> None:
    """Convert A to B, and print the number of Gaussians."""
    get_writer(options.out)  # refuses a name without a format
    with (
        reserve_file(options.out, options.overwrite),
        show_progress(Console(stderr=True, quiet=options.quiet)),
    ):
        with show_preparation("reading"):
            gaussians = load_splat(options.source, options.drop_nonfinite)
        generated = gaussians.generated
        written = gaussians
        if options.plain:
            # Without generated Gaussians a writer leaves the labels out altogether.
            written = replace(gaussians, generated=generated.new_zeros(len(gaussians)))
        with show_preparation("writing"):
            save_splat(options.out, written)
    if not options.quiet:
        # Some formats cannot say that a scene is antialiased.
        if note := describe_mode_loss(options.out, gaussians):
            print(note)
        count = int((generated > 0).sum())
        print(f"{len(gaussians):,} Gaussians, {count:,} of them generated: {options.out}")


def run_strip(options: StripOptions) -> None:
    """Write the original scene and print the number of Gaussians."""
    get_writer(options.out)  # refuses a name without a format
    with reserve_file(options.out, options.overwrite):
        num_given, num_generated = strip(options.completed, options.out)
    if not options.quiet:
        print(f"{num_given:,} Gaussians, {num_generated:,} generated ones removed: {options.out}")
