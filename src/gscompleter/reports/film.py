"""A film of a completion: a way through the holes, before and after side by side.

The camera starts at the photograph nearest to the first target, goes through each target, and comes
back the same way, so that it may be shown again and again, and every picture is drawn once.
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
"""The file in the output folder."""
RATE = 24
"""Frames per second."""
SECONDS = 3.0
"""Of the way there; the way back takes as long."""
FRAMES = round(RATE * SECONDS)
"""Frames that are drawn where targets are few."""
MIN_LEG = 0.75
"""Seconds, at least, from one camera to the next."""
MAX_TARGETS = 6
"""Targets that it goes through at most: the first ones."""
MAX_SIDE = 640
"""Pixels of the longer side of one half at most, where that is no narrower than `MIN_WIDTH`."""
GAP = 4
"""Pixels between the halves."""
MIN_WIDTH = 720
"""Pixels of a row of the film at least, both halves and the gap together."""
LABEL = 12
"""Pixels of the letters at least."""
MAX_PHOTOGRAPHS = 200
"""Photographs, evenly drawn from all, that it may come by."""


def write_film(
    folder: Path, completion: Completion, photographs: Sequence[Camera], renderer: Renderer
) -> None:
    """Write `video.mp4` into a folder that nobody reads yet; nothing where there is no target.

    Args:
        folder: Where to.
        completion: What was done.
        photographs: Cameras of all photographs, in the frame of the result.
        renderer: Draws the scene before and after.

    Raises:
        InputError: where ffmpeg fails.
    """
    if not completion.targets:
        return
    way = stops(completion)
    count = round(RATE * max(SECONDS / (len(way) - 1), MIN_LEG))
    cameras = path_through(way, spread(photographs, MAX_PHOTOGRAPHS), count)
    write_video(folder / NAME, frames(completion, cameras, renderer), RATE)


def stops(completion: Completion) -> list[Camera]:
    """The cameras that the film comes by: a photograph's, and those of targets where something was
    added, or of all where nothing was. All see as the first target does."""
    results = [r for r in completion.targets if len(r.added)] or list(completion.targets)
    targets = [result.target for result in results[:MAX_TARGETS]]
    photographs = [view.camera for view in completion.views]
    nearest = min(photographs, key=lambda camera: baseline_between(camera, targets[0]))
    lens = even(widened(shrunk(completion.ranged(targets[0]), MAX_SIDE)))
    return [replace(lens, c2w=camera.c2w.to(lens.c2w)) for camera in (nearest, *targets)]


def widened(camera: Camera) -> Camera:
    """Enlarge the image of a camera, if need be, so that two of them make a film."""
    factor = max((MIN_WIDTH - GAP) / 2 / camera.width, 1.0)
    return resized(camera, math.ceil(factor * camera.width), math.ceil(factor * camera.height))


def even(camera: Camera) -> Camera:
    """`camera` without the last column and row of its image where their number is odd."""
    return replace(camera, width=camera.width // 2 * 2, height=camera.height // 2 * 2)


def frames(
    completion: Completion, cameras: Sequence[Camera], renderer: Renderer
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """What `cameras` see before and after, there and back."""
    drawn = []
    for camera in track(cameras, "video"):
        drawn.append(frame(completion, camera, renderer))
        yield drawn[-1]
    yield from drawn[-2:0:-1]


def frame(completion: Completion, camera: Camera, renderer: Renderer) -> UInt8[np.ndarray, "h w 3"]:
    """Before and after side by side on white, each with its name."""
    images = compare(completion, camera, None, renderer)
    before = labelled(as_pixels(images.before.image), "before")
    after = labelled(as_pixels(images.after.image), "after")
    gap = np.full((camera.height, GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([before, gap, after], axis=1)


def labelled(image: UInt8[np.ndarray, "h w 3"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    """`image` with its name in a corner, white on a dark field, so that it can be read on all."""
    size = max(LABEL, image.shape[0] // 24)
    font, canvas = ImageFont.load_default(size), Image.fromarray(image)
    draw, inset = ImageDraw.Draw(canvas, "RGBA"), size // 2
    left, top, right, bottom = draw.textbbox((2 * inset, 2 * inset), name, font, anchor="lt")
    field = (left - inset, top - inset, right + inset, bottom + inset)
    draw.rounded_rectangle(field, radius=inset, fill=(0, 0, 0, 150))
    draw.text((2 * inset, 2 * inset), name, (255, 255, 255), font, anchor="lt")
    return np.asarray(canvas)
