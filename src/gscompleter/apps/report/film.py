"""A video that moves through the completed holes, before and after side by side.

The camera starts at the photograph nearest to the first target, passes all targets and returns the
same way, so the video can loop and each frame is rendered once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from gscompleter.apps.report.completion import render_before_after
from gscompleter.apps.report.film_path import plan_camera_path
from gscompleter.apps.report.record import thin_evenly
from gscompleter.geometry import measure_baseline, resize_camera, shrink_camera
from gscompleter.io.image import convert_to_pixels
from gscompleter.io.video import write_video
from gscompleter.progress import track
from gscompleter.render import Renderer
from gscompleter.state import Completion
from gscompleter.types import Camera

VIDEO_FILE = "video.mp4"
FRAMES_PER_SECOND = 24
ONE_WAY_SECONDS = 3.0
"""Duration of one direction."""
ONE_WAY_FRAMES = round(FRAMES_PER_SECOND * ONE_WAY_SECONDS)
"""Frames rendered if there are few targets."""
MIN_LEG_SECONDS = 0.75
MAX_TARGETS = 6
MAX_SIDE = 640
"""Longer side of one half in pixels, unless `MIN_WIDTH` needs more."""
GAP_PIXELS = 4
MIN_WIDTH = 720
"""Smallest width of the video in pixels."""
MIN_LABEL_SIZE = 12
MAX_PHOTOGRAPHS = 200


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
    lens = crop_to_even(
        enlarge_for_video(shrink_camera(completion.with_depth_range(targets[0]), MAX_SIDE))
    )
    return [replace(lens, c2w=camera.c2w.to(lens.c2w)) for camera in (nearest, *targets)]


def enlarge_for_video(camera: Camera) -> Camera:
    """Enlarge the image if two of them are narrower than the video."""
    factor = max((MIN_WIDTH - GAP_PIXELS) / 2 / camera.width, 1.0)
    return resize_camera(
        camera, math.ceil(factor * camera.width), math.ceil(factor * camera.height)
    )


def crop_to_even(camera: Camera) -> Camera:
    """Crop the image to an even width and height."""
    return replace(camera, width=camera.width // 2 * 2, height=camera.height // 2 * 2)


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
    before = draw_corner_label(convert_to_pixels(images.before.image), "before")
    after = draw_corner_label(convert_to_pixels(images.after.image), "after")
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
