"""The command `convert`: the same Gaussians in another format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.shared_options import WritingOptions, list_inputs
from gscompleter.system.files.overlap import refuse_input_file
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(WritingOptions):
    """Convert a file of Gaussians to another format, by the name of B.

    Formats are .ply, .compressed.ply, .spz, .splat, .sog, .glb (KHR_gaussian_splatting), and
    .usda, .usdc and .usdz (OpenUSD, with usd-core). It also reads .ksplat, the folder of a .sog,
    and .glb with a .spz inside.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """File to read, or the folder of a .sog."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """File to write."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    plain: bool = False
    """Write neither labels of generated Gaussians, which some programs misread (no property
    `generated` in a .ply, no file beside other formats), nor who made them."""

    def check_overlap(self) -> None:
        """Refuse to write over the input."""
        refuse_input_file(self.out, list_inputs(self))


def run_convert(options: ConvertOptions) -> None:
    """Convert A to B, and print the number of Gaussians."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from rich.console import Console

        from gscompleter.splats.formats import (
            describe_mode_loss,
            get_writer,
            load_splat,
            read_provenance,
            save_splat,
        )
        from gscompleter.splats.provenance import NOTHING_KNOWN
        from gscompleter.system.files.output_file import reserve_file
        from gscompleter.system.progress import show_preparation, show_progress

    get_writer(options.out)  # refuses a name without a format
    with (
        reserve_file(options.out, options.overwrite),
        show_progress(Console(stderr=True, quiet=options.quiet)),
    ):
        with show_preparation("reading"):
            gaussians = load_splat(options.source, options.drop_nonfinite)
            made_by = NOTHING_KNOWN if options.plain else read_provenance(options.source)
        generated = gaussians.generated
        written = gaussians
        if options.plain:
            # Without generated Gaussians a writer leaves the labels out altogether.
            written = replace(gaussians, generated=generated.new_zeros(len(gaussians)))
        with show_preparation("writing"):
            save_splat(options.out, written, made_by)
    # Some formats cannot say that a scene is antialiased.
    note = describe_mode_loss(options.out, gaussians)
    notes = [] if note is None else [note]
    count = int((generated > 0).sum())
    content = {
        "out": str(options.out),
        "gaussians": len(gaussians),
        "generated": count,
        "notes": notes,
    }
    sentence = f"{len(gaussians):,} Gaussians, {count:,} of them generated: {options.out}"
    print_answer(options, content, [*notes, sentence])
