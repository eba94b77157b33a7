"""The command `convert`: the same Gaussians in another format."""

from __future__ import annotations

from dataclasses import dataclass
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

    Example: gscompleter convert splat.ply splat.spz
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """File to read, or the folder of a .sog."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """File to write."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    ignore_properties: bool = False
    """Go on with a splat whose further properties change what is seen, such as a moving one."""
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
        from gscompleter.splats.formats import convert_splat, describe_oddities, reserve_splat
        from gscompleter.system.console import make_console
        from gscompleter.system.progress import show_preparation, show_progress

    with (
        reserve_splat(options.out, options.overwrite),
        show_progress(make_console(stderr=True, quiet=options.quiet)),
        show_preparation("converting"),
    ):
        count, num_generated, note = convert_splat(
            options.source,
            options.out,
            options.drop_nonfinite,
            not options.plain,
            options.ignore_properties,
        )
    # Some formats cannot say that a scene is antialiased.
    notes = [*describe_oddities(options.source), *([] if note is None else [note])]
    content = {
        "out": str(options.out),
        "gaussians": count,
        "generated": num_generated,
        "notes": notes,
    }
    sentence = f"{count:,} Gaussians, {num_generated:,} of them generated: {options.out}"
    print_answer(options, content, [*notes, sentence])
