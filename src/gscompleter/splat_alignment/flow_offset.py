"""Displacement between a render and a photograph, by optical flow."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

MIN_TRACKED_CORNERS = 15
"""Fewest tracked corners for a valid median."""
MAX_CORNERS = 200
MAX_ROUND_TRIP_ERROR = 1.0
"""Largest error of a corner tracked forward and back, in pixels."""
GreyBytes = UInt8[np.ndarray, "h w"]
Corners = Float[np.ndarray, "n 1 2"]


def measure_drift(
    rendered: Float[np.ndarray, "h w"],
    truth: Float[np.ndarray, "h w"],
    valid_mask: Bool[np.ndarray, "h w"],
) -> float:
    """Compute the median displacement of corners from a render to a photograph, in pixels.

    Both are brightness in the exposure of the photograph. Corners in the valid pixels are tracked
    forward and back (Lucas-Kanade). Infinity if too few survive.
    """
    render, photograph = convert_to_grey_bytes(rendered), convert_to_grey_bytes(truth)
    mask = valid_mask.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(render, MAX_CORNERS, 0.01, 5, mask=mask)
    if corners is None or len(corners) < MIN_TRACKED_CORNERS:
        return math.inf
    there, found = track_corners(render, photograph, corners)
    back, found_again = track_corners(photograph, render, there)
    returned = np.linalg.norm(back - corners, axis=2)[:, 0] < MAX_ROUND_TRIP_ERROR
    trusted = found & found_again & returned
    if trusted.sum() < MIN_TRACKED_CORNERS:
        return math.inf
    return float(np.median(np.linalg.norm(there - corners, axis=2)[trusted]))


def track_corners(
    before: GreyBytes, after: GreyBytes, corners: Corners
) -> tuple[Corners, Bool[np.ndarray, "n"]]:
    """Track corners by up to about 50 px to another image, and mark those that were found."""
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, corners, np.zeros_like(corners), winSize=(15, 15), maxLevel=3
    )
    return np.asarray(moved), np.asarray(status)[:, 0] > 0


def convert_to_grey_bytes(brightness: Float[np.ndarray, "h w"]) -> GreyBytes:
    """Convert brightness in [0, 1] to bytes."""
    return (255 * brightness.clip(0, 1)).round().astype(np.uint8)
