"""Cases to measure, and series of cases that grow from one of them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
from annotated_types import Ge, MinLen
from pydantic import ConfigDict, TypeAdapter

from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.scene import write_cameras
from gscompleter.evaluation.methods import Models
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import write_image
from gscompleter.system.files.reading import read_json
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
    context: Frames
    targets: Frames
    """Target frames, completed in this order."""
    resolution: Size
    near: float | None = None
    """Smallest depth in scene units; None to estimate it. The same holds for `far`."""
    far: float | None = None
    gaussians: Whole | None = None
    """Number of Gaussians of the input splat, or None if the context is reconstructed."""
    splat: Path | None = None
    """A trained splat, a .ply, of which the input splat is a copy; None for the reconstruction."""

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

    def complete(self, models: Models, device: str, splat: Path | None) -> Completion:
        """Complete the photographs, or the given splat, for all targets."""
        photographs = self.open()
        views = [view.to(device) for view in photographs.views(self.context, self.resolution)]
        targets = [photographs.camera(frame, self.resolution).to(device) for frame in self.targets]
        scene = None if splat is None else load_ply(splat).to(device)
        return models.make_completer()(views, targets, scene)


Series = dict[str, dict[int, BenchCase]]
"""Cases by axis and size, which differ only in the field of the axis."""
AXES = {"gaussians": "gaussians", "pixels": "resolution", "views": "context", "targets": "targets"}
"""Axes of growth, with the field of a case that each one changes."""


@dataclass(frozen=True)
class GrowthValues:
    """Values along each axis."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    gaussians: tuple[Whole, ...] = ()
    pixels: tuple[Size, ...] = ()
    views: tuple[Frames, ...] = ()
    targets: tuple[Frames, ...] = ()


@dataclass(frozen=True)
class Manifest:
    """All cases to measure, of which the first one also grows."""

    cases: Annotated[tuple[BenchCase, ...], MinLen(1)]
    growth: GrowthValues = GrowthValues()

    def make_series(self, axes: Sequence[str]) -> Series:
        """Vary the first case, with its first target, along each of `axes`."""
        base = replace(self.cases[0], targets=self.cases[0].targets[:1])
        series: Series = {}
        for axis in axes:
            cases = [replace(base, **{AXES[axis]: value}) for value in getattr(self.growth, axis)]
            if cases:
                series[axis] = {get_size(axis, case): case for case in cases}
        return series


def get_size(axis: str, case: BenchCase) -> int:
    """Return the size of a case along an axis."""
    if axis == "pixels":
        return case.pixels
    value = getattr(case, AXES[axis])
    return value if isinstance(value, int) else len(value)


def read_manifest(path: Path) -> Manifest:
    """Read a manifest from a JSON file; paths are relative to its folder."""
    # As JSON, in which strict validation takes lists for tuples.
    text = json.dumps(read_json(path, "name a file of cases to measure"))
    try:
        manifest = TypeAdapter(Manifest).validate_json(text, strict=True)
    except ValueError as error:
        raise InputError(
            f"{quote_value(path)} names no cases to measure ({quote_value(str(error))}); it needs "
            "cases, each with name, scene, context, targets and resolution.",
            "cases",
        ) from error

    def find(name: Path) -> Path:
        # Scenes of the project's own cases lie in the folder that GSCOMPLETER_DATA names.
        return path.parent / os.path.expandvars(name)

    cases = [
        replace(case, scene=find(case.scene), splat=case.splat and find(case.splat))
        for case in manifest.cases
    ]
    return replace(manifest, cases=tuple(cases))


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
    # Equal cases share a file within this process, whose hashes the name is made of.
    path = folder / f"{abs(hash(case)):x}.ply"
    if not path.exists():
        scene = case.begin(models, device).context if case.splat is None else load_ply(case.splat)
        save_ply(path, multiply_gaussians(scene, case.gaussians, models.seed))
    return path


def copy_photographs(case: BenchCase, folder: Path) -> BenchCase:
    """Copy the photographs of a case to `folder`, as those of an owner who has no others.

    Others of its scene would check the splat, whatever the number of those that are named.
    """
    photographs = case.open()
    frames = sorted({*case.context, *case.targets})
    scene = folder / "photographs"
    scene.mkdir(parents=True, exist_ok=True)
    views = [photographs.views([frame], None)[0] for frame in frames]
    # Photographs are numbered in the order of their names.
    names = [f"{frame:04d}.png" for frame in frames]
    for name, view in zip(names, views, strict=True):
        write_image(scene / name, view.image)
    write_cameras(scene / "transforms.json", [view.camera for view in views], names)
    numbers = {frame: number for number, frame in enumerate(frames)}
    return replace(
        case,
        scene=scene,
        context=tuple(numbers[frame] for frame in case.context),
        targets=tuple(numbers[frame] for frame in case.targets),
    )


def multiply_gaussians(scene: Gaussians, count: int, seed: int = 0) -> Gaussians:
    """Repeat Gaussians until there are `count`, with offsets and reduced opacities.

    All copies of a Gaussian together have its opacity. If `count` is smaller than the scene, a
    random subset is returned.
    """
    # Whole rounds through a random order, so that the numbers of copies differ by one at most.
    rng = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(scene), generator=rng)
    rows = order.repeat(math.ceil(count / len(scene)))[:count]
    copies = torch.bincount(rows, minlength=len(scene))[rows].to(scene.means)
    repeats = scene[rows.to(scene.means.device)]

    # Copies at one place would be sorted and blended as no real splat is. The smallest standard
    # deviation keeps them on their surface.
    offsets = JITTER * torch.randn(count, 3, generator=rng).to(repeats.means)
    means = repeats.means + offsets * repeats.scales.amin(dim=1, keepdim=True)

    # n copies of opacity b let through (1 - b)^n, which has to be 1 - a: b = 1 - (1 - a)^(1 / n).
    fainter = -torch.expm1(torch.log1p(-repeats.opacities) / copies)
    return replace(repeats, means=means, opacities=fainter, encoded=None)
