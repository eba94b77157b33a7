"""Pruned Gaussians, stored with their row numbers in the input scene.

`pruned_mask.ply` is a 3DGS .ply with a further element `place` that has one property `uint row`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int, Int64, UInt8
from numpy import ndarray
from torch import Tensor

from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import replace_file
from gscompleter.io.json_file import read_json
from gscompleter.splats.layout import find_layout, write_layout
from gscompleter.splats.ply import load_ply, read_header, save_ply
from gscompleter.types import Gaussians, merge

REMOVED_FILE = "removed.ply"
"""Name of the file, beside the completed scene."""


def save_removed(
    path: Path,
    removed: Gaussians,
    rows: Int[Tensor, "n"],
    given: Path | None = None,
    kept: Bool[Tensor, "m"] | None = None,
) -> None:
    """Write pruned Gaussians with their ascending row numbers in the input scene.

    The rows of a binary .ply `given` are copied with all of their properties. `kept` marks the rows
    of
    `given` that the scene has; None for all.
    """
    layout = find_layout(given)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / REMOVED_FILE
        if layout is None:
            save_ply(plain, removed)
        else:
            all_rows = layout.rows if kept is None else layout.rows[kept.numpy()]
            write_layout(plain, replace(layout, rows=all_rows[rows.numpy()], trailer=b""))
        head, end, vertices = plain.read_bytes().partition(b"end_header\n")
    place = f"element place {len(rows)}\nproperty uint row\n".encode()
    with replace_file(path) as file:
        file.write(head + place + end + vertices)
        file.write(rows.numpy().astype("<u4").tobytes())


def load_removed(path: Path) -> tuple[Gaussians, Int[Tensor, "n"]]:
    """Load pruned Gaussians and their row numbers in the input scene."""
    removed = load_ply(path)
    with path.open("rb") as file:
        _, (vertex, *others) = read_header(file, path)
        layout = [(e.name, e.count, [(p.name, p.kind) for p in e.properties]) for e in others]
        if layout != [("place", len(removed), [("row", "u4")])]:
            raise InputError(
                f"{quote_value(path)} does not say where its Gaussians belong in the scene; "
                "without it "
                "they cannot be put back in order."
            )
        file.seek(vertex.count * vertex.dtype("<").itemsize, 1)
        rows = np.frombuffer(file.read(), "<u4")
    if len(rows) != len(removed) or (np.diff(rows.astype(np.int64)) <= 0).any():
        raise InputError(
            f"{quote_value(path)} is damaged: its rows do not ascend; fetch the file again."
        )
    return removed, torch.from_numpy(rows.astype(np.int64))


def reinsert(kept: Gaussians, removed: Gaussians, rows: Int[Tensor, "n"], path: Path) -> Gaussians:
    """Insert pruned Gaussians at their rows; `path` names their file in errors."""
    total = len(kept) + len(removed)
    if len(rows) and int(rows.max()) >= total:
        raise InputError(
            f"{quote_value(path)} belongs to another scene: it names row {int(rows.max()):,} of "
            "one "
            f"that has {total:,} Gaussians."
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


def get_labels_path(path: Path) -> Path:
    """Get the path of the labels file for a splat file."""
    return path.with_name(f"{path.name}.generated.json")


def save_labels(path: Path, generated: UInt8[Tensor, "n"]) -> None:
    """Write the labels of the file at `path` beside it; remove them if nothing was generated."""
    place = get_labels_path(path)
    if not (generated > 0).any():
        with contextlib.suppress(FileNotFoundError):
            place.unlink()
        return
    labels = generated.numpy()
    starts = np.flatnonzero(np.diff(labels, prepend=labels[0] ^ 1))
    counts = np.diff(starts, append=len(labels))
    runs = [[int(labels[s]), int(c)] for s, c in zip(starts, counts, strict=True)]
    with replace_file(place) as file:
        file.write(json.dumps({"sha256": _hash_file(path), "generated": runs}).encode())


def load_labels(path: Path, count: int) -> UInt8[Tensor, "n"]:
    """Load the labels of the `count` Gaussians in the file at `path`; zeros if there are none."""
    place = get_labels_path(path)
    if not path.is_file() or not place.exists():
        return torch.zeros(count, dtype=torch.uint8)
    table = read_json(place, "remove it to go on without labels")
    try:
        runs = np.array(table["generated"], dtype=np.int64).reshape(-1, 2)
        fits = table["sha256"] == _hash_file(path) and _is_complete(runs, count)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{place} holds no labels; remove it to go on without them.") from error
    if not fits:
        raise InputError(
            f"{place} holds the labels of another state of {path.name}; remove it to go on "
            "without them."
        )
    return torch.from_numpy(np.repeat(runs[:, 0].astype(np.uint8), runs[:, 1]))


def _is_complete(runs: Int64[ndarray, "m 2"], count: int) -> bool:
    """Return True if the runs are valid labels of exactly `count` Gaussians."""
    in_range = ((runs >= 0) & (runs <= [255, count])).all()
    return bool(in_range) and sum(runs[:, 1].tolist()) == count


def _hash_file(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
