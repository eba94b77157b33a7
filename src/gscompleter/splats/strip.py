"""Restores the input scene from a completed one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gscompleter.errors import InputError, quote_value
from gscompleter.splats.formats import (
    detect_splat_format,
    get_writable_format,
    load_splat,
    save_splat,
)
from gscompleter.splats.layout import (
    PlyLayout,
    drop_generated,
    insert_rows,
    read_layout,
    write_layout,
)
from gscompleter.splats.ply import save_ply
from gscompleter.splats.provenance import REMOVED_FILE, load_removed, reinsert
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
    given = restore_input(completed, path)
    layout = restore_layout(path, given)
    if layout is not None and get_writable_format(out).write is save_ply:
        write_layout(out, layout)
    else:
        save_splat(out, given)
    return len(given), int((completed.generated > 0).sum())


def restore_input(completed: Gaussians, path: Path) -> Gaussians:
    """Restore the input Gaussians of the completed scene at `path`, in their order."""
    given = drop_sh_padding(completed)
    place = path.parent / REMOVED_FILE
    if place.is_file():
        given = reinsert(given, *load_removed(place), place)
    if len(given) == 0:
        raise InputError(
            f"{quote_value(path)} holds only generated Gaussians: there is no input scene to "
            "restore."
        )
    return given


def drop_sh_padding(completed: Gaussians) -> Gaussians:
    """Select the observed Gaussians, without the SH padding of a scene of lower degree."""
    observed = completed[completed.generated == 0]
    generated = completed[completed.generated > 0]
    k = completed.sh.shape[1]
    for lower in (width for width in (9, 4, 1) if width < k):
        if not generated.sh[:, lower:k].any() or observed.sh[:, lower:k].any():
            break
        k = lower
    return replace(observed, sh=observed.sh[:, :k].contiguous())


def restore_layout(path: Path, given: Gaussians) -> PlyLayout | None:
    """Remove what completing added to the .ply at `path`; None if its rows cannot be restored."""
    layout = read_layout(path) if detect_splat_format(path) == "ply" else None
    if layout is None or layout.num_rest != 3 * (given.sh.shape[1] - 1):
        return None
    layout, place = drop_generated(layout), path.parent / REMOVED_FILE
    if not place.is_file():
        return layout
    others = read_layout(place)
    if others is None:
        return None
    return insert_rows(layout, drop_generated(others), load_removed(place)[1])
