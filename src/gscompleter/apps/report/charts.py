"""The drawing of cameras, the plot of depth pairs, and the colours of depth images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.apps.report.schema import PairsRow, SceneDrawing
from gscompleter.evaluation.metrics.coverage import RenderPair
from gscompleter.geometry import estimate_up
from gscompleter.io.image import convert_to_image
from gscompleter.state import Completion
from gscompleter.types import Camera, Gaussians, Render

MAX_POINTS = 600
"""Largest number of points to draw, of the context and of the added Gaussians each."""
MIN_SURFACE_OPACITY = 0.3
FRUSTUM = ((-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1))
"""Image corners of a camera pyramid, whose apex is the origin."""
FRUSTUM_DEPTH = 0.11
"""Length of a camera pyramid, in radii."""
SHOWN_FRACTION = 0.9
"""Fraction of the points within the radius."""
POINT_BOUND = 1.2
"""Largest coordinate of a point, in radii."""
NO_DEPTH_COLOR = (128, 128, 128)
TAIL_FRACTION = 0.01
"""Fraction of the depths at either end that the colours do not resolve."""


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


def draw_scene(completion: Completion, photographs: Sequence[Camera]) -> SceneDrawing:
    """Draw all cameras, and samples of the context and of the added Gaussians."""
    context = [view.camera.to("cpu") for view in completion.views]
    targets = [result.target.to("cpu") for result in completion.targets]
    others = [camera.to("cpu") for camera in photographs]
    scene, added = sample_points(completion.context), sample_points(completion.added)
    frame = fit_frame([*others, *context, *targets], torch.cat([scene, added]))
    return SceneDrawing(
        *(tuple(draw_camera(camera, frame) for camera in g) for g in (others, context, targets)),
        *(draw_points(points, frame) for points in (scene, added)),
    )


def sample_points(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """Sample means of opaque Gaussians."""
    opaque = gaussians.means[gaussians.opacities >= MIN_SURFACE_OPACITY].detach().cpu()
    order = torch.randperm(len(opaque), generator=torch.Generator().manual_seed(0))
    return opaque[order[:MAX_POINTS]]


def fit_frame(cameras: Sequence[Camera], points: Float[Tensor, "n 3"]) -> DrawingFrame:
    """Fit a frame around cameras and points whose up axis is that of most cameras."""
    up = estimate_up(cameras)
    level = min(cameras, key=lambda camera: (camera.c2w[:3, 1] @ up).item())
    back = normalize(torch.linalg.cross(level.c2w[:3, 0], up), dim=0)
    centers = torch.stack([camera.center for camera in cameras])
    middle = torch.cat([centers, points]).median(dim=0).values
    farthest = 1.1 * (centers - middle).norm(dim=1).max()
    away = torch.cat([(points - middle).norm(dim=1), farthest[None]])
    radius = max(farthest.item(), away.quantile(SHOWN_FRACTION).item(), 1e-9)
    return DrawingFrame(middle, torch.stack([torch.linalg.cross(up, back), up, back]), radius)


def draw_camera(camera: Camera, frame: DrawingFrame) -> str:
    """Write the corners of one line along the edges of a camera pyramid, centre first."""
    size = torch.tensor([camera.width, camera.height]) / camera.K.diagonal()[:2]
    sides = torch.cat([0.6 * size / size.max(), torch.ones(1)])
    a, b, c, d = torch.tensor(FRUSTUM) * sides @ camera.c2w[:3, :3].T @ frame.axes.T
    o = torch.zeros(3)
    corners = FRUSTUM_DEPTH * torch.stack([o, a, b, c, d, a, b, o, c, d, o])
    return format_points(frame.convert(camera.center) + corners)


def draw_points(points: Float[Tensor, "n 3"], frame: DrawingFrame) -> tuple[str, ...]:
    """Write the positions of points within the borders of the drawing."""
    placed = frame.convert(points)
    return tuple(map(format_points, placed[(placed.abs() <= POINT_BOUND).all(dim=1)]))


def format_points(points: Float[Tensor, "*n 3"]) -> str:
    """Format points for the script of the page."""
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())


@dataclass(frozen=True)
class DepthPlot:
    """Lifted depths (to the right) against scene depths (down), as paths in a unit square."""

    end: float
    """Largest depth, at the end of both axes, in scene units."""
    inliers: str
    outliers: str


def plot_depth_pairs(pairs: PairsRow) -> DepthPlot:
    """Plot the compared depths of a target as dots."""
    end = max(*pairs.predicted, *pairs.context)
    dots = {True: "", False: ""}
    for lifted, seen, agrees in zip(pairs.predicted, pairs.context, pairs.agrees, strict=True):
        dots[agrees] += f"M{lifted / end:.4f} {seen / end:.4f}h0"
    return DepthPlot(end, dots[True], dots[False])


def compute_depth_limits(pair: RenderPair) -> tuple[float, float] | None:
    """Compute the nearest and farthest depth of the colours, or None without any depth."""
    maps = pair.before.depth_map(), pair.after.depth_map()
    known = torch.cat([depth_map.depth[depth_map.valid] for depth_map in maps])
    if len(known) == 0:
        return None
    ends = np.quantile(known.cpu().double().numpy(), [TAIL_FRACTION, 1 - TAIL_FRACTION])
    return ends[0].item(), max(ends[1], 1.001 * ends[0]).item()


def color_depth(render: Render, limits: tuple[float, float]) -> Float[Tensor, "h w 3"]:
    """Color the logarithm of z-depth with viridis, from near to far; grey without a depth."""
    near, far = limits
    depth = render.depth.cpu().double().clamp(near, far).numpy()
    levels = np.rint(255 * np.log(depth / near) / np.log(far / near)).astype(np.uint8)
    colors = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    colors[~render.depth_map().valid.cpu().numpy()] = NO_DEPTH_COLOR
    return convert_to_image(colors)
