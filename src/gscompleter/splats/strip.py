"""Restores the input scene from a completed one.

Pruned Gaussians are in `removed.ply`, with their row numbers in the input scene: a 3DGS .ply with
a further element `place` that has one property `uint row`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

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
    find_layout,
    insert_rows,
    make_layout,
    read_layout,
    write_layout,
)
from gscompleter.splats.ply import load_ply, read_header, save_ply
from gscompleter.types import Gaussians, merge

REMOVED_FILE = "removed.ply"
"""Name of the file of replaced originals, beside the completed scene."""


def strip(path: Path, out: Path) -> tuple[int, int]:
    """Write the input scene of the completed scene at `path`.

    If both are .ply, the layout of the file is kept. Returns the numbers of Gaussians written and
    left out.

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


def save_removed(
    path: Path,
    removed: Gaussians,
    rows: Int[Tensor, "n"],
    given: Path | None = None,
    kept: Bool[Tensor, "m"] | None = None,
) -> None:
    """Write replaced originals with their ascending row numbers in the input scene.

    The rows of a binary .ply `given` are copied with all of their properties. `kept` marks the rows
    of `given` that the scene has; None for all.
    """
    layout = find_layout(given)
    if layout is None:
        layout = make_layout(removed.to("cpu"))
    else:
        all_rows = layout.rows if kept is None else layout.rows[kept.numpy()]
        layout = replace(layout, rows=all_rows[rows.numpy()])
    head, after = layout.split_header()
    place = f"element place {len(rows)}\nproperty uint row\n".encode()
    header = b"".join([*head, place, after[-1]])
    trailer = rows.numpy().astype("<u4").tobytes()
    write_layout(path, replace(layout, header=header, trailer=trailer))


def load_removed(path: Path) -> tuple[Gaussians, Int[Tensor, "n"]]:
    """Load replaced originals and their row numbers in the input scene."""
    removed = load_ply(path)
    with path.open("rb") as file:
        _, (vertex, *others) = read_header(file, path)
        layout = [(e.name, e.count, [(p.name, p.kind) for p in e.properties]) for e in others]
        if layout != [("place", len(removed), [("row", "u4")])]:
            raise InputError(
                f"{quote_value(path)} does not say where its Gaussians belong in the scene; "
                "without it they cannot be put back in order."
            )
        file.seek(vertex.count * vertex.dtype("<").itemsize, 1)
        rows = np.frombuffer(file.read(), "<u4")
    if len(rows) != len(removed) or (np.diff(rows.astype(np.int64)) <= 0).any():
        raise InputError(
            f"{quote_value(path)} is damaged: its rows do not ascend; fetch the file again."
        )
    return removed, torch.from_numpy(rows.astype(np.int64))


def reinsert(kept: Gaussians, removed: Gaussians, rows: Int[Tensor, "n"], path: Path) -> Gaussians:
    """Insert replaced originals at their rows; `path` names their file in errors."""
    total = len(kept) + len(removed)
    if len(rows) and int(rows.max()) >= total:
        raise InputError(
            f"{quote_value(path)} belongs to another scene: it names row {int(rows.max()):,} of "
            f"one that has {total:,} Gaussians."
        )
    if kept.is_antialiased != removed.is_antialiased:
        raise InputError(
            f"{quote_value(path)} belongs to another scene: only one of the two is antialiased."
        )
    taken: Bool[Tensor, "n"] = torch.zeros(total, dtype=torch.bool)
    taken[rows] = True
    order = torch.empty(total, dtype=torch.int64)
    order[~taken] = torch.arange(len(kept))
    order[taken] = torch.arange(len(kept), total)
    return merge([kept, removed])[order]
