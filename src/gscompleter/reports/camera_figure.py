"""The cameras of a completion in space, drawn so that a page can turn them.

Everything is told from the middle of the cameras, in an upright frame and in units of the radius of
the drawing. Elements that turn carry their points in `data-points`; the script of the page projects
these as `projected` does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from gscompleter.reports.figures import figure, markup, put
from gscompleter.reports.record import Points, Pose

SIZE = 480.0
"""Width and height of the drawing, in the units of its viewBox."""
YAW, PITCH = 30.0, 25.0
"""How the drawing is turned at first, in degrees."""
DEPTH = 0.11
"""Length of a camera, in radii."""
FARTHEST = 15.0
"""Points are shown as far from the cameras as these stand apart, times this."""
EDGE = 1.2
"""How far from the middle points are drawn, in radii."""
SHOWN = 0.9
"""Share of all that is shown that lies within the radius."""


@dataclass(frozen=True)
class Placed:
    """A camera, what it is, and what it is called."""

    pose: Pose
    kind: str
    """photograph, context, anchor or target."""
    name: str
    label: str = ""
    """Text beside it."""


@dataclass(frozen=True)
class Frame:
    """The frame of the drawing."""

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    """Its axes as rows, the second upwards."""
    radius: float

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """World points as the drawing tells them."""
        return (points - self.center) @ self.axes.T / self.radius


def camera_figure(cameras: Sequence[Placed], points: Points) -> Markup | None:
    """A drawing of `cameras` among `points`; None where there are none, or not all are finite."""
    poses = [np.array(camera.pose.c2w) for camera in cameras]
    if not poses or not all(p.shape == (3, 4) and np.isfinite(p).all() for p in poses):
        return None
    places = [place for place in zip(points.means, points.added, strict=False) if finite(place[0])]
    means = np.array([mean for mean, _ in places]).reshape(-1, 3)
    frame = frame_of(np.stack(poses), means)
    targets = sum(camera.kind == "target" for camera in cameras)
    told = f"{len(cameras)} cameras, {targets} of them targets, among {len(places)} points."
    svg = figure("Cameras in space", told, SIZE, SIZE, "space")
    draw_points(svg, frame(means), [added for _, added in places])
    for camera, pose in zip(cameras, poses, strict=True):
        draw_camera(svg, camera, frame(frustum(pose, camera.pose.opening, DEPTH * frame.radius)))
    return markup(svg)


def finite(numbers: Sequence[float]) -> bool:
    """Whether all of them can be drawn."""
    return all(map(math.isfinite, numbers))


def draw_points(svg: Element, points: Float[np.ndarray, "n 3"], added: Sequence[bool]) -> None:
    """Draw those places on surfaces that lie within the drawing."""
    within = np.abs(points).max(axis=1, initial=0) <= EDGE
    centers, kinds = projected(points).tolist(), ["added" if new else "seen" for new in added]
    for row in np.flatnonzero(within):
        (x, y), told = centers[row], text_of(points[row])
        put(svg, "circle", class_=kinds[row], r=1.6, cx=x, cy=y, data_points=told)


def draw_camera(svg: Element, camera: Placed, corners: Float[np.ndarray, "11 3"]) -> None:
    """Draw a camera whose line from its centre along its edges is `corners`."""
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in projected(corners))
    drawn = put(svg, "polyline", class_=camera.kind, points=line, data_points=text_of(corners))
    put(drawn, "title", camera.name)
    if camera.label:
        (x, y), told = projected(corners[:1])[0], text_of(corners[:1])
        beside = {"dx": 6, "dy": -6, "data_points": told}
        put(svg, "text", camera.label, class_=camera.kind, x=x, y=y, **beside)


def frame_of(poses: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "m 3"]) -> Frame:
    """A frame around the cameras, upright as most of them are."""
    cameras = poses[:, :, 3]
    middle = cameras.mean(axis=0)
    apart = distances(cameras, middle).max()
    near = points[distances(points, middle) <= FARTHEST * apart] if apart > 0 else points
    shown = np.concatenate([cameras, near])
    center = np.quantile(shown, [1 - SHOWN, SHOWN], axis=0).mean(axis=0)
    away = distances(shown, center)
    radius = max(np.quantile(away, SHOWN), 1.1 * away[: len(cameras)].max())
    up = -poses[:, :, 1].mean(axis=0)
    forward = poses[:, :, 2].mean(axis=0)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        up, right = -poses[0, :, 1], poses[0, :, 0]
    right, up = right / np.linalg.norm(right), up / np.linalg.norm(up)
    return Frame(center, np.stack([right, up, np.cross(right, up)]), float(radius) or 1.0)


def distances(points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "3"]) -> np.ndarray:
    """How far points lie from `center`: [n]."""
    return np.linalg.norm(points - center, axis=1)


def frustum(
    pose: Float[np.ndarray, "3 4"], opening: tuple[float, float], depth: float
) -> Float[np.ndarray, "11 3"]:
    """World points of one line along the edges of a camera `depth` deep, from its centre on."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    wide, high = opening
    corners = np.c_[signs * np.array(opening) / max(wide, high) * 0.6, np.ones(4)] * depth
    o, (a, b, c, d) = pose[:, 3], corners @ pose[:, :3].T + pose[:, 3]
    return np.stack([o, a, b, c, d, a, b, o, c, d, o])


def projected(
    points: Float[np.ndarray, "n 3"], yaw: float = YAW, pitch: float = PITCH
) -> Float[np.ndarray, "n 2"]:
    """Where points of the drawing's frame are drawn, in parallel projection."""
    (sin_y, cos_y), (sin_p, cos_p) = (
        (np.sin(angle), np.cos(angle)) for angle in np.radians([yaw, pitch])
    )
    x, y, z = points.T
    toward = cos_y * z - sin_y * x
    return SIZE / 2 + SIZE * 0.45 * np.stack(
        [cos_y * x + sin_y * z, sin_p * toward - cos_p * y], axis=1
    )


def text_of(points: Float[np.ndarray, "*n 3"]) -> str:
    """Points as the script reads them."""
    return " ".join(f"{value:.3f}" for value in points.flatten().tolist())


def placed_cameras(
    context: Sequence[tuple[Pose, int | None]],
    anchors: Sequence[int | None],
    targets: Sequence[Pose],
    photographs: Sequence[Pose],
) -> Iterator[Placed]:
    """All cameras with what they are: photographs first, targets last, so that these are on top."""
    for pose in photographs:
        yield Placed(pose, "photograph", "a photograph of the scene")
    for pose, frame in context:
        kind = "anchor" if frame in anchors else "context"
        name = "photograph" if frame is None else f"photograph {frame}"
        yield Placed(pose, kind, f"{name}, {kind}", "" if frame is None else str(frame))
    for number, pose in enumerate(targets, start=1):
        yield Placed(pose, "target", f"target {number}", f"T{number}")
