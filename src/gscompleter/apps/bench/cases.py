"""Cases to measure, and series of cases that grow from one of them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
from annotated_types import Ge, MinLen
from pydantic import TypeAdapter, ValidationError

from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.errors import InputError, quote_value
from gscompleter.evaluation.methods import Models
from gscompleter.io.json_file import read_json
from gscompleter.splats.ply import save_ply
from gscompleter.state import Completion
from gscompleter.types import Gaussians

Whole = Annotated[int, Ge(0)]
Frames = Annotated[tuple[Whole, ...], MinLen(1)]
Size = tuple[Whole, Whole]
"""Height and width in pixels."""

JITTER = 0.1
"""Offset of a copied Gaussian, in its standard deviations."""


@dataclass(frozen=True)
class BenchCase:
    """One completion to measure. Cases are equal if only their names differ."""

    name: str = field(compare=False)
    scene: Path
    """Folder of the scene."""
    context: Frames
    targets: Frames
    """Target frames, completed in this order."""
    resolution: Size
    near: float | None = None
    """Smallest depth in scene units; None to estimate it. The same holds for `far`."""
    far: float | None = None
    gaussians: Whole | None = None
    """Number of Gaussians of the input splat, or None if the context is reconstructed."""

    @property
    def pixels(self) -> int:
        """Number of pixels of an image."""
        return self.resolution[0] * self.resolution[1]

    def open(self) -> Photographs:
        """Open the scene."""
        return open_photographs(self.scene, near=self.near, far=self.far)

    def begin(self, models: Models, device: str) -> Completion:
        """Reconstruct the context."""
        views = self.open().views(self.context, self.resolution)
        return models.make_completer().begin([view.to(device) for view in views])


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
class GrowthValues:
    """Values along each axis, for the case with a name."""

    case: str
    gaussians: tuple[Whole, ...] = ()
    pixels: tuple[Size, ...] = ()
    views: tuple[Frames, ...] = ()
    targets: tuple[Frames, ...] = ()

    def make_series(self, base: BenchCase) -> dict[str, tuple[BenchCase, ...]]:
        """Vary a case along each axis that has values, and name the results by their sizes."""
        series = {}
        for axis, changed in AXES.items():
            cases = [replace(base, **{changed: value}) for value in getattr(self, axis)]
            names = [f"{base.name}, {get_size(axis, case):,} {axis}" for case in cases]
            series[axis] = tuple(replace(c, name=n) for c, n in zip(cases, names, strict=True))
        return {axis: cases for axis, cases in series.items() if cases}


@dataclass(frozen=True)
class ManifestFile:
    """Content of a file of cases."""

    cases: Annotated[tuple[BenchCase, ...], MinLen(1)]
    growth: GrowthValues | None = None


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


def make_default_series(case: BenchCase) -> dict[str, tuple[BenchCase, ...]]:
    """Make series of doubled sizes from a case with its first target."""
    height, width = case.resolution
    views, targets = make_prefixes(case.context, 2), make_prefixes(case.targets, 1)
    values = GrowthValues(
        case.name,
        GAUSSIANS,
        tuple((round(side * height), round(side * width)) for side in SIDES),
        views if len(views) > 1 else (),
        targets if len(targets) > 1 else (),
    )
    return values.make_series(replace(case, targets=case.targets[:1]))


def make_prefixes(frames: Frames, fewest: int) -> tuple[Frames, ...]:
    """Return the first `fewest` frames, the first twice as many, and so on."""
    counts = [fewest * 2**n for n in range(len(frames).bit_length())]
    return tuple(frames[:count] for count in counts if count <= len(frames))


def read_manifest(path: Path) -> Manifest:
    """Read a manifest from a JSON file; paths are relative to its folder."""
    text = json.dumps(read_json(path, "name a file of cases to measure"))
    try:
        found = TypeAdapter(ManifestFile).validate_json(text, strict=True)
        by_name = {case.name: case for case in found.cases}
        if len(by_name) < len(found.cases):
            raise ValueError("two cases have the same name")
        cases = {
            name: replace(case, scene=path.parent / os.path.expandvars(case.scene))
            for name, case in by_name.items()
        }
        growth = found.growth
        series = {} if growth is None else growth.make_series(cases[growth.case])
    except (ValueError, KeyError) as error:
        wrong = str(error)
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            wrong = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise InputError(
            f"{quote_value(path)} names no cases to measure ({quote_value(wrong)}); it needs "
            "cases, each with name, scene, context, targets and resolution.",
            "cases",
        ) from error
    return Manifest(tuple(cases.values()), series)


def check_frames(cases: Sequence[BenchCase]) -> None:
    """Raise InputError if a scene cannot be opened or lacks a frame."""
    for case in cases:
        photographs = case.open()
        for frame in (*case.context, *case.targets):
            photographs.camera(frame, case.resolution)


def write_input_splat(case: BenchCase, folder: Path, models: Models, device: str) -> Path | None:
    """Write the input splat of a case to `folder` once; None if the context is reconstructed."""
    if case.gaussians is None:
        return None
    path = folder / f"{abs(hash(replace(case, targets=(0,)))):x}.ply"
    if not path.exists():
        context = case.begin(models, device).context
        save_ply(path, multiply_gaussians(context, case.gaussians, models.seed))
    return path


def multiply_gaussians(scene: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """Repeat Gaussians until there are `count`, with offsets and reduced opacities.

    All copies of a Gaussian together have its opacity. If `count` is smaller than the scene, a
    random subset is returned.
    """
    rng = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(scene), generator=rng)
    rows = order.repeat(math.ceil(count / len(scene)))[:count]
    copies = torch.bincount(rows, minlength=len(scene))[rows].to(scene.means)
    repeats = scene[rows.to(scene.means.device)]
    offsets = JITTER * torch.randn(count, 3, generator=rng).to(repeats.means)
    means = repeats.means + offsets * repeats.scales.amin(dim=1, keepdim=True)
    fainter = -torch.expm1(torch.log1p(-repeats.opacities) / copies)
    return replace(repeats, means=means, opacities=fainter, encoded=None)
