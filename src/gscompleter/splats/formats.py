"""The table of splat formats: read by the first bytes of a file, written by its extension.

The labels of generated Gaussians are a column of a .ply; other formats have a file beside them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64, UInt8
from numpy import ndarray
from torch import Tensor

from gscompleter.errors import InputError, quote_value, refuse_pointer
from gscompleter.io.files import replace_file
from gscompleter.io.json_file import read_json
from gscompleter.io.reading import open_file
from gscompleter.splats.compressed_ply import (
    is_compressed_ply,
    read_compressed_ply,
    write_compressed_ply,
)
from gscompleter.splats.glb import is_glb, read_glb
from gscompleter.splats.ksplat import read_ksplat
from gscompleter.splats.morton import sort_along_morton
from gscompleter.splats.ply import load_ply, require_finite, save_ply
from gscompleter.splats.sog import META, is_sog, read_sog
from gscompleter.splats.splat import read_splat, write_splat
from gscompleter.splats.spz import is_spz, read_spz, write_spz
from gscompleter.types import Gaussians

OPACITY_TOLERANCE = 1e-3
"""Distance from [0, 1] up to which an opacity is clamped instead of refused."""
HEAD_BYTES = 8192
"""Bytes read to detect a format; the header of a compressed .ply fits."""


@dataclass(frozen=True)
class Format:
    """Functions that detect, read and write one file format."""

    extensions: tuple[str, ...]
    recognizes: Callable[[bytes], bool] | None
    """Test on the first bytes of a file, or None if only the extension identifies the format."""
    read: Callable[[Path], Gaussians]
    write: Callable[[Path, Gaussians], None] | None = None
    sort: Callable[[Gaussians], Gaussians] | None = None
    """Sorts Gaussians as the format needs them; None keeps their order."""
    supports_antialiased: bool = False
    """True if the format can mark Gaussians as antialiased."""


FORMATS = {
    "compressed-ply": Format(
        (".compressed.ply",),
        is_compressed_ply,
        read_compressed_ply,
        write_compressed_ply,
        sort_along_morton,
        supports_antialiased=True,
    ),
    "ply": Format(
        (".ply",),
        lambda head: head.startswith(b"ply"),
        load_ply,
        save_ply,
        supports_antialiased=True,
    ),
    "spz": Format((".spz",), is_spz, read_spz, write_spz, supports_antialiased=True),
    "sog": Format((".sog", META), is_sog, read_sog, supports_antialiased=True),
    "glb": Format((".glb",), is_glb, read_glb),
    "splat": Format((".splat",), None, read_splat, write_splat),
    "ksplat": Format((".ksplat",), None, read_ksplat),
}
"""Formats by name, in the order in which they are tried."""


def load_splat(path: Path | str, drop_nonfinite: bool = False) -> Gaussians:
    """Load the Gaussians of a file in any format of `FORMATS`, in the axes of a 3DGS .ply.

    The labels of generated Gaussians are read from a .ply itself, and for other formats from the
    file `NAME.generated.json` beside it.

    Args:
        path: The file, or the folder of a .sog.
        drop_nonfinite: Drop Gaussians with NaN, infinity or a zero quaternion instead of refusing
            the file.

    Raises:
        InputError: The file is missing, empty, truncated or damaged, or its format is unknown.
    """
    path = Path(path)
    format_ = FORMATS[detect_splat_format(path)]
    if format_.read is load_ply:
        return load_ply(path, drop_nonfinite)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite values are refused below
        gaussians = format_.read(path)
    if len(gaussians) == 0:
        raise InputError(f"{quote_value(path)} is empty: it holds no Gaussian.")
    gaussians = validate_ranges(gaussians, path)
    labelled = replace(gaussians, generated=load_labels(path, len(gaussians)))
    return require_finite(labelled, path, drop_nonfinite)


def validate_ranges(gaussians: Gaussians, path: Path) -> Gaussians:
    """Refuse negative scales and invalid opacities, and clamp opacities off by rounding."""
    opacities = gaussians.opacities
    bad = (gaussians.scales < 0).any(1) | ((opacities - 0.5).abs() > 0.5 + OPACITY_TOLERANCE)
    bad &= opacities.isfinite()  # others are refused as non-finite
    if bad.any():
        raise InputError(
            f"{quote_value(path)} has {int(bad.sum()):,} of {len(bad):,} Gaussians with a negative "
            "scale or an opacity outside of [0, 1]; export it again."
        )
    return replace(gaussians, opacities=opacities.clamp(0, 1))


def save_splat(path: Path | str, gaussians: Gaussians) -> None:
    """Write Gaussians in the format given by the extension of `path`.

    A .ply stores everything. Other formats round, and the labels of generated Gaussians go to
    `NAME.generated.json` beside the file.

    Raises:
        InputError: The format is unknown or read-only, there are no Gaussians, or writing fails.
    """
    path = Path(path)
    format_ = get_writable_format(path)
    if len(gaussians) == 0:
        raise InputError(f"There is no Gaussian to write to {quote_value(path)}.")
    if format_.write is save_ply:
        save_ply(path, gaussians)
        return
    assert format_.write is not None
    gaussians = require_finite(gaussians.to("cpu"), path, drop_nonfinite=False)
    if format_.sort is not None:
        gaussians = format_.sort(gaussians)
    format_.write(path, gaussians)
    save_labels(path, gaussians.generated)


def describe_mode_loss(path: Path, gaussians: Gaussians) -> str | None:
    """Describe that the format of `path` cannot mark antialiased Gaussians, or return None."""
    format_ = get_writable_format(path)
    if format_.supports_antialiased or not gaussians.is_antialiased:
        return None
    return (
        f"A {format_.extensions[0]} file cannot mark Gaussians as antialiased: viewers will "
        "render them as classic ones, which makes small ones too opaque."
    )


def note_infinite_opacities(gaussians: Gaussians) -> str | None:
    """Describe the number of infinite opacity logits in a sentence, or return None."""
    logits = None if gaussians.encoded is None else gaussians.encoded[:, 3]
    if logits is None or logits.sum().isfinite():
        return None
    opaque, clear = int(logits.isposinf().sum()), int(logits.isneginf().sum())
    return (
        f"{opaque:,} of {len(gaussians):,} Gaussians have an opacity logit of +infinity and "
        f"{clear:,} of -infinity; they are rendered as opaque and as transparent."
    )


def detect_splat_format(path: Path) -> str:
    """Detect the format of a file or folder, by name."""
    if path.is_dir():
        if (path / META).is_file():
            return "sog"
        raise InputError(
            f"{quote_value(path)} is a folder without {META}; name a file of Gaussians."
        )
    with open_file(path) as file:
        head = file.read(HEAD_BYTES)
    refuse_pointer(path)
    if not head:
        raise InputError(f"{quote_value(path)} is empty; a file of Gaussians is needed.")
    for name, format_ in FORMATS.items():
        if format_.recognizes is not None and format_.recognizes(head):
            return name
    named = _match_extension(path)
    if named is None or FORMATS[named].recognizes is not None:
        known = ", ".join(f"*{ending}" for f in FORMATS.values() for ending in f.extensions)
        raise InputError(
            f"{quote_value(path)} holds no Gaussians in a format that is known: {known}."
        )
    return named


def get_writable_format(path: Path) -> Format:
    """Get the format for the extension of `path`, which must be one that is written."""
    name = _match_extension(path)
    if name is None or FORMATS[name].write is None:
        raise InputError(
            f"{quote_value(path)} cannot be written in the format of its extension; end it in "
            f"{', '.join(f.extensions[0] for f in FORMATS.values() if f.write)}."
        )
    return FORMATS[name]


def _match_extension(path: Path) -> str | None:
    for name, format_ in FORMATS.items():
        if path.name.lower().endswith(format_.extensions):
            return name
    return None


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
    runs = [[label, len(list(run))] for label, run in groupby(generated.tolist())]
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
    return hashlib.sha256(path.read_bytes()).hexdigest()
