"""Gaussians as rows of a .ply, and what differs between two sets of rows.

LichtFeld Studio keeps log scales, logit opacities and unnormalised quaternions wxyz, as a .ply of
3DGS has them, so that rows go to a file and back without a rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

FIRST = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2")
LAST = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
LABEL = "generated"
"""Property with the label of a Gaussian."""
TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "uint8": "u1"}
"""Types of properties that splats have, and those of numpy."""


def list_columns(num_rest: int) -> list[str]:
    """List the properties of a splat with `num_rest` coefficients of harmonics beside the first."""
    return [*FIRST, *(f"f_rest_{number}" for number in range(num_rest)), *LAST]


@dataclass(frozen=True)
class Splat:
    """Hold the rows of a .ply of Gaussians, with their labels and the comments of its head."""

    rows: np.ndarray
    """[n, p] of float32, in the order of `list_columns`."""
    labels: np.ndarray
    """[n] of uint8: `generated`, by which gscompleter says what is invented; 0 if measured."""
    comments: tuple[str, ...] = ()
    """Lines of the head that say who made it."""


def write_splat(path: Path, splat: Splat) -> None:
    """Write Gaussians, with their labels if any differs from 0, as a .ply."""
    columns = list_columns(splat.rows.shape[1] - len(FIRST) - len(LAST))
    dtype = [(name, "<f4") for name in columns]
    lines = ["ply", "format binary_little_endian 1.0", *splat.comments]
    lines += [f"element vertex {len(splat.rows)}"]
    lines += [f"property float {name}" for name in columns]
    if splat.labels.any():
        dtype += [(LABEL, "u1")]
        lines += [f"property uchar {LABEL}"]
    table = np.empty(len(splat.rows), dtype)
    for number, name in enumerate(columns):
        table[name] = splat.rows[:, number]
    if splat.labels.any():
        table[LABEL] = splat.labels
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + table.tobytes())


def read_splat(path: Path) -> Splat:
    """Read Gaussians from a .ply; further properties are left out.

    Raises ValueError for another kind of file.
    """
    content = path.read_bytes()
    head, mark, body = content.partition(b"end_header\n")
    lines = head.decode("utf-8", "replace").splitlines()
    words = [line.split() for line in lines]
    named = [(w[2], TYPES.get(w[1])) for w in words if w[:1] == ["property"] and len(w) == 3]
    elements = [w for w in words if w[:1] == ["element"]]
    is_known = mark and words[:2] == [["ply"], ["format", "binary_little_endian", "1.0"]]
    columns = list_columns(sum(name.startswith("f_rest_") for name, _ in named))
    types = dict(named)
    is_splat = len(elements) == 1 and None not in types.values() and types.keys() >= set(columns)
    if not is_known or not is_splat:
        raise ValueError(f"{path} is not a plain .ply of a splat")
    table = np.frombuffer(body, np.dtype(named), count=int(elements[0][2]))
    rows = np.stack([table[name].astype("<f4") for name in columns], axis=1)
    labels = table[LABEL].astype(np.uint8) if LABEL in types else np.zeros(len(rows), np.uint8)
    comments = tuple(line for line in lines if line.startswith("comment "))
    return Splat(rows, labels, comments)


def widen_harmonics(rows: np.ndarray, num_rest: int) -> np.ndarray:
    """Give rows as many coefficients of harmonics as others have; further ones are zero.

    They are stored channel by channel.
    """
    first, last = len(FIRST), len(LAST)
    own = rows.shape[1] - first - last
    rest = rows[:, first : first + own].reshape(len(rows), 3, own // 3)
    wide = np.zeros((len(rows), 3, num_rest // 3), np.float32)
    wide[:, :, : own // 3] = rest
    parts = [rows[:, :first], wide.reshape(len(rows), num_rest), rows[:, first + own :]]
    return np.concatenate(parts, axis=1)


def compare_rows(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell which rows went and which came, bit for bit: [n] of `before`, and [m] of `after`.

    Equal rows are counted: of two before and one after, one went.
    """
    old, new = number_rows(before, after)
    total = len(old) + len(new)
    keys_old, keys_new = count_repeats(old, total), count_repeats(new, total)
    return ~np.isin(keys_old, keys_new), ~np.isin(keys_new, keys_old)


def look_up_labels(rows: np.ndarray, known: Splat) -> np.ndarray:
    """Return the labels [n] that rows have in a file; 0 for those that it does not have."""
    old, new = number_rows(known.rows, rows)
    labels = np.zeros(len(old) + len(new), np.uint8)
    labels[old] = known.labels
    return labels[new]


def number_rows(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give equal rows of both the same number, bit for bit."""
    both = np.ascontiguousarray(np.concatenate([first, second]), "<f4")
    whole = both.view(np.dtype((np.void, both.shape[1] * 4)))[:, 0]
    numbers = np.unique(whole, return_inverse=True)[1].reshape(-1)
    return numbers[: len(first)], numbers[len(first) :]


def count_repeats(numbers: np.ndarray, limit: int) -> np.ndarray:
    """Make numbers different: the first of equal ones, the second, and so on."""
    order = np.argsort(numbers, kind="stable")
    ordered = numbers[order]
    starts = np.flatnonzero(np.r_[True, ordered[1:] != ordered[:-1]])
    sizes = np.diff(np.r_[starts, len(ordered)])
    repeat = np.empty(len(numbers), np.int64)
    repeat[order] = np.arange(len(ordered)) - np.repeat(starts, sizes)
    return numbers.astype(np.int64) * (limit + 1) + repeat
