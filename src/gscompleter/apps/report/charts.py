"""The drawing of cameras, and the plot of depth pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.apps.report.schema import CompletionRecord, PairsRow
from gscompleter.geometry import estimate_up
from gscompleter.state import Completion, TargetResult
from gscompleter.types import Camera

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


def make_record(completion: Completion, photographs: Sequence[Camera]) -> CompletionRecord:
    """Draw all cameras, and list depth pairs."""
    context = [view.camera.to("cpu") for view in completion.views]
    targets = [result.target.to("cpu") for result in completion.targets]
    others = [camera.to("cpu") for camera in photographs]
    frame = fit_frame([*others, *context, *targets])
    return CompletionRecord(
        photographs=draw_cameras(others, frame),
        context=draw_cameras(context, frame),
        targets=draw_cameras(targets, frame),
        pairs=tuple(map(list_depth_pairs, completion.targets)),
    )


def fit_frame(cameras: Sequence[Camera]) -> DrawingFrame:
    """Fit a frame around cameras whose up axis is that of most of them."""
    up = estimate_up(cameras)
    level = min(cameras, key=lambda camera: (camera.c2w[:3, 1] @ up).item())
    back = normalize(torch.linalg.cross(level.c2w[:3, 0], up), dim=0)
    centers = torch.stack([camera.center for camera in cameras])
    middle = centers.median(dim=0).values
    radius = max(1.1 * (centers - middle).norm(dim=1).max().item(), 1e-9)
    return DrawingFrame(middle, torch.stack([torch.linalg.cross(up, back), up, back]), radius)


def draw_cameras(cameras: Sequence[Camera], frame: DrawingFrame) -> tuple[str, ...]:
    """Draw cameras as pyramids."""
    return tuple(draw_camera(camera, frame) for camera in cameras)


def draw_camera(camera: Camera, frame: DrawingFrame) -> str:
    """Write the corners of one line along the edges of a camera pyramid, centre first."""
    size = torch.tensor([camera.width, camera.height]) / camera.K.diagonal()[:2]
    sides = torch.cat([0.6 * size / size.max(), torch.ones(1)])
    a, b, c, d = torch.tensor(FRUSTUM) * sides @ camera.c2w[:3, :3].T @ frame.axes.T
    o = torch.zeros(3)
    corners = FRUSTUM_DEPTH * torch.stack([o, a, b, c, d, a, b, o, c, d, o])
    points = frame.convert(camera.center) + corners
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())


def list_depth_pairs(result: TargetResult) -> PairsRow:
    """List the depth pairs of a target."""
    pairs = result.affine.pairs
    columns = pairs.predicted, pairs.context, pairs.inlier_mask
    return PairsRow(pairs.fit_view, tuple(zip(*(c.tolist() for c in columns), strict=True)))
