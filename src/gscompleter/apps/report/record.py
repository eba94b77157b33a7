"""Collects `report.json`: what a report shows besides the summary and the images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gscompleter.apps.report.schema import (
    CompletionRecord,
    Limits,
    PairsRow,
    PoseRow,
    TargetRecord,
    Vector,
)
from gscompleter.evaluation.metrics.coverage import RenderPair, compute_coverage
from gscompleter.state import Completion, TargetResult
from gscompleter.types import Camera, DepthPairs, Gaussians

MAX_PHOTOGRAPHS = 200
MAX_POINTS = 600
"""Largest number of points to keep, of the context and of the added Gaussians each."""
MAX_SURROUNDING_VIEWS = 6
MIN_SURFACE_OPACITY = 0.3
MIN_COLOR_CHANGE = 0.002
"""Smallest mean colour difference, in [0, 1], of a changed image."""


def make_record(
    completion: Completion,
    limits: Sequence[Limits | None],
    around: Sequence[RenderPair],
    photographs: Sequence[Camera],
) -> CompletionRecord:
    """Collect the data of a completion."""
    shown = thin_evenly(photographs, MAX_PHOTOGRAPHS)
    return CompletionRecord(
        context=tuple(make_pose(view.camera) for view in completion.views),
        photographs=tuple(make_pose(camera) for camera in shown),
        num_photographs=len(photographs),
        targets=tuple(map(make_target_record, completion.targets, limits)),
        around=tuple(compute_coverage([look]) for look in around),
        scene_points=sample_points(completion.context),
        added_points=sample_points(completion.added),
    )


def make_target_record(result: TargetResult, limits: Limits | None) -> TargetRecord:
    """Collect the data of a target."""
    losses = {name: round_values(torch.tensor(values)) for name, values in result.losses.items()}
    pairs = None if result.pairs is None else make_pairs(result.pairs)
    return TargetRecord(make_pose(result.target), limits, losses, pairs)


def make_pairs(pairs: DepthPairs) -> PairsRow:
    """Round depth pairs."""
    predicted, context = round_values(pairs.predicted), round_values(pairs.context)
    return PairsRow(pairs.fit_view, predicted, context, tuple(pairs.inlier_mask.tolist()))


def make_pose(camera: Camera) -> PoseRow:
    """Convert a camera to its pose and field of view."""
    a, b, c = camera.c2w[:3]
    wide, high = camera.width / 2 / camera.K[0, 0].item(), camera.height / 2 / camera.K[1, 1].item()
    return PoseRow((round_values(a), round_values(b), round_values(c)), (wide, high))


def sample_points(gaussians: Gaussians) -> tuple[Vector, ...]:
    """Sample means of opaque Gaussians, in the frame of the .ply."""
    opaque = gaussians.means[gaussians.opacities >= MIN_SURFACE_OPACITY]
    order = torch.randperm(len(opaque), generator=torch.Generator().manual_seed(0))
    return tuple(map(round_values, opaque[order[:MAX_POINTS].to(opaque.device)].cpu()))


def select_most_changed(looks: Sequence[RenderPair]) -> list[RenderPair]:
    """Select the views whose images changed most, in descending order."""
    changes = [(look.after.image - look.before.image).abs().mean().item() for look in looks]
    order = sorted(range(len(looks)), key=changes.__getitem__, reverse=True)
    return [looks[i] for i in order[:MAX_SURROUNDING_VIEWS] if changes[i] >= MIN_COLOR_CHANGE]


def thin_evenly(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Take every n-th item so that at most `most` are left."""
    return items[:: max(1, -(-len(items) // most))]


def round_values(values: Tensor) -> tuple[Any, ...]:
    """Round numbers [n] to six significant digits."""
    return tuple(float(f"{value:.6g}") for value in values.detach().cpu().double().tolist())
