"""How far a render shows things from where the photograph shows them."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

MIN_TRACKED = 15
"""Fewest corners that must be followed for their drift to tell anything."""
MAX_CORNERS = 200
MAX_RETURN = 1.0
"""Pixels by which a corner may miss where it came from when it is followed back."""
Grey = UInt8[np.ndarray, "h w"]
Corners = Float[np.ndarray, "n 1 2"]


def drift(
    drawn: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]
) -> float:
    """Median distance in pixels between corners of a render and where a photograph has them.

    Corners are followed by their surroundings (Lucas and Kanade), there and back. Infinity where
    too few can be.

    Args:
        drawn: Brightness of the render, in the exposure of the photograph.
        truth: Brightness of the photograph.
        where: The pixels that the render covers.
    """
    render, photograph = grey(drawn), grey(truth)
    mask = where.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(render, MAX_CORNERS, 0.01, 5, mask=mask)
    if corners is None or len(corners) < MIN_TRACKED:
        return math.inf
    there, found = followed(render, photograph, corners)
    back, found_again = followed(photograph, render, there)
    returned = np.linalg.norm(back - corners, axis=2)[:, 0] < MAX_RETURN
    trusted = found & found_again & returned
    if trusted.sum() < MIN_TRACKED:
        return math.inf
    return float(np.median(np.linalg.norm(there - corners, axis=2)[trusted]))


def followed(before: Grey, after: Grey, corners: Corners) -> tuple[Corners, Bool[np.ndarray, "n"]]:
    """Where corners of one image are in another, and which of them were found.

    Windows of 15 px on four levels reach for about 50 px.
    """
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, corners, np.zeros_like(corners), winSize=(15, 15), maxLevel=3
    )
    return np.asarray(moved), np.asarray(status)[:, 0] > 0


def grey(brightness: Float[np.ndarray, "h w"]) -> Grey:
    """Brightness in [0, 1] as bytes."""
    return (255 * brightness.clip(0, 1)).round().astype(np.uint8)
