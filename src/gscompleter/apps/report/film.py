"""A video that moves through the completed holes, before and after side by side.

The camera starts at the photograph nearest to the first target that changed the scene, passes up to
`MAX_TARGETS` of these targets and returns the same way, so the video can loop and each frame is
rendered once. Its path is smooth and level.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from gscompleter.apps.report.record import MAX_PHOTOGRAPHS, thin_evenly
from gscompleter.evaluation.verdict.held_out import render_before_after
from gscompleter.numerics.geometry import (
    embed_cameras,
    measure_baseline,
    resize_camera,
    shrink_camera,
)
from gscompleter.render.protocols import Renderer
from gscompleter.state import Completion
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.system.files.video import write_video
from gscompleter.system.progress import track
from gscompleter.types import Camera

VIDEO_FILE = "video.mp4"
FRAMES_PER_SECOND = 24
ONE_WAY_SECONDS = 3.0
MIN_LEG_SECONDS = 0.75
MAX_TARGETS = 6
"""Most targets that the camera passes: the first ones."""
MAX_FILM_SIDE = 640
"""Longer side of one half in pixels, unless `MIN_FILM_WIDTH` needs more."""
GAP_PIXELS = 4
MIN_FILM_WIDTH = 720


def write_comparison_video(
    folder: Path, completion: Completion, photographs: Sequence[Camera], renderer: Renderer
) -> None:
    """Write `video.mp4`, or nothing without a target."""
    if not completion.targets:
        return
    way = choose_stops(completion)
    count = round(FRAMES_PER_SECOND * max(ONE_WAY_SECONDS / (len(way) - 1), MIN_LEG_SECONDS))
    cameras = plan_camera_path(way, thin_evenly(photographs, MAX_PHOTOGRAPHS), count)
    write_video(
        folder / VIDEO_FILE, render_frames(completion, cameras, renderer), FRAMES_PER_SECOND
    )


def choose_stops(completion: Completion) -> list[Camera]:
    """Choose a photograph and the first targets that changed the scene, or any if none did.

    All cameras get the intrinsics of the first of these targets.
    """
    changed = [result for result in completion.targets if result.has_changed_scene]
    results = changed or completion.targets
    targets = [result.target for result in results[:MAX_TARGETS]]
    photographs = [view.camera for view in completion.views]
    nearest = min(photographs, key=lambda camera: measure_baseline(camera, targets[0]))
    # Of one size and shape, since a video has no other.
    lens = fit_to_video(completion.with_depth_range(targets[0]))
    return [replace(lens, c2w=camera.c2w.to(lens.c2w)) for camera in (nearest, *targets)]


def fit_to_video(camera: Camera) -> Camera:
    """Resize the image to one half of the video, with an even width and height."""
    small = shrink_camera(camera, MAX_FILM_SIDE)
    factor = max((MIN_FILM_WIDTH - GAP_PIXELS) / 2 / small.width, 1.0)
    lens = resize_camera(small, math.ceil(factor * small.width), math.ceil(factor * small.height))
    return replace(lens, width=lens.width // 2 * 2, height=lens.height // 2 * 2)


def render_frames(
    completion: Completion, cameras: Sequence[Camera], renderer: Renderer
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Render the frames, there and back."""
    images = []
    for camera in track(cameras, "video"):
        images.append(render_frame(completion, camera, renderer))
        yield images[-1]
    # Backwards without the last frame and the first one, which the loop shows next.
    yield from images[-2:0:-1]


def render_frame(
    completion: Completion, camera: Camera, renderer: Renderer
) -> UInt8[np.ndarray, "h w 3"]:
    """Render before and after side by side on white, with labels."""
    pair = render_before_after(completion, camera, renderer)
    before = draw_corner_label(convert_to_pixels(pair.before.image), "before")
    after = draw_corner_label(convert_to_pixels(pair.after.image), "after")
    gap = np.full((camera.height, GAP_PIXELS, 3), 255, dtype=np.uint8)
    return np.concatenate([before, gap, after], axis=1)


def draw_corner_label(image: UInt8[np.ndarray, "h w 3"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Write a label in the corner, white on a dark box."""
    size = max(12, image.shape[0] // 24)
    font = ImageFont.load_default(size)
    canvas = Image.fromarray(image)
    draw = ImageDraw.Draw(canvas, "RGBA")
    inset = size // 2
    left, top, right, bottom = draw.textbbox((2 * inset, 2 * inset), name, font, anchor="lt")
    field = (left - inset, top - inset, right + inset, bottom + inset)
    draw.rounded_rectangle(field, radius=inset, fill=(0, 0, 0, 150))
    draw.text((2 * inset, 2 * inset), name, (255, 255, 255), font, anchor="lt")
    return np.asarray(canvas)


def plan_camera_path(
    stops: Sequence[Camera], photographs: Sequence[Camera], count: int
) -> list[Camera]:
    """Plan a path through two or more stops, with `count` frames from one to the next."""
    legs = [follow_path(find_waypoints(a, b, photographs), count) for a, b in pairwise(stops)]
    return [*(camera for each in legs for camera in each[:-1]), stops[-1]]


def find_waypoints(first: Camera, second: Camera, photographs: Sequence[Camera]) -> list[Camera]:
    """Find the path along photographs with the smallest sum of squared steps."""
    # Imported here, since SciPy is slow to import and only videos need it.
    from scipy.sparse.csgraph import csgraph_from_dense, shortest_path

    # Squared steps make many short ones cheaper than one long one, so that the path follows the
    # photographs. Positions and viewing directions count together (`embed_cameras`).
    cameras = [first, *photographs, second]
    where = embed_cameras(cameras).double().cpu()
    squares = (where[:, None] - where).square().sum(dim=-1).numpy()
    # In a plain array SciPy takes steps below 1e-8 for none, as between two cameras of one pose.
    graph = csgraph_from_dense(squares, null_value=np.inf)
    _, before = shortest_path(graph, indices=0, return_predecessors=True)
    # Predecessors lead from the second camera back to the first, which has index 0.
    way = [second]
    number = before[-1]
    while number > 0:
        way.append(cameras[number])
        number = before[number]
    return [first, *way[::-1]]


def follow_path(way: Sequence[Camera], count: int) -> list[Camera]:
    """Plan the path of a leg in `count` steps, with the intrinsics of its first camera.

    Centres, right and forward axes follow a cubic B-spline from the first camera to the last, past
    the others. Between level cameras the right axes are level, and so the horizon stays level.
    """
    from scipy.interpolate import BSpline

    degree = min(3, len(way) - 1)
    # The columns right, forward and centre; the down axis follows from the first two.
    poses = torch.stack([camera.c2w[:3, [0, 2, 3]] for camera in way]).double().cpu().numpy()
    # Repeated knots at both ends: the curve begins at the first camera and ends at the last.
    knots = np.pad(np.linspace(0, 1, len(way) - degree + 1), degree, mode="edge")
    smooth = BSpline(knots, poses, degree)
    shares = np.linspace(0, 1, count + 1)
    eased = shares**2 * (3 - 2 * shares)  # zero speed at both ends
    return [make_path_camera(way[0], *pose.T) for pose in smooth(eased)]


def make_path_camera(
    lens: Camera,
    right: Float[np.ndarray, "3"],
    forward: Float[np.ndarray, "3"],
    center: Float[np.ndarray, "3"],
) -> Camera:
    """Give a camera another pose; the axes are made orthonormal, the right one first."""
    # QR orthonormalises the columns in their order, up to their signs.
    axes, signs = np.linalg.qr(np.column_stack([right, forward]))
    right, forward = (axes * np.where(np.diag(signs) < 0, -1, 1)).T
    pose = np.column_stack([right, np.cross(forward, right), forward, center])
    c2w = torch.from_numpy(np.concatenate([pose, [[0, 0, 0, 1]]]))
    return replace(lens, c2w=c2w.to(lens.c2w))
