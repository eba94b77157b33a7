"""SIFT features (Lowe 2004), their matches in two photographs, and the depth of the matches."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
)

Features = tuple[Float[np.ndarray, "_ 2"], UInt8[np.ndarray, "_ 128"]]
"""Pixels (the centre of the top-left one is (0.5, 0.5)) and descriptors."""
Pixels = Float[np.ndarray, "m 2"]

CACHE_SIZE = 128
"""Images whose features are cached, each 0.3 MB and a byte for each pixel: poses, stereo, each
target and the report match the same photographs."""
MAX_EPIPOLAR_DISTANCE = 3.0
"""Largest distance of a match from its epipolar line, in pixels; poses are noisy."""
MIN_DEPTH = 1e-6
"""Smallest z in the source, per z in the reference, that lies in front of it; of rays to infinity,
per their z in the reference as well."""
MIN_PARALLAX = 1.0
"""Smallest parallax that gives a depth, in pixels."""


def detect_features(view: StereoImage) -> Features:
    """Detect the features of a view outside its ignored pixels; the same image is cached."""
    grey = cv2.cvtColor((view.image * 255).clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    pixels, descriptors = _detect_features(grey.tobytes(), grey.shape)
    if view.ignore_mask is None:
        return pixels, descriptors
    columns, rows = pixels.astype(int).T
    counted = ~view.ignore_mask[rows, columns]
    return pixels[counted], descriptors[counted]


@lru_cache(CACHE_SIZE)
def _detect_features(grey: bytes, size: tuple[int, int]) -> Features:
    detector = cv2.SIFT.create(2000, contrastThreshold=0.02)
    image = np.frombuffer(grey, np.uint8).reshape(size)
    keypoints, descriptors = detector.detectAndCompute(image, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.uint8)
    # Descriptors are whole numbers from 0 to 255, in floats.
    return np.array([k.pt for k in keypoints], np.float64) + 0.5, descriptors.astype(np.uint8)


def match_features(a: Features, b: Features) -> tuple[Pixels, Pixels]:
    """Match mutual nearest neighbours that pass the ratio test; return pixels in a and in b."""
    if len(a[0]) < 2 or len(b[0]) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    # Squared distances of all descriptors [features of a, features of b]. Their length is about
    # 512, so that sums of products are whole numbers below 2^24, which 32 bits hold exactly.
    of_a = a[1].astype(np.float32)
    of_b = b[1].astype(np.float32)
    squares = (of_a**2).sum(1)[:, None] + (of_b**2).sum(1)[None] - 2 * of_a @ of_b.T
    forward = squares.argmin(1)
    backward = squares.argmin(0)
    rows = np.arange(len(of_a))
    best = squares[rows, forward]
    squares[rows, forward] = np.inf
    second = squares.min(1)
    # Ratio test (Lowe 2004): 0.8 times the second best distance, squared.
    i = np.flatnonzero((backward[forward] == rows) & (best < 0.64 * second))
    return a[0][i], b[0][forward[i]]


def triangulate_valid(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> Float[np.ndarray, "k"]:
    """Triangulate the valid matches; return inverse z-depth in `reference`."""
    inverse, good = triangulate(reference, source, pixels, matched)
    return inverse[good]


def triangulate(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Triangulate all matches; return inverse z-depth in `reference` and a validity mask."""
    transform = compute_source_from_reference(reference, source).astype(np.float64)
    at_infinity = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ transform[:, :3].T
    b = transform[:, 3]
    # Solve matched * (A p + b w)_2 = (A p + b w)_xy for w by least squares.
    factor = b[:2] - matched * b[2]
    offset = matched * at_infinity[:, 2:] - at_infinity[:, :2]
    inverse = (factor * offset).sum(1) / np.maximum((factor * factor).sum(1), 1e-12)

    # A match is valid if its point lies in front of both cameras, close to the match in the image,
    # and moves between the images by more than the noise.
    at_depth = at_infinity + inverse[:, None] * b
    ahead = (at_depth[:, 2] > MIN_DEPTH) & (at_infinity[:, 2] > MIN_DEPTH)
    scale = np.where(ahead, at_depth[:, 2], 1.0)[:, None]
    error = np.linalg.norm(at_depth[:, :2] / scale - matched, axis=1)
    infinite = at_infinity[:, :2] / np.where(ahead, at_infinity[:, 2], 1.0)[:, None]
    parallax = np.linalg.norm(infinite - matched, axis=1)
    return inverse, ahead & (inverse > 0) & (error < MAX_EPIPOLAR_DISTANCE) & (
        parallax > MIN_PARALLAX
    )


def find_fitting_matches(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> Bool[np.ndarray, "n"]:
    """Find matches that a point before both cameras explains to `MAX_EPIPOLAR_DISTANCE` px."""
    errors, is_ahead = measure_match_errors(reference, source, pixels, matched)
    return is_ahead & (errors < MAX_EPIPOLAR_DISTANCE)


def measure_match_errors(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Measure the pixels from each match to the nearest point of its ray, and if that is ahead.

    Unlike `triangulate`, it accepts points at infinity: a match without parallax has no depth, but
    it confirms the rotation.
    """
    inverse, _ = triangulate(reference, source, pixels, matched)
    transform = compute_source_from_reference(reference, source).astype(np.float64)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ transform[:, :3].T
    # A negative inverse depth lies behind the camera; the nearest possible one is that of infinity.
    points = rays + np.maximum(inverse, 0)[:, None] * transform[:, 3]
    is_ahead = points[:, 2] > MIN_DEPTH
    depths = np.where(is_ahead, points[:, 2], 1.0)
    return np.linalg.norm(points[:, :2] / depths[:, None] - matched, axis=1), is_ahead
