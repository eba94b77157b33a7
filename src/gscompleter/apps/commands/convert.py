"""The command `convert`: the same Gaussians in another format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gscompleter.config.settings import Settings
from gscompleter.errors import InputError

if TYPE_CHECKING:
    from gscompleter.types import Gaussians


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(Settings):
    """Convert a file of Gaussians to .ply, .compressed.ply, .spz or .splat, by the name of B.

    It also reads .ksplat, .sog (a bundle or its folder) and .glb.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """File to read, or the folder of a .sog."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """File to write."""
    drop_nonfinite: bool = False
    """Drop Gaussians that contain NaN or infinity instead of refusing the file."""
    plain: bool = False
    """Write no labels of generated Gaussians: no property `generated` in a .ply, which some
    programs misread, and no file of labels beside other formats. All Gaussians are kept."""
    overwrite: bool = False
    """Replace an existing file."""
    quiet: bool = False
    """Print errors only."""


def run_convert(options: ConvertOptions) -> None:
    """Convert A to B, and print the number of Gaussians."""
    # Imported here so that `--help` does not wait for torch.
    from rich.console import Console

    from gscompleter.progress import show_preparation, show_progress
    from gscompleter.splats.formats import (
        describe_mode_loss,
        get_writable_format,
        load_splat,
        note_infinite_opacities,
        save_splat,
    )

    get_writable_format(options.out)
    check_free(options.out, options.overwrite)
    with show_progress(None if options.quiet else Console(stderr=True)):
        with show_preparation("reading"):
            gaussians = load_splat(options.source, options.drop_nonfinite)
        with show_preparation("writing"):
            save_splat(options.out, drop_labels(gaussians) if options.plain else gaussians)
    if not options.quiet:
        generated = int((gaussians.generated > 0).sum())
        notes = note_infinite_opacities(gaussians), describe_mode_loss(options.out, gaussians)
        for note in filter(None, notes):
            print(note)
        print(f"{len(gaussians):,} Gaussians, {generated:,} of them generated: {options.out}")


def drop_labels(gaussians: Gaussians) -> Gaussians:
    """Drop the labels of generated Gaussians; all Gaussians stay."""
    return replace(gaussians, generated=gaussians.generated.new_zeros(len(gaussians)))


def check_free(path: Path, overwrite: bool) -> None:
    """Refuse to replace a file unless `overwrite` is set."""
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists; name another file, or use --overwrite.")
