"""The command `strip`: a completed scene as it was given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gscompleter.commands.convert import check_free
from gscompleter.errors import InputError

if TYPE_CHECKING:
    from gscompleter.splats.layout import Layout
    from gscompleter.types import Gaussians


@dataclass(frozen=True, kw_only=True)
class StripOptions:
    """Take everything that was generated out of a scene again, and put back what was set aside."""

    completed: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="COMPLETED")]
    """The completed scene. A removed.ply beside it is put back in its place."""
    out: Path
    """The file for the scene as it was given."""
    overwrite: bool = False
    """Replace the file where there is one."""
    quiet: bool = False
    """Say nothing but errors."""


def run_strip(options: StripOptions) -> None:
    """Write the scene as it was before its completion.

    Raises:
        InputError: where nothing of it was given, or a file cannot be read or written.
    """
    # Here, so that `--help` does not wait for torch.
    from gscompleter.io.ply import save_ply
    from gscompleter.splats.formats import load_splat, save_splat, writable_format
    from gscompleter.splats.layout import write_layout

    writable_format(options.out)
    check_free(options.out, options.overwrite)
    completed = load_splat(options.completed)
    given = as_given(completed, options.completed)
    file = file_as_given(options.completed, given)
    if file is not None and writable_format(options.out).write is save_ply:
        write_layout(options.out, file)
    else:
        save_splat(options.out, given)
    if not options.quiet:
        generated = int((completed.generated > 0).sum())
        print(f"{len(given):,} Gaussians, {generated:,} generated ones taken out: {options.out}")


def file_as_given(path: Path, given: Gaussians) -> Layout | None:
    """The completed .ply at `path` without the rows and the column that completing it added.

    None where it is no .ply whose rows can be kept, or they were widened for more harmonics.
    """
    from gscompleter.splats.formats import format_of
    from gscompleter.splats.layout import read_layout, unlabelled, with_rows
    from gscompleter.splats.removed import NAME, load_removed

    layout = read_layout(path) if format_of(path) == "ply" else None
    if layout is None or layout.num_rest != 3 * (given.sh.shape[1] - 1):
        return None
    layout, place = unlabelled(layout), path.parent / NAME
    if not place.is_file():
        return layout
    others = read_layout(place)
    return None if others is None else with_rows(layout, others, load_removed(place)[1])


def as_given(completed: Gaussians, path: Path) -> Gaussians:
    """The Gaussians of the completed scene at `path` as they were given, in their order.

    Raises:
        InputError: where all are generated, or the removed.ply beside it is damaged.
    """
    from gscompleter.splats.removed import NAME, load_removed, put_back

    given = without_padding(completed)
    place = path.parent / NAME
    if place.is_file():
        given = put_back(given, *load_removed(place), place)
    if len(given) == 0:
        raise InputError(f"{path} holds nothing that was given: all of it was generated.")
    return given


def without_padding(completed: Gaussians) -> Gaussians:
    """What was observed, without the harmonics that only what was generated has.

    A scene of fewer harmonics is padded with zeros when Gaussians with more are added to it.
    """
    from dataclasses import replace

    observed = completed[completed.generated == 0]
    generated = completed[completed.generated > 0]
    k = completed.sh.shape[1]
    for lower in (width for width in (9, 4, 1) if width < k):
        padded = (generated.sh[:, lower:k] != 0).any() and not observed.sh[:, lower:k].any()
        if not padded:
            break
        k = lower
    return replace(observed, sh=observed.sh[:, :k].contiguous())
