"""A video that moves through the completed holes, before and after side by side.

The camera starts at the photograph nearest to the first target, passes all targets and returns the
same way, so the video can loop and each frame is rendered once. Its path is smooth, with a level
horizon, and near the photographs: there is free space, and the scene is sharpest.
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
from torch import Tensor
from torch.nn.functional import normalize

from gscompleter.apps.report.completion import MAX_PHOTOGRAPHS, render_before_after, thin_evenly
from gscompleter.geometry import (
    embed_cameras,
    estimate_up,
    measure_baseline,
    resize_camera,
    shrink_camera,
)
from gscompleter.io.image import convert_to_pixels
from gscompleter.io.video import write_video
from gscompleter.next_best_view.candidates import interpolate_camera
from gscompleter.progress import track
from gscompleter.render import Renderer
from gscompleter.state import Completion
from gscompleter.types import Camera

VIDEO_FILE = "video.mp4"
FRAMES_PER_SECOND = 24
ONE_WAY_SECONDS = 3.0
"""Duration of one direction."""
MIN_LEG_SECONDS = 0.75
MAX_TARGETS = 6
MAX_SIDE = 640
"""Longer side of one half in pixels, unless `MIN_WIDTH` needs more."""
GAP_PIXELS = 4
MIN_WIDTH = 720
"""Smallest width of the video in pixels."""
MIN_LABEL_SIZE = 12
SMOOTHING_FRACTION = 0.15
"""Half width of the smoothing window, as a fraction of a leg."""
UP_WEIGHT = 1e-3
"""Weight of the image's up direction against level image rows."""
MIN_UPRIGHT_COSINE = 0.7
"""Cosine limit between a camera's up direction and the mean for cameras held upright."""
MAX_LEVEL_COSINE = 0.99
"""Cosine to the vertical above which a camera has no horizon."""


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
    """Choose a photograph and the targets with added Gaussians, or all targets if none has any.

    All cameras get the intrinsics of the first target.
    """
    results = [r for r in completion.targets if len(r.added)] or list(completion.targets)
    targets = [result.target for result in results[:MAX_TARGETS]]
    photographs = [view.camera for view in completion.views]
    nearest = min(photographs, key=lambda camera: measure_baseline(camera, targets[0]))
    lens = fit_to_video(completion.with_depth_range(targets[0]))
    return [replace(lens, c2w=camera.c2w.to(lens.c2w)) for camera in (nearest, *targets)]


def fit_to_video(camera: Camera) -> Camera:
    """Resize the image to one half of the video, with an even width and height."""
    small = shrink_camera(camera, MAX_SIDE)
    factor = max((MIN_WIDTH - GAP_PIXELS) / 2 / small.width, 1.0)
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
    yield from images[-2:0:-1]


def render_frame(
    completion: Completion, camera: Camera, renderer: Renderer
) -> UInt8[np.ndarray, "h w 3"]:
    """Render before and after side by side on white, with labels."""
    images = render_before_after(completion, camera, None, renderer)
    before, after = (
        draw_corner_label(convert_to_pixels(getattr(images, when).image), when)
        for when in ("before", "after")
    )
    gap = np.full((camera.height, GAP_PIXELS, 3), 255, dtype=np.uint8)
    return np.concatenate([before, gap, after], axis=1)


def draw_corner_label(image: UInt8[np.ndarray, "h w 3"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Write a label in the corner, white on a dark box."""
    size = max(MIN_LABEL_SIZE, image.shape[0] // 24)
    font, canvas = ImageFont.load_default(size), Image.fromarray(image)
    draw, inset = ImageDraw.Draw(canvas, "RGBA"), size // 2
    left, top, right, bottom = draw.textbbox((2 * inset, 2 * inset), name, font, anchor="lt")
    field = (left - inset, top - inset, right + inset, bottom + inset)
    draw.rounded_rectangle(field, radius=inset, fill=(0, 0, 0, 150))
    draw.text((2 * inset, 2 * inset), name, (255, 255, 255), font, anchor="lt")
    return np.asarray(canvas)


def plan_camera_path(
    stops: Sequence[Camera], photographs: Sequence[Camera], count: int
) -> list[Camera]:
    """Plan a path through two or more stops, with `count` frames from one to the next.

    It slows down at each stop and may pass the photographs.
    """
    up = fit_vertical([*stops, *photographs])
    legs = [plan_leg(a, b, photographs, up, count) for a, b in pairwise(stops)]
    return [*(camera for each in legs for camera in each[:-1]), stops[-1]]


def plan_leg(
    first: Camera,
    second: Camera,
    photographs: Sequence[Camera],
    up: Float[Tensor, "3"],
    count: int,
) -> list[Camera]:
    """Plan `count` cameras from `first` on, and `second`."""
    way = find_waypoints(first, second, photographs)
    shares = [k / count for k in range(count + 1)]
    eased = [share * share * (3 - 2 * share) for share in shares]  # zero speed at both ends
    sharp = [interpolate_path(way, share) for share in eased]
    widths = [min(k, count - k, round(SMOOTHING_FRACTION * count)) for k in range(count + 1)]
    rounded = [average_cameras(sharp[k - width : k + width + 1]) for k, width in enumerate(widths)]
    if max(abs((camera.forward @ up).item()) for camera in rounded) > MAX_LEVEL_COSINE:
        return rounded
    start = measure_roll(first, up)
    turn = math.remainder(measure_roll(second, up) - start, 2 * math.pi)
    return [set_roll(c, start + turn * k / count, up) for k, c in enumerate(rounded)]


def fit_vertical(cameras: Sequence[Camera]) -> Float[Tensor, "3"]:
    """Estimate the unit up direction, to which image rows of level cameras are orthogonal."""
    about = estimate_up(cameras).double()
    axes = torch.stack([camera.c2w[:3, :2].T for camera in cameras]).double()
    rows = axes[-axes[:, 1] @ about > MIN_UPRIGHT_COSINE, 0]
    # If all cameras have the same direction, several axes are orthogonal to the rows.
    slant = rows.T @ rows / len(rows) - UP_WEIGHT * torch.outer(about, about)
    axis = torch.linalg.eigh(slant).eigenvectors[:, 0]
    return (axis if axis @ about > 0 else -axis).to(cameras[0].c2w)


def find_waypoints(first: Camera, second: Camera, photographs: Sequence[Camera]) -> list[Camera]:
    """Find the path along photographs with the smallest sum of squared steps.

    It prefers many short steps. All cameras get the intrinsics of `first`.
    """
    # Imported here, since SciPy is slow to import and only videos need it.
    from scipy.sparse.csgraph import shortest_path

    cameras = [first, *photographs, second]
    where = embed_cameras(cameras).double().cpu()
    squares = (where[:, None] - where).square().sum(dim=-1).numpy()
    _, before = shortest_path(squares, indices=0, return_predecessors=True)
    way, number = [second], before[-1]
    while number > 0:
        way.append(replace(first, c2w=cameras[number].c2w.to(first.c2w)))
        number = before[number]
    return [first, *way[::-1]]


def interpolate_path(way: Sequence[Camera], share: float) -> Camera:
    """Interpolate the path at a fraction of its length."""
    where = embed_cameras(way).double().cpu()
    ends = np.concatenate([[0.0], np.cumsum((where[1:] - where[:-1]).norm(dim=1).numpy())])
    done = share * ends[-1]
    number = min(int(np.searchsorted(ends, done, side="right")), len(way) - 1)
    length = max(ends[number] - ends[number - 1], 1e-30)
    return interpolate_camera(
        way[number - 1], way[number], float((done - ends[number - 1]) / length)
    )


def average_cameras(cameras: Sequence[Camera]) -> Camera:
    """Average cameras that are close to each other."""
    c2w = torch.stack([camera.c2w for camera in cameras]).double().mean(dim=0)
    left, _, right = torch.linalg.svd(c2w[:3, :3])
    c2w[:3, :3] = left @ right
    return replace(cameras[0], c2w=c2w.to(cameras[0].c2w))


def compute_level_axes(camera: Camera, up: Float[Tensor, "3"]) -> tuple[Tensor, Tensor]:
    """Compute the right [3] and down [3] axes of a level camera with the same direction."""
    right = normalize(torch.linalg.cross(camera.forward, up), dim=0)
    return right, torch.linalg.cross(camera.forward, right)


def measure_roll(camera: Camera, up: Float[Tensor, "3"]) -> float:
    """Measure the rotation about the viewing direction, in radians from level."""
    right, down = compute_level_axes(camera, up)
    across = camera.c2w[:3, 0]
    return math.atan2((across @ down).item(), (across @ right).item())


def set_roll(camera: Camera, angle: float, up: Float[Tensor, "3"]) -> Camera:
    """Set the roll of a camera, in radians."""
    right, down = compute_level_axes(camera, up)
    cos, sin = math.cos(angle), math.sin(angle)
    c2w = camera.c2w.clone()
    c2w[:3, 0], c2w[:3, 1] = cos * right + sin * down, cos * down - sin * right
    return replace(camera, c2w=c2w)
