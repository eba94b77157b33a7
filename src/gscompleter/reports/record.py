"""Data of `report.json`: what a report shows besides the summary and the images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from gscompleter.metrics.coverage import Look, covered
from gscompleter.types import Camera, Completion, DepthPairs, Gaussians, TargetCompletion

NAME = "report.json"
MAX_PHOTOGRAPHS = 200
MAX_POINTS = 600
"""Largest number of points to keep, of the context and of the added Gaussians each."""
MAX_LOOKS = 6
OPAQUE = 0.3
NOTICEABLE = 0.002
"""Smallest mean colour difference, in [0, 1], of a changed image."""

Limits = tuple[float, float]
"""z-depths at the ends of the colours, in scene units."""


@dataclass(frozen=True)
class Pose:
    """Pose and field of view of a camera, in the frame of the .ply."""

    c2w: tuple[tuple[float, ...], ...]
    opening: tuple[float, float]
    """Tangents of half the field of view, horizontally and vertically."""


@dataclass(frozen=True)
class Pairs:
    """Depth pairs of the alignment, in scene units."""

    seen_from: Literal["anchor", "target"]
    predicted: tuple[float, ...]
    context: tuple[float, ...]
    agrees: tuple[bool, ...]


@dataclass(frozen=True)
class TargetRecord:
    """Data of a target."""

    camera: Pose
    depth_limits: Limits | None
    losses: Mapping[str, tuple[float, ...]]
    pairs: Pairs | None


@dataclass(frozen=True)
class LookRecord:
    """Covered fractions of a surrounding view."""

    before: float
    after: float


@dataclass(frozen=True)
class Points:
    """Surface points of the scene, in the frame of the .ply."""

    means: tuple[tuple[float, float, float], ...]
    added: tuple[bool, ...]


@dataclass(frozen=True)
class Record:
    """All of `report.json`."""

    context: tuple[Pose, ...]
    photographs: tuple[Pose, ...]
    num_photographs: int
    targets: tuple[TargetRecord, ...]
    around: tuple[LookRecord, ...]
    points: Points


def record_of(
    completion: Completion,
    limits: Sequence[Limits | None],
    around: Sequence[Look],
    photographs: Sequence[Camera],
) -> Record:
    """Collect the data of a completion."""
    targets = zip(completion.targets, limits, strict=True)
    return Record(
        context=tuple(pose_of(view.camera) for view in completion.views),
        photographs=tuple(pose_of(camera) for camera in spread(photographs, MAX_PHOTOGRAPHS)),
        num_photographs=len(photographs),
        targets=tuple(target_record(result, ends) for result, ends in targets),
        around=tuple(LookRecord(covered([k.before]), covered([k.after])) for k in around),
        points=points_of(completion),
    )


def target_record(result: TargetCompletion, limits: Limits | None) -> TargetRecord:
    """Collect the data of a target."""
    losses = {name: rounded(torch.tensor(values)) for name, values in result.losses.items()}
    pairs = None if result.pairs is None else pairs_record(result.pairs)
    return TargetRecord(pose_of(result.target), limits, losses, pairs)


def pairs_record(pairs: DepthPairs) -> Pairs:
    """Round the depth pairs to six digits."""
    agrees = tuple(pairs.agrees.tolist())
    return Pairs(pairs.seen_from, rounded(pairs.predicted), rounded(pairs.context), agrees)


def pose_of(camera: Camera) -> Pose:
    """Convert a camera to its pose and field of view."""
    focal_x, focal_y = camera.K[0, 0].item(), camera.K[1, 1].item()
    values = rounded(camera.c2w[:3].flatten())
    rows = tuple(values[k : k + 4] for k in (0, 4, 8))
    return Pose(rows, (camera.width / focal_x / 2, camera.height / focal_y / 2))


def points_of(completion: Completion) -> Points:
    """Sample surface points of the context and of the added Gaussians."""
    parts = [places(completion.context), places(completion.added)]
    means = tuple((x, y, z) for part in parts for x, y, z in part)
    added = tuple(number == 1 for number, part in enumerate(parts) for _ in part)
    return Points(means, added)


def places(gaussians: Gaussians) -> list[tuple[float, ...]]:
    """Sample means of opaque Gaussians."""
    opaque = gaussians.means[gaussians.opacities >= OPAQUE]
    order = torch.randperm(len(opaque), generator=torch.Generator().manual_seed(0))
    chosen = opaque[order[:MAX_POINTS].to(opaque.device)]
    values = rounded(chosen.flatten())
    return [values[k : k + 3] for k in range(0, len(values), 3)]


def most_changed(looks: Sequence[Look]) -> list[Look]:
    """Select the views whose images changed most, in descending order."""
    changes = [(look.after.image - look.before.image).abs().mean().item() for look in looks]
    order = sorted(range(len(looks)), key=changes.__getitem__, reverse=True)
    return [looks[i] for i in order[:MAX_LOOKS] if changes[i] >= NOTICEABLE]


def spread(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Take every n-th item so that at most `most` are left."""
    return items[:: max(1, -(-len(items) // most))]


def as_json(record: Record) -> str:
    """Serialize the record."""
    return json.dumps(record, default=vars, separators=(",", ":")) + "\n"


def write_record(folder: Path, record: Record) -> None:
    """Write `report.json`."""
    (folder / NAME).write_text(as_json(record))


def rounded(values: Tensor) -> tuple[float, ...]:
    """Round numbers [n] to six significant digits."""
    return tuple(float(f"{value:.6g}") for value in values.detach().cpu().double().tolist())
