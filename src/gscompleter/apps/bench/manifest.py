"""Cases to measure, and series of cases that grow from one of them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gscompleter.data.formats import open_photographs
from gscompleter.errors import InputError, quote_value
from gscompleter.io.json_file import read_json


@dataclass(frozen=True)
class BenchCase:
    """One completion to measure."""

    name: str
    scene: Path
    """Folder of the scene."""
    context: tuple[int, ...]
    targets: tuple[int, ...]
    """Target frames, completed in this order."""
    resolution: tuple[int, int]
    """Height and width in pixels."""
    near: float | None = None
    """Smallest depth in scene units; None to estimate it. The same holds for `far`."""
    far: float | None = None
    gaussians: int | None = None
    """Number of Gaussians of the input splat, or None if the context is reconstructed."""

    @property
    def pixels(self) -> int:
        """Number of pixels of an image."""
        return self.resolution[0] * self.resolution[1]


AXES: dict[str, str] = {
    "gaussians": "gaussians",
    "pixels": "resolution",
    "views": "context",
    "targets": "targets",
}
"""Axes of growth, with the field of a case that each one changes."""

GAUSSIANS = (250_000, 500_000, 1_000_000, 2_000_000)
"""Default numbers of Gaussians of the input splats."""
SIDES = (0.5, 0.5**0.5, 1.0, 2**0.5, 2.0)
"""Default sides of the images, as multiples of the sides of the case."""


@dataclass(frozen=True)
class Manifest:
    """All cases to measure."""

    cases: tuple[BenchCase, ...]
    """The first one is also used to compare methods."""
    growth: Mapping[str, tuple[BenchCase, ...]] = field(default_factory=dict)
    """Cases by axis, which differ only in its field."""


def get_size(axis: str, case: BenchCase) -> int:
    """Return the size of a case along an axis."""
    if axis == "pixels":
        return case.pixels
    value = getattr(case, AXES[axis])
    return value if isinstance(value, int) else len(value)


def make_series(case: BenchCase) -> dict[str, tuple[BenchCase, ...]]:
    """Make the default series of a case, with its first target, from doubled sizes."""
    height, width = case.resolution
    sides = [(round(s * height), round(s * width)) for s in SIDES]
    values: dict[str, Sequence[Any]] = {
        "gaussians": GAUSSIANS,
        "pixels": sides,
        "views": make_prefixes(case.context, 2),
        "targets": make_prefixes(case.targets, 1),
    }
    base = replace(case, targets=case.targets[:1])
    return {axis: vary_case(base, axis, found) for axis, found in values.items() if len(found) > 1}


def make_prefixes(frames: tuple[int, ...], fewest: int) -> list[tuple[int, ...]]:
    """Return the first `fewest` frames, the first twice as many, and so on."""
    counts = [fewest * 2**n for n in range(len(frames).bit_length())]
    return [frames[:count] for count in counts if count <= len(frames)]


def vary_case(case: BenchCase, axis: str, values: Sequence[Any]) -> tuple[BenchCase, ...]:
    """Vary a case along an axis, and name the results by their sizes."""
    cases = [replace(case, **{AXES[axis]: value}) for value in values]
    return tuple(replace(c, name=f"{case.name}, {get_size(axis, c):,} {axis}") for c in cases)


def read_manifest(path: Path) -> Manifest:
    """Read a manifest from a JSON file; paths are relative to its folder."""
    content = read_json(path, "name a file of cases to measure")
    try:
        cases = tuple(_parse_case(row, path.parent) for row in content["cases"])
        by_name = {case.name: case for case in cases}
        if not cases or len(by_name) < len(cases):
            raise ValueError("there is no case, or two have the same name")
        return Manifest(cases, _parse_growth(content.get("growth"), by_name))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{quote_value(path)} names no cases to measure ({type(error).__name__}: "
            f"{quote_value(str(error))}); it needs cases, each with name, scene, context, targets "
            "and "
            "resolution.",
            "cases",
        ) from error


def check_frames(cases: Sequence[BenchCase]) -> None:
    """Raise InputError if a scene cannot be opened or lacks a frame."""
    for case in cases:
        photographs = open_photographs(case.scene, near=case.near, far=case.far)
        for frame in (*case.context, *case.targets):
            photographs.camera(frame, case.resolution)


def _parse_growth(content: Any, cases: Mapping[str, BenchCase]) -> dict[str, tuple[BenchCase, ...]]:
    if content is None:
        return {}
    base = cases[content["case"]]
    read = {
        "gaussians": _parse_int,
        "pixels": _parse_size,
        "views": _parse_frames,
        "targets": _parse_frames,
    }
    return {
        axis: vary_case(base, axis, [of(value) for value in content[axis]])
        for axis, of in read.items()
        if axis in content
    }


def _parse_case(row: Any, folder: Path) -> BenchCase:
    return BenchCase(
        str(row["name"]),
        folder / os.path.expandvars(row["scene"]),
        _parse_frames(row["context"]),
        _parse_frames(row["targets"]),
        _parse_size(row["resolution"]),
        None if row.get("near") is None else float(row["near"]),
        None if row.get("far") is None else float(row["far"]),
        None if row.get("gaussians") is None else _parse_int(row["gaussians"]),
    )


def _parse_frames(value: Any) -> tuple[int, ...]:
    if not value:
        raise ValueError("no frames")
    return tuple(map(_parse_int, value))


def _parse_size(value: Any) -> tuple[int, int]:
    height, width = map(_parse_int, value)
    return height, width


def _parse_int(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise TypeError(f"{quote_value(value)} is no whole number")
    return value
