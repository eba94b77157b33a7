"""What the page shows beside pictures: a drawing of all cameras, and pairs of depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.apps.report.schema import (
    CompletionRecord,
    PairsRow,
)
from gscompleter.numerics.geometry import estimate_up
from gscompleter.state import Completion
from gscompleter.types import Camera

MAX_PHOTOGRAPHS = 200
"""Largest number of photographs in the drawing and for the path of the video."""
FRUSTUM = ((-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1))
"""Image corners of a camera pyramid, whose apex is the origin."""
FRUSTUM_DEPTH = 0.11
"""Length of a camera pyramid, in radii."""


@dataclass(frozen=True)
class DrawingFrame:
    """Coordinate frame of a drawing."""

    center: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]
    """Unit axes as rows: right, up and back."""
    radius: float

    def convert(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Convert world points to the drawing."""
        return (points - self.center) @ self.axes.T / self.radius


def thin_evenly(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Take every n-th item so that at most `most` are left."""
    return items[:: max(1, -(-len(items) // most))]


def make_record(completion: Completion, photographs: Sequence[Camera]) -> CompletionRecord:
    """Draw all cameras, and list depth pairs."""
    context = [view.camera.to("cpu") for view in completion.views]
    targets = [result.target.to("cpu") for result in completion.targets]
    others = [camera.to("cpu") for camera in photographs]
    frame = fit_frame([*others, *context, *targets])

    def draw(cameras: Sequence[Camera]) -> tuple[str, ...]:
        return tuple(draw_camera_lines(camera, frame) for camera in cameras)

    rows = []
    for result in completion.targets:
        pairs = result.affine.pairs
        columns = pairs.predicted, pairs.context, pairs.inlier_mask
        points = zip(*(column.tolist() for column in columns), strict=True)
        rows.append(PairsRow(pairs.fit_view, tuple(points)))
    return CompletionRecord(draw(others), draw(context), draw(targets), tuple(rows))


def fit_frame(cameras: Sequence[Camera]) -> DrawingFrame:
    """Fit a frame around cameras whose up axis is that of most of them."""
    up = estimate_up(cameras)
    # The most level camera gives the direction of the view; its axes are made level exactly.
    level = min(cameras, key=lambda camera: (camera.c2w[:3, 1] @ up).item())
    back = normalize(torch.linalg.cross(level.c2w[:3, 0], up), dim=0)
    centers = torch.stack([camera.center for camera in cameras])
    middle = centers.median(dim=0).values
    # At least a tiny radius: all cameras may stand in one place.
    radius = max(1.1 * (centers - middle).norm(dim=1).max().item(), 1e-9)
    return DrawingFrame(middle, torch.stack([torch.linalg.cross(up, back), up, back]), radius)


def draw_camera_lines(camera: Camera, frame: DrawingFrame) -> str:
    """Write the corners of one line along the edges of a camera pyramid, centre first."""
    # Half the image over the focal length at z = 1, with the longer side always as long.
    size = torch.tensor([camera.width, camera.height]) / camera.K.diagonal()[:2]
    sides = torch.cat([0.6 * size / size.max(), torch.ones(1)])
    a, b, c, d = torch.tensor(FRUSTUM) * sides @ camera.c2w[:3, :3].T @ frame.axes.T
    # Edges from the apex to the corners and around, in a single line: some are drawn twice.
    o = torch.zeros(3)
    corners = FRUSTUM_DEPTH * torch.stack([o, a, b, c, d, a, b, o, c, d, o])
    points = frame.convert(camera.center) + corners
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())
