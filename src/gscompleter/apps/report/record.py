"""Data of `report.json`: what a report shows besides the summary and the images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from gscompleter.evaluation.metrics.coverage import RenderPair, compute_covered_share
from gscompleter.state import Completion, TargetResult
from gscompleter.types import Camera, DepthPairs, Gaussians

RECORD_FILE = "report.json"
MAX_PHOTOGRAPHS = 200
MAX_POINTS = 600
"""Largest number of points to keep, of the context and of the added Gaussians each."""
MAX_SURROUNDING_VIEWS = 6
MIN_SURFACE_OPACITY = 0.3
MIN_COLOR_CHANGE = 0.002
"""Smallest mean colour difference, in [0, 1], of a changed image."""

Limits = tuple[float, float]
"""z-depths at the ends of the colours, in scene units."""


@dataclass(frozen=True)
class ReportPose:
    """Pose and field of view of a camera, in the frame of the .ply."""

    c2w: tuple[tuple[float, ...], ...]
    opening: tuple[float, float]
    """Tangents of half the field of view, horizontally and vertically."""


@dataclass(frozen=True)
class DepthPairRecord:
    """Depth pairs of the alignment, in scene units."""

    seen_from: Literal["anchor", "target"]
    predicted: tuple[float, ...]
    context: tuple[float, ...]
    agrees: tuple[bool, ...]


@dataclass(frozen=True)
class TargetRecord:
    """Data of a target."""

    camera: ReportPose
    depth_limits: Limits | None
    losses: Mapping[str, tuple[float, ...]]
    pairs: DepthPairRecord | None


@dataclass(frozen=True)
class ViewCoverage:
    """Covered fractions of a surrounding view."""

    before: float
    after: float


@dataclass(frozen=True)
class PointRecord:
    """Surface points of the scene, in the frame of the .ply."""

    means: tuple[tuple[float, float, float], ...]
    added: tuple[bool, ...]


@dataclass(frozen=True)
class ReportRecord:
    """All of `report.json`."""

    context: tuple[ReportPose, ...]
    photographs: tuple[ReportPose, ...]
    num_photographs: int
    targets: tuple[TargetRecord, ...]
    around: tuple[ViewCoverage, ...]
    points: PointRecord


def make_record(
    completion: Completion,
    limits: Sequence[Limits | None],
    around: Sequence[RenderPair],
    photographs: Sequence[Camera],
) -> ReportRecord:
    """Collect the data of a completion."""
    targets = zip(completion.targets, limits, strict=True)
    return ReportRecord(
        context=tuple(make_camera_pose(view.camera) for view in completion.views),
        photographs=tuple(
            make_camera_pose(camera) for camera in thin_evenly(photographs, MAX_PHOTOGRAPHS)
        ),
        num_photographs=len(photographs),
        targets=tuple(make_target_record(result, ends) for result, ends in targets),
        around=tuple(
            ViewCoverage(compute_covered_share([k.before]), compute_covered_share([k.after]))
            for k in around
        ),
        points=sample_points(completion),
    )


def make_target_record(result: TargetResult, limits: Limits | None) -> TargetRecord:
    """Collect the data of a target."""
    losses = {name: round_values(torch.tensor(values)) for name, values in result.losses.items()}
    compared = result.affine.pairs
    pairs = make_pairs_record(compared) if len(compared.predicted) else None
    return TargetRecord(make_camera_pose(result.target), limits, losses, pairs)


def make_pairs_record(pairs: DepthPairs) -> DepthPairRecord:
    """Round the depth pairs to six digits."""
    agrees = tuple(pairs.inlier_mask.tolist())
    return DepthPairRecord(
        pairs.fit_view, round_values(pairs.predicted), round_values(pairs.context), agrees
    )


def make_camera_pose(camera: Camera) -> ReportPose:
    """Convert a camera to its pose and field of view."""
    focal_x, focal_y = camera.K[0, 0].item(), camera.K[1, 1].item()
    values = round_values(camera.c2w[:3].flatten())
    rows = tuple(values[k : k + 4] for k in (0, 4, 8))
    return ReportPose(rows, (camera.width / focal_x / 2, camera.height / focal_y / 2))


def sample_points(completion: Completion) -> PointRecord:
    """Sample surface points of the context and of the added Gaussians."""
    parts = [sample_means(completion.context), sample_means(completion.added)]
    means = tuple((x, y, z) for part in parts for x, y, z in part)
    added = tuple(number == 1 for number, part in enumerate(parts) for _ in part)
    return PointRecord(means, added)


def sample_means(gaussians: Gaussians) -> list[tuple[float, ...]]:
    """Sample means of opaque Gaussians."""
    opaque = gaussians.means[gaussians.opacities >= MIN_SURFACE_OPACITY]
    order = torch.randperm(len(opaque), generator=torch.Generator().manual_seed(0))
    chosen = opaque[order[:MAX_POINTS].to(opaque.device)]
    values = round_values(chosen.flatten())
    return [values[k : k + 3] for k in range(0, len(values), 3)]


def select_most_changed(looks: Sequence[RenderPair]) -> list[RenderPair]:
    """Select the views whose images changed most, in descending order."""
    changes = [(look.after.image - look.before.image).abs().mean().item() for look in looks]
    order = sorted(range(len(looks)), key=changes.__getitem__, reverse=True)
    return [looks[i] for i in order[:MAX_SURROUNDING_VIEWS] if changes[i] >= MIN_COLOR_CHANGE]


def thin_evenly(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Take every n-th item so that at most `most` are left."""
    return items[:: max(1, -(-len(items) // most))]


def serialize_record(record: ReportRecord) -> str:
    """Serialize the record."""
    return json.dumps(record, default=vars, separators=(",", ":")) + "\n"


def write_record(folder: Path, record: ReportRecord) -> None:
    """Write `report.json`."""
    (folder / RECORD_FILE).write_text(serialize_record(record))


def round_values(values: Tensor) -> tuple[float, ...]:
    """Round numbers [n] to six significant digits."""
    return tuple(float(f"{value:.6g}") for value in values.detach().cpu().double().tolist())
