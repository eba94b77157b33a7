"""Charts of a report, as their templates draw them, and depth images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from gscompleter.apps.report.schema import CompletionRecord, Limits, PairsRow, PoseRow
from gscompleter.io.files import replace_file
from gscompleter.io.image import PNG_COMPRESSION
from gscompleter.types import DepthMap

WIDTH, HEIGHT = 360.0, 220.0
LEFT, BOTTOM, TOP, RIGHT = 52.0, 40.0, 12.0, 12.0
"""Margins around the axes of a plot."""
FRUSTUM_DEPTH = 0.11
"""Length of a camera pyramid in the scene drawing, in radii."""
FRUSTUM_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
MAX_POINT_DISTANCE = 15.0
"""Largest distance of points from the cameras, as a factor of the extent of the cameras."""
POINT_BOUND = 1.2
"""Largest coordinate of a point, in radii."""
SHOWN_FRACTION = 0.9
"""Fraction of cameras and points within the radius."""
NO_DEPTH_COLOR = (128, 128, 128)
TAIL_FRACTION = 0.01
"""Fraction of the depths at either end that the colours do not resolve."""


@dataclass(frozen=True)
class Axis:
    """A linear axis: its range in values and in drawing units."""

    name: str
    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        """Compute the drawing position of a value."""
        share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Drawing positions of round numbers, and the numbers."""
        return [(self(value), f"{value:g}") for value in compute_ticks(self.low, self.high)]


@dataclass(frozen=True)
class Plot:
    """Lines and dots by kind between two axes."""

    title: str
    description: str
    x: Axis
    y: Axis
    lines: dict[str, str] = field(default_factory=dict)
    """`points` of polylines."""
    dots: dict[str, str] = field(default_factory=dict)
    """`d` of paths."""


def compute_ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Return round numbers from `low` to `high`."""
    raw = (high - low) / most
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= raw * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def make_axes(
    names: tuple[str, str], across: Sequence[float], up: Sequence[float]
) -> tuple[Axis, Axis]:
    """Make the axes of a plot around values."""
    x, y = (pad_range(min(values), max(values)) for values in (across, up))
    return Axis(names[0], *x, LEFT, WIDTH - RIGHT), Axis(names[1], *y, HEIGHT - BOTTOM, TOP)


def pad_range(low: float, high: float) -> tuple[float, float]:
    """Widen a range; the result is never empty."""
    padding = 0.05 * ((high - low) or abs(high) or 1.0)
    return low - padding, high + padding


def plot_loss(title: str, losses: Sequence[float]) -> Plot | None:
    """Plot the loss over the iterations, or return None for less than two."""
    known = [(float(k), loss) for k, loss in enumerate(losses, start=1) if math.isfinite(loss)]
    if len(known) < 2:
        return None
    text = f"A curve over {len(losses)} iterations, from {known[0][1]:.3g} to {known[-1][1]:.3g}."
    x, y = make_axes(("iteration", "loss"), *zip(*known, strict=True))
    return Plot(title, text, x, y, {"curve": draw_line(known, x, y)})


def plot_depth_pairs(pairs: PairsRow, scale: float, shift: float, unit: str) -> Plot | None:
    """Plot lifted against scene depths with the fitted line, or return None without pairs."""
    if not pairs.agrees or not math.isfinite(scale + shift):
        return None
    share, count = sum(pairs.agrees) / len(pairs.agrees), len(pairs.agrees)
    line = f"{scale:.3f} times depth plus {shift:.3g}"
    text = f"{count} pixels; {share:.0%} lie on the line {line}."
    names = (f"lifted depth ({unit})", f"scene depth ({unit})")
    x, y = make_axes(names, pairs.predicted, pairs.context)
    dots = {"outlier": "", "inlier": ""}
    for depth, seen, agrees in zip(pairs.predicted, pairs.context, pairs.agrees, strict=True):
        dots["inlier" if agrees else "outlier"] += f"M{x(depth):.1f} {y(seen):.1f}h0"
    low, high = max(x.low, (y.low - shift) / scale), min(x.high, (y.high - shift) / scale)
    ends = [(low, scale * low + shift), (high, scale * high + shift)] if low < high else []
    title = "Lifted depth against scene depth"
    return Plot(title, text, x, y, {"fit": draw_line(ends, x, y)}, dots)


def draw_line(points: Sequence[tuple[float, float]], x: Axis, y: Axis) -> str:
    """Write `points` of a polyline."""
    return " ".join(f"{x(a):.1f},{y(b):.1f}" for a, b in points)


@dataclass(frozen=True)
class SceneDrawing:
    """Coordinate frame of the drawing of cameras and points, which the page rotates.

    Coordinates are relative to the middle of the cameras, upright, in units of the radius.
    """

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    """Axes as rows; the second points up."""
    radius: float

    def convert(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert world points to the drawing."""
        return (points - self.center) @ self.axes.T / self.radius

    def place_points(self, points: Sequence[Sequence[float]]) -> list[str]:
        """Write the positions of points within the borders of the drawing."""
        placed = self.convert(np.reshape(points, (-1, 3)))
        within = np.abs(placed).max(axis=1, initial=0) <= POINT_BOUND
        return [format_points(point) for point in placed[within]]

    def place_camera(self, pose: PoseRow) -> str:
        """Write the corners of one line along the edges of a camera pyramid, centre first."""
        c2w, depth = np.array(pose.c2w), FRUSTUM_DEPTH * self.radius
        sides = FRUSTUM_CORNERS * pose.opening / max(pose.opening) * 0.6
        a, b, c, d = np.c_[sides, np.ones(4)] * depth @ c2w[:, :3].T + c2w[:, 3]
        o = c2w[:, 3]
        return format_points(self.convert(np.stack([o, a, b, c, d, a, b, o, c, d, o])))


def format_points(points: Float[np.ndarray, "*n 3"]) -> str:
    """Format points for the script of the page."""
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())


def fit_drawing(record: CompletionRecord) -> SceneDrawing:
    """Fit a frame around cameras and points whose up axis is that of most cameras."""
    targets = tuple(target.camera for target in record.targets)
    poses = np.array([pose.c2w for pose in (*record.photographs, *record.context, *targets)])
    points = np.reshape(record.scene_points + record.added_points, (-1, 3))
    cameras = poses[:, :, 3]
    extent = compute_distances(cameras, cameras.mean(axis=0)).max()
    far = compute_distances(points, cameras.mean(axis=0)) > MAX_POINT_DISTANCE * extent
    shown = np.concatenate([cameras, points if extent == 0 else points[~far]])
    center = np.quantile(shown, [1 - SHOWN_FRACTION, SHOWN_FRACTION], axis=0).mean(axis=0)
    away = compute_distances(shown, center)
    radius = max(np.quantile(away, SHOWN_FRACTION), 1.1 * away[: len(cameras)].max())
    return SceneDrawing(center, fit_upright_axes(poses), float(radius) or 1.0)


def fit_upright_axes(poses: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "3 3"]:
    """Fit axes as rows: right, up and back of most cameras."""
    up, forward = -poses[:, :, 1].mean(axis=0), poses[:, :, 2].mean(axis=0)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        up, right = -poses[0, :, 1], poses[0, :, 0]
    right, up = right / np.linalg.norm(right), up / np.linalg.norm(up)
    return np.stack([right, up, np.cross(right, up)])


def compute_distances(
    points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    """Compute the distances of points from `center`."""
    return np.linalg.norm(points - center, axis=1)


def make_palette() -> UInt8[np.ndarray, "256 3"]:
    """Make the palette of depth images: grey for no depth, then viridis from near to far."""
    steps = np.linspace(0, 255, 255).round().astype(np.uint8)
    viridis = cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS).reshape(-1, 3)[:, ::-1]
    return np.concatenate([np.array([NO_DEPTH_COLOR], np.uint8), viridis])


def compute_depth_limits(maps: Sequence[DepthMap]) -> Limits | None:
    """Compute the nearest and farthest depth of the colours, or None without any depth."""
    known = np.concatenate([depth[mask] for depth, mask in map(copy_depths, maps)])
    if len(known) == 0:
        return None
    near, far = np.quantile(known, [TAIL_FRACTION, 1 - TAIL_FRACTION]).tolist()
    return near, max(far, 1.001 * near)


def write_depth_image(path: Path, depth_map: DepthMap, limits: Limits) -> None:
    """Write a depth map as a palette PNG: viridis over the logarithm of z-depth."""
    near, far = np.log(limits)
    depth, known = copy_depths(depth_map)
    share = (np.log(np.where(known, depth, 1.0)) - near) / (far - near)
    indices = np.where(known, 1 + np.rint(254 * share.clip(0, 1)), 0).astype(np.uint8)
    image = Image.fromarray(indices)
    image.putpalette(make_palette().tobytes())
    with replace_file(path) as file:
        image.save(file, format="PNG", compress_level=PNG_COMPRESSION)


def copy_depths(
    depth_map: DepthMap,
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Copy z-depths to the CPU, with the mask of pixels that have one."""
    depth = depth_map.depth.detach()
    known = depth_map.valid & torch.isfinite(depth) & (depth > 0)
    return depth.cpu().double().numpy(), known.cpu().numpy()
