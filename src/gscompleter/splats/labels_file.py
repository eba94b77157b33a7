"""The file beside a splat with what its format has no place for: labels, and who made it.

`NAME.generated.json` is JSON: `sha256` of the splat, the labels of its Gaussians in run lengths
(`generated`), and the record of the runs that made it (`provenance`).
"""

from __future__ import annotations

import contextlib
import json
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from gscompleter.splats.provenance import KEY, NOTHING_KNOWN, Provenance
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import hash_file, read_json
from gscompleter.system.files.writing import replace_file

LABELS_ADVICE = "remove it to go on without labels"


def get_labels_path(path: Path) -> Path:
    """Get the path of the labels file for a splat file."""
    return path.with_name(f"{path.name}.generated.json")


def save_labels(
    path: Path, generated: UInt8[Tensor, "n"], made_by: Provenance = NOTHING_KNOWN
) -> None:
    """Write the labels of the splat at `path` beside it, with who made it unless it says so itself.

    The file is removed if nothing was generated and nobody is known to have made the splat.
    """
    place = get_labels_path(path)
    is_needed = bool((generated > 0).any() or made_by.runs)
    # What a link names lies elsewhere, and stays.
    if not is_needed or place.is_symlink():
        with contextlib.suppress(FileNotFoundError):
            place.unlink()
    if not is_needed:
        return
    # Run lengths, as labels come in long runs; the digest ties them to this very file.
    runs = [[label, len(list(run))] for label, run in groupby(generated.tolist())]
    with replace_file(place) as file:
        table: dict[str, Any] = {"sha256": hash_file(path), "generated": runs}
        if made_by.runs:
            table[KEY] = made_by.to_json()
        file.write(json.dumps(table).encode())


def load_labels(path: Path, count: int) -> UInt8[Tensor, "n"]:
    """Load the labels of the `count` Gaussians in the splat at `path`; zeros if there are none."""
    place = get_labels_path(path)
    if not path.is_file() or not place.exists():
        return torch.zeros(count, dtype=torch.uint8)
    table = read_json(place, LABELS_ADVICE)
    try:
        runs = np.array(table["generated"], dtype=np.int64).reshape(-1, 2)
        in_range = bool(((runs >= 0) & (runs <= [255, count])).all())
        fits = in_range and runs[:, 1].sum() == count and table["sha256"] == hash_file(path)
    except (KeyError, TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise make_labels_error(path)
    return torch.from_numpy(np.repeat(runs[:, 0].astype(np.uint8), runs[:, 1]))


def load_record(path: Path) -> object:
    """Load the record of the splat at `path` from beside it, as values of JSON; None if none."""
    place = get_labels_path(path)
    if not place.is_file():
        return None
    table = read_json(place, LABELS_ADVICE)
    if not isinstance(table, dict):
        raise make_labels_error(path)
    return table.get(KEY)


def make_labels_error(path: Path) -> InputError:
    """Make the error of a labels file that is not of the splat at `path`, or damaged."""
    return InputError(
        f"{quote_value(get_labels_path(path))} does not hold the labels of "
        f"{quote_value(path.name)}; remove it to go on without them."
    )
