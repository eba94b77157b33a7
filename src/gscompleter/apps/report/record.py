"""What the page shows beside pictures: a drawing of all cameras, and pairs of depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.apps.report.schema import CompletionRecord, PairsRow
from gscompleter.numerics.geometry import estimate_up
from gscompleter.state import Completion
from gscompleter.types import Camera

MAX_PHOTOGRAPHS = 200
"""Largest number of photographs in the drawing and for the path of the video."""
FRUSTUM = ((-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1))
"""Image corners of a camera pyramid in camera axes, whose apex is the origin."""
FRUSTUM_DEPTH = 0.11
"""Length of a camera pyramid, in radii of the drawing."""
FRUSTUM_HALF_SIDE = 0.6
"""Half of the longer side of its base, relative to its length."""


@dataclass(frozen=True)
class DrawingFrame:
    """Coordinate frame of a drawing, in the frame of the result."""

    center: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]
    """Unit axes as rows: right, up and back."""
    radius: float
    """Length that is 1 in the drawing, in scene units."""

    def convert(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Convert world points to the drawing."""
        return (points - self.center) @ self.axes.T / self.radius


def thin_evenly(items: Sequence[Camera], most: int) -> Sequence[Camera]:
    """Take every n-th item so that at most `most` are left."""
    return items[:: max(1, -(-len(items) // most))]


def make_record(completion: Completion, photographs: Sequence[Camera]) -> CompletionRecord:
    """Draw the cameras of `photographs`, the context and the targets, and list depth pairs."""
    context = [view.camera.to("cpu") for view in completion.views]
    targets = [result.target.to("cpu") for result in completion.targets]
    photographed = [camera.to("cpu") for camera in photographs]
    frame = fit_frame([*photographed, *context, *targets])

    def draw(cameras: Sequence[Camera]) -> tuple[str, ...]:
        return tuple(draw_camera_lines(camera, frame) for camera in cameras)

    rows = []
    for result in completion.targets:
        pairs = result.affine.pairs
        columns = pairs.predicted, pairs.context, pairs.inlier_mask
        points = zip(*(column.tolist() for column in columns), strict=True)
        rows.append(PairsRow(pairs.fit_view, tuple(points)))
    return CompletionRecord(draw(photographed), draw(context), draw(targets), tuple(rows))


def fit_frame(cameras: Sequence[Camera]) -> DrawingFrame:
    """Fit a frame around cameras, whose up axis is that of most of them."""
    up = estimate_up(cameras)
    # The drawing is seen as by the most level camera, whose y axis points down most exactly.
    level = min(cameras, key=lambda camera: (camera.c2w[:3, 1] @ up).item())
    back = normalize(torch.linalg.cross(level.c2w[:3, 0], up), dim=0)
    centers = torch.stack([camera.center for camera in cameras])
    middle = centers.median(dim=0).values
    # A tenth more than the farthest camera, and never 0: all cameras may stand in one place.
    radius = max(1.1 * (centers - middle).norm(dim=1).max().item(), 1e-9)
    return DrawingFrame(middle, torch.stack([torch.linalg.cross(up, back), up, back]), radius)


def draw_camera_lines(camera: Camera, frame: DrawingFrame) -> str:
    """Draw the edges of a camera pyramid as one line: x y z of its points, the camera first."""
    # Width and height of the view at z = 1. Only their ratio is drawn: pyramids of all lenses are
    # as large.
    size = torch.tensor([camera.width, camera.height]) / camera.K.diagonal()[:2]
    scale = torch.cat([FRUSTUM_HALF_SIDE * size / size.max(), torch.ones(1)])
    # From camera axes into those of the world, and from there into those of the drawing.
    a, b, c, d = torch.tensor(FRUSTUM) * scale @ camera.c2w[:3, :3].T @ frame.axes.T
    # From the apex to the corners and around them; a single line draws some edges twice.
    apex = torch.zeros(3)
    line = FRUSTUM_DEPTH * torch.stack([apex, a, b, c, d, a, b, apex, c, d, apex])
    points = frame.convert(camera.center) + line
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())
