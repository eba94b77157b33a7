"""From a completed scene back to the one that was given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gscompleter.errors import InputError, quoted
from gscompleter.io.ply import save_ply
from gscompleter.splats.formats import format_of, load_splat, save_splat, writable_format
from gscompleter.splats.layout import Layout, read_layout, unlabelled, with_rows, write_layout
from gscompleter.splats.removed import NAME, load_removed, put_back
from gscompleter.types import Gaussians


def strip(path: Path, out: Path) -> tuple[int, int]:
    """Write the scene that the completed one at `path` was made of.

    Where both are .ply the file keeps its layout, else what is in it is written anew.

    Returns:
        How many Gaussians were written, and how many generated ones were left out.

    Raises:
        InputError: where nothing of it was given, or a file cannot be read or written.
    """
    completed = load_splat(path)
    given = as_given(completed, path)
    layout = file_as_given(path, given)
    if layout is not None and writable_format(out).write is save_ply:
        write_layout(out, layout)
    else:
        save_splat(out, given)
    return len(given), int((completed.generated > 0).sum())


def as_given(completed: Gaussians, path: Path) -> Gaussians:
    """The Gaussians of the completed scene at `path` as they were given, in their order.

    Raises:
        InputError: where all are generated, or the removed.ply beside it is damaged.
    """
    given = without_padding(completed)
    place = path.parent / NAME
    if place.is_file():
        given = put_back(given, *load_removed(place), place)
    if len(given) == 0:
        raise InputError(f"{quoted(path)} holds nothing that was given: all of it was generated.")
    return given


def without_padding(completed: Gaussians) -> Gaussians:
    """What was observed, without the harmonics that only what was generated has.

    A scene of fewer harmonics is padded with zeros when Gaussians with more are added to it.
    """
    observed = completed[completed.generated == 0]
    generated = completed[completed.generated > 0]
    k = completed.sh.shape[1]
    for lower in (width for width in (9, 4, 1) if width < k):
        if not generated.sh[:, lower:k].any() or observed.sh[:, lower:k].any():
            break
        k = lower
    return replace(observed, sh=observed.sh[:, :k].contiguous())


def file_as_given(path: Path, given: Gaussians) -> Layout | None:
    """The completed .ply at `path` without the rows and the column that completing it added.

    None where it is no .ply whose rows can be kept, or they were widened for more harmonics.
    """
    layout = read_layout(path) if format_of(path) == "ply" else None
    if layout is None or layout.num_rest != 3 * (given.sh.shape[1] - 1):
        return None
    layout, place = unlabelled(layout), path.parent / NAME
    if not place.is_file():
        return layout
    others = read_layout(place)
    if others is None:
        return None
    return with_rows(layout, unlabelled(others), load_removed(place)[1])
