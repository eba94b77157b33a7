"""A drawing of the cameras in space that the reader can rotate.

Coordinates are relative to the middle of the cameras, upright, in units of the radius of the
drawing. The script of the page projects the `data-points` of each element as `project_to_drawing`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from gscompleter.apps.report.figures import add_element, create_figure, serialize_figure
from gscompleter.apps.report.record import PointRecord, ReportPose

DRAWING_SIZE = 480.0
YAW, PITCH = 30.0, 25.0
"""Initial rotation, in degrees."""
FRUSTUM_DEPTH = 0.11
"""Length of a camera pyramid, in radii."""
MAX_POINT_DISTANCE = 15.0
"""Largest distance of points from the cameras, as a factor of the extent of the cameras."""
POINT_BOUND = 1.2
"""Largest coordinate of a point, in radii."""
SHOWN_FRACTION = 0.9
"""Fraction of cameras and points within the radius."""


@dataclass(frozen=True)
class LabelledCamera:
    """A camera with its role and labels."""

    pose: ReportPose
    kind: str
    """photograph, context, anchor or target."""
    name: str
    label: str = ""


@dataclass(frozen=True)
class DrawingFrame:
    """Coordinate frame of the drawing."""

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    """Axes as rows; the second points up."""
    radius: float

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Convert world points to the drawing."""
        return (points - self.center) @ self.axes.T / self.radius


def draw_cameras(cameras: Sequence[LabelledCamera], points: PointRecord) -> Markup | None:
    """Draw `cameras` among `points`, or return None without cameras or with infinite ones."""
    poses = [np.array(camera.pose.c2w) for camera in cameras]
    if not poses or not all(p.shape == (3, 4) and np.isfinite(p).all() for p in poses):
        return None
    places = [
        place for place in zip(points.means, points.added, strict=False) if is_finite(place[0])
    ]
    means = np.array([mean for mean, _ in places]).reshape(-1, 3)
    frame = fit_frame(np.stack(poses), means)
    targets = sum(camera.kind == "target" for camera in cameras)
    text = f"{len(cameras)} cameras, {targets} of them targets, and {len(places)} scene points."
    svg = create_figure("Cameras in space", text, DRAWING_SIZE, DRAWING_SIZE, "space")
    draw_points(svg, frame(means), [added for _, added in places])
    for camera, pose in zip(cameras, poses, strict=True):
        draw_camera(
            svg,
            camera,
            frame(compute_frustum(pose, camera.pose.opening, FRUSTUM_DEPTH * frame.radius)),
        )
    return serialize_figure(svg)


def is_finite(numbers: Sequence[float]) -> bool:
    """Return True if all numbers are finite."""
    return all(map(math.isfinite, numbers))


def draw_points(svg: Element, points: Float[np.ndarray, "n 3"], added: Sequence[bool]) -> None:
    """Draw the points within the borders of the drawing."""
    within = np.abs(points).max(axis=1, initial=0) <= POINT_BOUND
    centers, kinds = (
        project_to_drawing(points).tolist(),
        ["added" if new else "seen" for new in added],
    )
    for row in np.flatnonzero(within):
        (x, y), position = centers[row], format_points(points[row])
        add_element(svg, "circle", class_=kinds[row], r=1.6, cx=x, cy=y, data_points=position)


def draw_camera(svg: Element, camera: LabelledCamera, corners: Float[np.ndarray, "11 3"]) -> None:
    """Draw a camera as one line along `corners`."""
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in project_to_drawing(corners))
    shape = add_element(
        svg, "polyline", class_=camera.kind, points=line, data_points=format_points(corners)
    )
    add_element(shape, "title", camera.name)
    if camera.label:
        (x, y), position = project_to_drawing(corners[:1])[0], format_points(corners[:1])
        beside = {"dx": 6, "dy": -6, "data_points": position}
        add_element(svg, "text", camera.label, class_=camera.kind, x=x, y=y, **beside)


def fit_frame(poses: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "m 3"]) -> DrawingFrame:
    """Fit a frame around cameras and points whose up axis is that of most cameras."""
    cameras = poses[:, :, 3]
    middle = cameras.mean(axis=0)
    apart = compute_distances(cameras, middle).max()
    near = (
        points[compute_distances(points, middle) <= MAX_POINT_DISTANCE * apart]
        if apart > 0
        else points
    )
    shown = np.concatenate([cameras, near])
    center = np.quantile(shown, [1 - SHOWN_FRACTION, SHOWN_FRACTION], axis=0).mean(axis=0)
    away = compute_distances(shown, center)
    radius = max(np.quantile(away, SHOWN_FRACTION), 1.1 * away[: len(cameras)].max())
    up = -poses[:, :, 1].mean(axis=0)
    forward = poses[:, :, 2].mean(axis=0)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        up, right = -poses[0, :, 1], poses[0, :, 0]
    right, up = right / np.linalg.norm(right), up / np.linalg.norm(up)
    return DrawingFrame(center, np.stack([right, up, np.cross(right, up)]), float(radius) or 1.0)


def compute_distances(
    points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "3"]
) -> np.ndarray:
    """Compute the distances [n] of points from `center`."""
    return np.linalg.norm(points - center, axis=1)


def compute_frustum(
    pose: Float[np.ndarray, "3 4"], opening: tuple[float, float], depth: float
) -> Float[np.ndarray, "11 3"]:
    """Compute the world points of one line along the edges of a camera pyramid."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    wide, high = opening
    corners = np.c_[signs * np.array(opening) / max(wide, high) * 0.6, np.ones(4)] * depth
    o, (a, b, c, d) = pose[:, 3], corners @ pose[:, :3].T + pose[:, 3]
    return np.stack([o, a, b, c, d, a, b, o, c, d, o])


def project_to_drawing(
    points: Float[np.ndarray, "n 3"], yaw: float = YAW, pitch: float = PITCH
) -> Float[np.ndarray, "n 2"]:
    """Project points onto the drawing by parallel projection."""
    (sin_y, cos_y), (sin_p, cos_p) = (
        (np.sin(angle), np.cos(angle)) for angle in np.radians([yaw, pitch])
    )
    x, y, z = points.T
    toward = cos_y * z - sin_y * x
    return DRAWING_SIZE / 2 + DRAWING_SIZE * 0.45 * np.stack(
        [cos_y * x + sin_y * z, sin_p * toward - cos_p * y], axis=1
    )


def format_points(points: Float[np.ndarray, "*n 3"]) -> str:
    """Format points for the script of the page."""
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())


def label_cameras(
    context: Sequence[tuple[ReportPose, int | None]],
    anchors: Sequence[int | None],
    targets: Sequence[ReportPose],
    photographs: Sequence[ReportPose],
) -> Iterator[LabelledCamera]:
    """Yield all cameras with their roles: photographs first and targets last, on top."""
    for pose in photographs:
        yield LabelledCamera(pose, "photograph", "a photograph of the scene")
    for pose, frame in context:
        kind = "anchor" if frame in anchors else "context"
        name = "photograph" if frame is None else f"photograph {frame}"
        yield LabelledCamera(pose, kind, f"{name}, {kind}", "" if frame is None else str(frame))
    for number, pose in enumerate(targets, start=1):
        yield LabelledCamera(pose, "target", f"target {number}", f"T{number}")
