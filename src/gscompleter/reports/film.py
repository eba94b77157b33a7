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

from gscompleter.geometry import baseline_between
from gscompleter.io.image import as_pixels
from gscompleter.io.video import write_video
from gscompleter.progress import track
from gscompleter.render import Renderer
from gscompleter.reports.completion import compare
from gscompleter.reports.film_path import path_through
from gscompleter.reports.record import spread
from gscompleter.stages.candidates import resized, shrunk
from gscompleter.types import Camera, Completion

NAME = "video.mp4"
RATE = 24
SECONDS = 3.0
"""Duration of one direction."""
FRAMES = round(RATE * SECONDS)
"""Frames rendered if there are few targets."""
MIN_LEG = 0.75
MAX_TARGETS = 6
MAX_SIDE = 640
"""Longer side of one half in pixels, unless `MIN_WIDTH` needs more."""
GAP = 4
MIN_WIDTH = 720
"""Smallest width of the video in pixels."""
LABEL = 12
MAX_PHOTOGRAPHS = 200


def write_film(
    folder: Path, completion: Completion, photographs: Sequence[Camera], renderer: Renderer
) -> None:
    """Write `video.mp4`, or nothing without a target."""
    if not completion.targets:
        return
    way = stops(completion)
    count = round(RATE * max(SECONDS / (len(way) - 1), MIN_LEG))
    cameras = path_through(way, spread(photographs, MAX_PHOTOGRAPHS), count)
    write_video(folder / NAME, frames(completion, cameras, renderer), RATE)


def stops(completion: Completion) -> list[Camera]:
    """Choose a photograph and the targets with added Gaussians, or all targets if none has any.

    All cameras get the intrinsics of the first target.
    """
    results = [r for r in completion.targets if len(r.added)] or list(completion.targets)
    targets = [result.target for result in results[:MAX_TARGETS]]
    photographs = [view.camera for view in completion.views]
    nearest = min(photographs, key=lambda camera: baseline_between(camera, targets[0]))
    lens = even(widened(shrunk(completion.ranged(targets[0]), MAX_SIDE)))
    return [replace(lens, c2w=camera.c2w.to(lens.c2w)) for camera in (nearest, *targets)]


def widened(camera: Camera) -> Camera:
    """Enlarge the image if two of them are narrower than the video."""
    factor = max((MIN_WIDTH - GAP) / 2 / camera.width, 1.0)
    return resized(camera, math.ceil(factor * camera.width), math.ceil(factor * camera.height))


def even(camera: Camera) -> Camera:
    """Crop the image to an even width and height."""
    return replace(camera, width=camera.width // 2 * 2, height=camera.height // 2 * 2)


def frames(
    completion: Completion, cameras: Sequence[Camera], renderer: Renderer
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Render the frames, there and back."""
    images = []
    for camera in track(cameras, "video"):
        images.append(frame(completion, camera, renderer))
        yield images[-1]
    yield from images[-2:0:-1]


def frame(completion: Completion, camera: Camera, renderer: Renderer) -> UInt8[np.ndarray, "h w 3"]:
    """Render before and after side by side on white, with labels."""
    images = compare(completion, camera, None, renderer)
    before = labelled(as_pixels(images.before.image), "before")
    after = labelled(as_pixels(images.after.image), "after")
    gap = np.full((camera.height, GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([before, gap, after], axis=1)


def labelled(image: UInt8[np.ndarray, "h w 3"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Write a label in the corner, white on a dark box."""
    size = max(LABEL, image.shape[0] // 24)
    font, canvas = ImageFont.load_default(size), Image.fromarray(image)
    draw, inset = ImageDraw.Draw(canvas, "RGBA"), size // 2
    left, top, right, bottom = draw.textbbox((2 * inset, 2 * inset), name, font, anchor="lt")
    field = (left - inset, top - inset, right + inset, bottom + inset)
    draw.rounded_rectangle(field, radius=inset, fill=(0, 0, 0, 150))
    draw.text((2 * inset, 2 * inset), name, (255, 255, 255), font, anchor="lt")
    return np.asarray(canvas)
