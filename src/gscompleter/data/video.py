"""Choice of frames of a video that serve as photographs.

The video is decoded twice: at a small size to measure sharpness and motion, then to keep the chosen
frames. Motion is counted in steps between reference frames, so that trembling adds none.
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
from gscompleter.system.errors import quote_value
from gscompleter.system.files.video import read_video
from gscompleter.system.progress import stage

Image8 = UInt8[np.ndarray, "h w"]
MotionCorners = Float[np.ndarray, "n 1 2"]
Values = Float[np.ndarray, "n"]

SOURCE_VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".webm")
"""Endings of videos, in any case."""
MIN_FRAMES = 3
"""Fewest frames of which cameras can be found."""
SMALL_SIDE = 640
"""Longer side in pixels at which frames are measured."""
REFERENCE_MOTION = 0.02
"""Motion from one reference frame to the next, in longer sides."""
MOTION_QUANTILE = 0.75
"""Quantile of the motions of corners; around a thing at the centre most move little."""
NUM_CORNERS = 200
"""Most corners that are tracked."""
MIN_TRACKED = 0.5
"""Share of corners below which the reference frame is out of sight."""
FRAME_JPEG_QUALITY = 95
"""JPEG quality of the chosen frames."""


def is_video(path: Path) -> bool:
    """Check whether `path` is a file with the name of a video."""
    return path.suffix.lower() in SOURCE_VIDEO_ENDINGS and path.is_file()


def extract_frames(video: Path, folder: Path, count: int) -> None:
    """Write at most `count` sharp frames of a video, upright, as JPEGs named by their numbers."""
    # ffmpeg shrinks the frames itself, which saves their transport; small ones stay as they are.
    size = f"'min({SMALL_SIDE},iw)':'min({SMALL_SIDE},ih)':force_original_aspect_ratio=decrease"
    with stage("Choosing frames"):
        small = read_video(video, f"scale={size}:flags=area", is_grey=True)
        chosen = select_frames(*measure_frames(small), count)
        require(
            len(chosen) >= MIN_FRAMES,
            f"The camera hardly moves in {quote_value(video, 80)}, of which {len(chosen)} frames "
            f"differ and {MIN_FRAMES} are needed; film for longer, and walk around the scene.",
        )
        images = read_video(video, f"select='{_write_choice(chosen)}'", is_grey=False)
        for number, pixels in zip(chosen, images, strict=True):
            path = folder / f"frame_{number:06d}.jpg"
            Image.fromarray(pixels).save(path, quality=FRAME_JPEG_QUALITY, subsampling=0)


def measure_frames(frames: Iterable[Image8]) -> tuple[Values, Values]:
    """Measure the variance of the Laplacian of each frame, and its motion since the first one.

    Motion is in steps of `REFERENCE_MOTION`; the fraction is the way from the last reference frame.
    """
    sharpness = list[float]()
    motion = list[float]()
    reference = np.zeros((0, 0), np.uint8)
    corners = None
    steps = 0
    for frame in frames:
        sharpness.append(float(cv2.Laplacian(frame, cv2.CV_32F).var()))
        # The fraction of a step that the frame has moved; a full step makes it the next reference.
        share = 0.0 if corners is None else _measure_motion(reference, corners, frame)
        motion.append(steps + share)
        steps += share == 1
        if share == 1 or corners is None:
            reference = frame
            # Corners in a grid of at least 1/40 of the image, so that they spread over all of it.
            distance = max(frame.shape) / 40
            corners = cv2.goodFeaturesToTrack(frame, NUM_CORNERS, 0.01, distance)
    return np.array(sharpness), np.array(motion)


def _measure_motion(reference: Image8, corners: MotionCorners, frame: Image8) -> float:
    """Measure the motion of most corners in steps, at most 1; 1 if too many are lost."""
    corners_now, status, _ = cv2.calcOpticalFlowPyrLK(reference, frame, corners, corners.copy())
    if status.mean() < MIN_TRACKED:
        return 1.0
    moved = np.linalg.norm((corners_now - corners)[status == 1], axis=-1)
    steps = np.quantile(moved, MOTION_QUANTILE) / (REFERENCE_MOTION * max(frame.shape))
    return min(float(steps), 1.0)


def select_frames(sharpness: Values, motion: Values, count: int) -> list[int]:
    """Select the sharpest frame of each of at most `count` windows of equal motion.

    Selected frames are at least half a window apart; a window may have none.
    """
    if len(motion) == 0:
        return []
    # Windows of whole steps: the camera has moved by as much in each, however fast it went.
    steps = int(motion.max()) + 1
    windows = min(count, steps)
    bounds = [steps * n // windows for n in range(windows + 1)]
    selected = list[int]()
    last = -np.inf
    for start, end in pairwise(bounds):
        inside = (motion >= max(start, last + (end - start) / 2)) & (motion < end)
        if inside.any():
            selected.append(int(np.where(inside, sharpness, -1.0).argmax()))
            last = motion[selected[-1]]
    return selected


def _write_choice(numbers: Sequence[int]) -> str:
    """Write the choice of frames as an expression of ffmpeg, whose sums may not be long."""
    if len(numbers) == 1:
        return f"eq(n,{numbers[0]})"
    half = len(numbers) // 2
    return f"({_write_choice(numbers[:half])}+{_write_choice(numbers[half:])})"
