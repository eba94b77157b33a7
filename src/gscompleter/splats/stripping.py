"""Restores the input scene from a completed one."""

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
    """Write the input scene of the completed scene at `path`.

    If both are .ply, the layout of the file is kept. Returns the numbers of Gaussians written and
    left
    out.

    Raises:
        InputError: All Gaussians are generated, or a file cannot be read or written.
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
    """Restore the input Gaussians of the completed scene at `path`, in their order."""
    given = without_padding(completed)
    place = path.parent / NAME
    if place.is_file():
        given = put_back(given, *load_removed(place), place)
    if len(given) == 0:
        raise InputError(
            f"{quoted(path)} holds only generated Gaussians: there is no input scene to restore."
        )
    return given


def without_padding(completed: Gaussians) -> Gaussians:
    """Select the observed Gaussians, without the SH padding of a scene of lower degree."""
    observed = completed[completed.generated == 0]
    generated = completed[completed.generated > 0]
    k = completed.sh.shape[1]
    for lower in (width for width in (9, 4, 1) if width < k):
        if not generated.sh[:, lower:k].any() or observed.sh[:, lower:k].any():
            break
        k = lower
    return replace(observed, sh=observed.sh[:, :k].contiguous())


def file_as_given(path: Path, given: Gaussians) -> Layout | None:
    """Remove what completing added to the .ply at `path`; None if its rows cannot be restored."""
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
