"""The command `convert`: another format, and splats joined, cut, turned and reduced."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.shared_options import WritingOptions, list_inputs
from gscompleter.apps.requests.conversion import ConversionRequest
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.overlap import refuse_input_file
from gscompleter.system.process import import_without_collection

CompressionLevel = Annotated[int, Interval(ge=0, le=100)]
Degrees = Annotated[float, Interval(ge=-36_000, le=36_000)]
Offset = Annotated[float, Interval(ge=-1e9, le=1e9)]
Factor = Annotated[float, Interval(ge=1e-9, le=1e9)]


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(WritingOptions):
    """Convert a file of Gaussians to another format, by the name of B.

    A table of docs/formats.md has all formats, such as .ply, .compressed.ply, .spz, .splat, .sog,
    .glb (KHR_gaussian_splatting) and .usdz (OpenUSD, with usd-core). On the way a splat can be
    joined with others, cut, scaled, turned, moved and reduced, in the order of the options below,
    whatever their order is when they are given. Numbers are in the axes of a .ply: x right, y down,
    z forward.

    Example: gscompleter convert splat.ply splat.spz
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """File to read, or the folder of a .sog."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """File to write."""
    level: CompressionLevel | None = None
    """Level of detail to read of a streamed .sog (its folder or lod-meta.json); 0 is the finest."""
    merge: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE [FILE ...]")] = ()
    """Splats to add to A, in its coordinates; their labels of what is generated follow its own."""
    bands: Literal[0, 1, 2, 3] | None = None
    """Leave out harmonics above this degree; 3 also reads files of degree 4."""
    crop_box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1"),
    ] = None
    """Keep Gaussians whose centre lies in this box: its smallest and its largest x, y and z."""
    crop_sphere: Annotated[
        tuple[float, float, float, float] | None, tyro.conf.arg(metavar="X Y Z RADIUS")
    ] = None
    """Keep Gaussians whose centre lies in this sphere; with a box, in both."""
    scale: Factor = 1.0
    """Scale by this factor, about the origin."""
    rotate: Annotated[tuple[Degrees, Degrees, Degrees], tyro.conf.arg(metavar="X Y Z")] = (
        0.0,
        0.0,
        0.0,
    )
    """Turn by these angles in degrees, about the axes x, then y, then z through the origin; colours
    by direction turn with it."""
    translate: Annotated[tuple[Offset, Offset, Offset], tyro.conf.arg(metavar="X Y Z")] = (
        0.0,
        0.0,
        0.0,
    )
    """Move by this."""
    decimate: Annotated[str | None, tyro.conf.arg(metavar="N|N%")] = None
    """Merge neighbours until about this number or share of the Gaussians is left."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    ignore_properties: bool = False
    """Go on with a splat whose further properties change what is seen, such as a moving one."""
    plain: bool = False
    """Write neither labels of generated Gaussians, which some programs misread (no property
    `generated` in a .ply, no file beside other formats), nor who made them."""

    def check_overlap(self) -> None:
        """Refuse to write over an input, and over what the index of a streamed scene names."""
        # Imported here, so that help pages do not wait for torch.
        with import_without_collection():
            from gscompleter.splats.streamed import is_streamed, list_streamed_files

        inputs = list_inputs(self)
        streamed = [path for path in inputs if is_streamed(path)]
        named = [file for path in streamed for file in list_streamed_files(path)]
        refuse_input_file(self.out, [*inputs, *named])


def decide_conversion(options: ConvertOptions) -> ConversionRequest:
    """Decide what is converted, and what is changed on the way."""
    from gscompleter.splats.foreign import resolve_splat  # no help page waits for torch

    return ConversionRequest(
        sources=tuple(resolve_splat(path) for path in (options.source, *options.merge)),
        out=options.out,
        level=options.level,
        bands=options.bands,
        crop_box=options.crop_box,
        crop_sphere=options.crop_sphere,
        scale=options.scale,
        rotate=options.rotate,
        translate=options.translate,
        decimate=None if options.decimate is None else parse_decimation(options.decimate),
        drop_nonfinite=options.drop_nonfinite,
        ignore_properties=options.ignore_properties,
        plain=options.plain,
    )


def parse_decimation(words: str) -> float | int:
    """Parse how many Gaussians are left: a number, or a share in percent as a float up to 1."""
    with suppress(ValueError):
        if words.endswith("%"):
            share = float(words.removesuffix("%")) / 100
            if 0 < share <= 1:
                return share
        elif int(words) > 0:
            return int(words)
    raise InputError(
        f"{quote_value(words)} is no number of Gaussians such as 100000, and no share such as 25%.",
        "decimate",
    )


def run_convert(options: ConvertOptions) -> None:
    """Convert A to B, and print the number of Gaussians."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from dataclasses import asdict

        from gscompleter.apps.converting import convert
        from gscompleter.splats.formats import reserve_splat
        from gscompleter.system.console import make_console
        from gscompleter.system.progress import show_progress

    request = decide_conversion(options)
    with (
        reserve_splat(options.out, options.overwrite),
        show_progress(make_console(stderr=True, quiet=options.quiet)),
    ):
        done = convert(request)
    lines = list(done.notes)
    if done.rounding is not None:
        lines.append(done.rounding.describe())
    content = {
        "out": str(options.out),
        "gaussians": done.gaussians,
        "generated": done.generated,
        "notes": list(done.notes),
        "rounding": None if done.rounding is None else asdict(done.rounding),
    }
    sentence = f"{done.gaussians:,} Gaussians, {done.generated:,} of them generated: {options.out}"
    print_answer(options.answer, content, [*lines, sentence])
