"""Choice of frames of a video that serve as photographs.

The video is decoded twice: at a small size, to measure how sharp each frame is and how far the
image has moved, then only the chosen frames are kept. Motion is counted in steps from one
reference frame to the next, so that a camera that stands still and trembles adds none.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from gscompleter.data.limits import require
from gscompleter.errors import quote_value
from gscompleter.io.video import read_frames
from gscompleter.progress import stage

ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".webm")
"""Endings of videos, in any case."""
NUM_FRAMES = 40
"""Default number of frames to choose."""
MIN_FRAMES, MAX_FRAMES = 3, 1000
SMALL_SIDE = 640
"""Longer side in pixels at which frames are measured."""
STEP = 0.02
"""Median motion from one reference frame to the next, in longer sides."""
NUM_CORNERS = 200
"""Most corners that are tracked."""
MIN_CORNERS = 20
"""Fewest corners of a reference frame."""
MIN_TRACKED = 0.5
"""Share of the corners below which the reference frame is out of sight."""
QUALITY = 95
"""JPEG quality of the chosen frames."""


def is_video(path: Path) -> bool:
    """Check whether a file is called like a video."""
    return path.suffix.lower() in ENDINGS and not path.is_dir()


def extract_frames(video: Path, folder: Path, count: int) -> None:
    """Write at most `count` sharp frames of a video, upright, to `folder` as JPEGs.

    They are named by their numbers in the video.
    """
    require(
        MIN_FRAMES <= count <= MAX_FRAMES,
        f"{count} frames of a video are not possible; choose {MIN_FRAMES} to {MAX_FRAMES}.",
    )
    size = f"w={SMALL_SIDE}:h={SMALL_SIDE}:force_original_aspect_ratio=decrease"
    with stage("Choosing frames"):
        small = read_frames(video, f"scale={size}:flags=area", is_grey=True)
        chosen = select_frames(*measure_frames(small), count)
        require(
            len(chosen) >= MIN_FRAMES,
            f"{quote_value(video, 80)} has {len(chosen)} frames that differ in what they show, and "
            f"{MIN_FRAMES} are needed; film for longer, and walk around the scene.",
        )
        images = read_frames(video, f"select='{_write_choice(chosen)}'", is_grey=False)
        for number, pixels in zip(chosen, images, strict=True):
            path = folder / f"frame_{number:06d}.jpg"
            Image.fromarray(pixels).save(path, quality=QUALITY, subsampling=0)


def measure_frames(
    frames: Iterable[UInt8[np.ndarray, "h w"]],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Measure the variance of the Laplacian of each frame, and its motion since the first one.

    Motion is in steps of `STEP`; the fraction is the way from the last reference frame.
    """
    sharpness, motion = list[float](), list[float]()
    reference, corners, steps = np.zeros((0, 0), np.uint8), np.zeros((0, 1, 2), np.float32), 0
    for frame in frames:
        sharpness.append(float(cv2.Laplacian(frame, cv2.CV_32F).var()))
        share = _measure_motion(reference, corners, frame) if len(corners) else 0.0
        motion.append(steps + share)
        steps += share == 1
        if share == 1 or not len(corners):
            reference, corners = frame, _find_corners(frame)
    return np.array(sharpness), np.array(motion)


def _find_corners(frame: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "n 1 2"]:
    """Find corners to track; none in a frame with few."""
    found = cv2.goodFeaturesToTrack(frame, NUM_CORNERS, 0.01, max(frame.shape) / 40)
    none = np.zeros((0, 1, 2), np.float32)
    return none if found is None or len(found) < MIN_CORNERS else found


def _measure_motion(
    reference: UInt8[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 1 2"],
    frame: UInt8[np.ndarray, "h w"],
) -> float:
    """Measure the median motion of corners in steps, at most 1; 1 if most are lost."""
    if frame.shape != reference.shape:
        return 1.0
    found, status, _ = cv2.calcOpticalFlowPyrLK(reference, frame, corners, None)
    is_tracked = status.ravel() == 1
    if is_tracked.mean() < MIN_TRACKED:
        return 1.0
    moved = np.linalg.norm((found - corners)[is_tracked], axis=-1)
    return min(float(np.median(moved)) / (STEP * max(frame.shape)), 1.0)


def select_frames(
    sharpness: Float[np.ndarray, "n"], motion: Float[np.ndarray, "n"], count: int
) -> list[int]:
    """Select the sharpest frame of each of at most `count` windows of equal motion.

    Only the first half of a window counts, so that chosen frames are half a step apart or more.
    """
    steps = int(motion.max(initial=-1)) + 1
    windows = min(count, steps)
    bounds = [steps * number // max(windows, 1) for number in range(windows + 1)]
    return [_find_sharpest(sharpness, motion, a, (a + b) / 2) for a, b in pairwise(bounds)]


def _find_sharpest(
    sharpness: Float[np.ndarray, "n"], motion: Float[np.ndarray, "n"], start: float, end: float
) -> int:
    """Find the sharpest frame whose motion is in [start, end)."""
    inside = (start <= motion) & (motion < end)
    return int(np.where(inside, sharpness, -1.0).argmax())


def _write_choice(numbers: Sequence[int]) -> str:
    """Write the choice of frames as an expression of ffmpeg, whose sums may not be long."""
    if len(numbers) == 1:
        return f"eq(n,{numbers[0]})"
    half = len(numbers) // 2
    return f"({_write_choice(numbers[:half])}+{_write_choice(numbers[half:])})"
