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
from gscompleter.splats.formats import get_writer, load_splat, save_splat
from gscompleter.splats.layout import drop_generated, find_layout, split_header
from gscompleter.splats.ply import (
    count_rest,
    decode_gaussians,
    make_rows,
    make_scene_header,
    read_scene,
    require_finite,
    save_ply,
)
from gscompleter.splats.ply_file import PlyFile, write_ply_file
from gscompleter.types import Gaussians, merge

REMOVED_FILE = "removed.ply"
"""Name of the file of replaced originals, beside the completed scene."""


def strip(path: Path, out: Path) -> tuple[int, int]:
    """Write the input scene of the completed scene at `path`.

    If both are .ply, the layout of the file is kept. Returns the numbers of Gaussians written and
    left out.
    """
    completed, layout = load_splat(path), find_layout(path)
    given = drop_sh_padding(completed)
    layout = None if layout is None else drop_generated(layout)
    removed = path.parent / REMOVED_FILE
    if removed.is_file():
        given, layout = reinsert(given, layout, removed)
    if len(given) == 0:
        raise InputError(
            f"{quote_value(path)} holds only generated Gaussians: there is no input scene to "
            "restore."
        )
    is_padded = layout is None or count_rest(layout) != 3 * (given.sh.shape[1] - 1)
    if layout is None or is_padded or get_writer(out) is not save_ply:
        save_splat(out, given)
    else:
        write_ply_file(out, layout.header, len(layout.rows), [layout.rows], layout.trailer)
    return len(given), int((completed.generated > 0).sum())


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
        has_labels = bool((removed.generated > 0).any())
        header, values = make_scene_header(removed, has_labels), make_rows(removed, has_labels)
    else:
        held = layout.rows if kept is None else layout.rows[kept.numpy()]
        header, values = layout.header, held[rows.numpy()]
    first, _, end = split_header(header)
    place = f"element place {len(rows)}\nproperty uint row\n".encode()
    trailer = rows.numpy().astype("<u4")
    write_ply_file(path, b"".join([first, place, end]), len(values), [values], trailer)


def reinsert(
    kept: Gaussians, layout: PlyFile | None, path: Path
) -> tuple[Gaussians, PlyFile | None]:
    """Insert the replaced originals of the file `path` at their rows; None if columns differ."""
    source = read_scene(path)
    removed = require_finite(decode_gaussians(source), path, drop_nonfinite=False)
    total, rows = len(kept) + len(removed), np.zeros(0, np.int64)
    if b"element place " in source.header and len(source.trailer) == 4 * len(removed):
        rows = source.trailer.view("<u4").astype(np.int64)
    is_ordered = len(rows) > 0 and bool((np.diff(rows, append=total) > 0).all())
    if not is_ordered or kept.is_antialiased != removed.is_antialiased:
        raise InputError(
            f"{quote_value(path)} does not say where its Gaussians belong in the scene beside it; "
            "fetch both files again."
        )
    taken = torch.zeros(total, dtype=torch.bool)
    taken[torch.from_numpy(rows)] = True
    order = torch.empty(total, dtype=torch.int64)
    order[~taken] = torch.arange(len(kept))
    order[taken] = torch.arange(len(kept), total)
    restored, others = merge([kept, removed])[order], drop_generated(source).rows
    if layout is None or others.dtype != layout.rows.dtype or len(others) != len(removed):
        return restored, None
    joined = np.concatenate([layout.rows, others], dtype=others.dtype)
    return restored, replace(layout, rows=joined[order.numpy()])
