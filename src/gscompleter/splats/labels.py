"""Labels of generated Gaussians, in a file beside formats that cannot store them.

`scene.spz.generated.json` stores the labels of `scene.spz` as runs `[label, count]`, and the
sha256 of the file that they belong to, because another tool may have changed it since.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64, UInt8
from numpy import ndarray
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.io.files import replace_file
from gscompleter.io.json_file import read_json


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
