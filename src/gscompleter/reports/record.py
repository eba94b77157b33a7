"""`report.json`: what a report shows of a completion besides its summary and its images."""

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
"""The file in the output folder."""
MAX_PHOTOGRAPHS = 200
"""Cameras of photographs that are kept at most."""
MAX_POINTS = 600
"""Places of Gaussians that are kept at most, of the context and of what was added each."""
MAX_LOOKS = 6
"""Cameras around the photographs whose images are kept at most: those that change most."""
OPAQUE = 0.3
"""Opacity from which on a Gaussian counts as a place on a surface."""
NOTICEABLE = 0.002
"""Least mean difference of colour, in [0, 1], of an image that changed."""

Limits = tuple[float, float]
"""z-depth at both ends of the colours, in scene units."""


@dataclass(frozen=True)
class Pose:
    """Where a camera stands and what it looks at, in the frame of the .ply."""

    c2w: tuple[tuple[float, ...], ...]
    """Camera to world, three rows of four."""
    opening: tuple[float, float]
    """Tangents of half of the opening angles, across and down."""


@dataclass(frozen=True)
class Pairs:
    """Depths that were compared for the affine, in scene units."""

    seen_from: Literal["anchor", "target"]
    predicted: tuple[float, ...]
    context: tuple[float, ...]
    agrees: tuple[bool, ...]


@dataclass(frozen=True)
class TargetRecord:
    """What was kept of a target."""

    camera: Pose
    depth_limits: Limits | None
    """Of the pictures of depth; None where the target sees none."""
    losses: Mapping[str, tuple[float, ...]]
    """By optimisation, the loss of each iteration."""
    pairs: Pairs | None


@dataclass(frozen=True)
class LookRecord:
    """How much a camera around the photographs sees covered, as shares of its image."""

    before: float
    after: float


@dataclass(frozen=True)
class Points:
    """Places on surfaces of the scene, in the frame of the .ply."""

    means: tuple[tuple[float, float, float], ...]
    added: tuple[bool, ...]
    """Whether a target added it."""


@dataclass(frozen=True)
class Record:
    """All of `report.json`."""

    context: tuple[Pose, ...]
    photographs: tuple[Pose, ...]
    """Of the scene, evenly drawn from all."""
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
    """What is kept of a completion.

    Args:
        completion: What was done.
        limits: For each target, the ends of the colours of its pictures of depth.
        around: What the cameras whose images are kept saw.
        photographs: The cameras of all photographs, in the frame of the result.
    """
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
    """What is kept of a target."""
    losses = {name: rounded(torch.tensor(values)) for name, values in result.losses.items()}
    pairs = None if result.pairs is None else pairs_record(result.pairs)
    return TargetRecord(pose_of(result.target), limits, losses, pairs)


def pairs_record(pairs: DepthPairs) -> Pairs:
    """Compared depths as numbers of six digits."""
    agrees = tuple(pairs.agrees.tolist())
    return Pairs(pairs.seen_from, rounded(pairs.predicted), rounded(pairs.context), agrees)


def pose_of(camera: Camera) -> Pose:
    """Where a camera stands, and how wide it sees."""
    focal_x, focal_y = camera.K[0, 0].item(), camera.K[1, 1].item()
    values = rounded(camera.c2w[:3].flatten())
    rows = tuple(values[k : k + 4] for k in (0, 4, 8))
    return Pose(rows, (camera.width / focal_x / 2, camera.height / focal_y / 2))


def points_of(completion: Completion) -> Points:
    """Some places on the surfaces of the context and of what was added."""
    parts = [places(completion.context), places(completion.added)]
    means = tuple((x, y, z) for part in parts for x, y, z in part)
    added = tuple(number == 1 for number, part in enumerate(parts) for _ in part)
    return Points(means, added)


def places(gaussians: Gaussians) -> list[tuple[float, ...]]:
    """Where some of the opaque ones of `gaussians` lie."""
    opaque = gaussians.means[gaussians.opacities >= OPAQUE]
    order = torch.randperm(len(opaque), generator=torch.Generator().manual_seed(0))
    chosen = opaque[order[:MAX_POINTS].to(opaque.device)]
    values = rounded(chosen.flatten())
    return [values[k : k + 3] for k in range(0, len(values), 3)]


def most_changed(looks: Sequence[Look]) -> list[Look]:
    """Those looks whose images changed most, the most changed first, if they changed at all."""
    changes = [(look.after.image - look.before.image).abs().mean().item() for look in looks]
    order = sorted(range(len(looks)), key=changes.__getitem__, reverse=True)
    return [looks[i] for i in order[:MAX_LOOKS] if changes[i] >= NOTICEABLE]


def spread(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Every n-th of `items`, at most `most` of them."""
    return items[:: max(1, -(-len(items) // most))]


def as_json(record: Record) -> str:
    """The content of the file."""
    return json.dumps(record, default=vars, separators=(",", ":")) + "\n"


def write_record(folder: Path, record: Record) -> None:
    """Write `report.json` into a folder that nobody reads yet."""
    (folder / NAME).write_text(as_json(record))


def rounded(values: Tensor) -> tuple[float, ...]:
    """Numbers [n] of six significant digits."""
    return tuple(float(f"{value:.6g}") for value in values.detach().cpu().double().tolist())
