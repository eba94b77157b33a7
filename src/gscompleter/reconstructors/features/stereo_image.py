"""Views as arrays for stereo, with lengths in units of the widest baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from gscompleter.system.errors import InputError
from gscompleter.types import View

MIN_STEREO_SIDE = 8
"""Smallest side of an image that stereo can match, in pixels."""
MAX_ROUNDING = 2e-7
"""Largest rounding of a coordinate in float32, relative to the largest one."""
MIN_GIVEN_DEPTH = np.float32(1e-6)
"""Smallest given depth, in units of the images; sensors write any number."""


@dataclass(frozen=True)
class StereoImage:
    """An image and its camera; lengths are in widest baselines."""

    image: Float[np.ndarray, "h w 3"]
    K: Float[np.ndarray, "3 3"]
    rotation: Float[np.ndarray, "3 3"]
    """Rotation from camera to world axes."""
    center: Float[np.ndarray, "3"]
    """Camera centre in world axes, relative to that of the first view."""
    given: Float32[np.ndarray, "h w"]
    """Inverse depths that are given, 0 where unknown."""
    ignore_mask: Bool[np.ndarray, "h w"] | None = None
    """True at pixels that are not matched, or None to match all."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.image.shape[0], self.image.shape[1]


def make_stereo_images(views: Sequence[View]) -> tuple[list[StereoImage], float]:
    """Convert views to units of their widest baseline; return it in scene units too.

    Camera offsets are rounded to 2^-16 baselines, so that a scaled scene gives identical results.
    The unit of a single view with given depth is its near plane, which has to be known. Raise
    InputError for another single view, a tiny image, or no baseline.
    """
    is_single = len(views) == 1 and len(views[0].known_depths) > 0
    if len(views) < 2 and not is_single:
        raise InputError(
            f"Stereo needs at least two views and got {len(views)}; give it another photograph."
        )
    for view in views:
        if min(view.image.shape[:2]) < MIN_STEREO_SIDE:
            height, width = view.image.shape[:2]
            raise InputError(
                f"An image of {width} x {height} pixels was given, and stereo needs at least "
                f"{MIN_STEREO_SIDE} x {MIN_STEREO_SIDE}; give a larger one."
            )
    near = views[0].camera.near
    if is_single and near:
        return [_make_stereo_image(views[0], np.zeros(3), near)], near

    centers = stack_centers(views)
    unit = measure_widest_baseline(centers)
    if unit == 0:
        raise InputError(
            f"All {len(views)} cameras stand in one place, and depth needs a baseline between "
            "them; give photographs taken from different positions."
        )
    offsets = np.round((centers - centers[0]) / unit * 2**16) / 2**16
    images = [
        _make_stereo_image(view, offset, unit) for view, offset in zip(views, offsets, strict=True)
    ]
    return images, unit


def has_distinct_centers(views: Sequence[View]) -> bool:
    """Check whether the cameras of views stand in different places."""
    centers = stack_centers(views)
    return measure_widest_baseline(centers) > 0


def stack_centers(views: Sequence[View]) -> Float[np.ndarray, "n 3"]:
    """Stack the camera centres of views, in scene units."""
    centers = torch.stack([view.camera.center for view in views])
    return centers.double().numpy(force=True)


def measure_widest_baseline(centers: Float[np.ndarray, "n 3"]) -> float:
    """Measure the widest baseline of cameras; 0 if it is below the rounding of the coordinates."""
    widest = float(np.linalg.norm(centers[:, None] - centers[None], axis=-1).max())
    return widest if widest > MAX_ROUNDING * float(np.linalg.norm(centers, axis=-1).max()) else 0.0


def _make_stereo_image(view: View, center: Float[np.ndarray, "3"], unit: float) -> StereoImage:
    camera = view.camera
    given = np.zeros(view.image.shape[:2], np.float32)
    if view.given_depth is not None:
        depth = view.given_depth.numpy(force=True)
        inverse = unit / np.maximum(depth, MIN_GIVEN_DEPTH * unit)
        given = np.where(depth > 0, inverse, 0).astype(np.float32)
    return StereoImage(
        np.ascontiguousarray(view.image.float().numpy(force=True)),
        camera.K.double().numpy(force=True),
        camera.c2w[:3, :3].double().numpy(force=True),
        center,
        given,
        None if view.ignore_mask is None else view.ignore_mask.numpy(force=True),
    )


def compute_contrast(
    a: Float32[np.ndarray, "h w 3"], b: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    """Compute the largest channel difference of each pixel of two images."""
    return take_largest_channel(cv2.absdiff(a, b))


def take_largest_channel(values: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Compute the largest channel of each pixel."""
    red, green, blue = cv2.split(values)
    return cv2.max(cv2.max(red, green), blue)


def compute_source_from_reference(
    reference: StereoImage, source: StereoImage
) -> Float[np.ndarray, "3 4"]:
    """Compute [A | b], the transform from reference pixels to source pixels.

    A pixel (x, y, 1) at inverse depth w maps to A (x, y, 1) + b w, whose third entry is the z-depth
    ratio.
    """
    rotation = source.rotation.T @ reference.rotation
    homography = source.K @ rotation @ np.linalg.inv(reference.K)
    shift = source.K @ source.rotation.T @ (reference.center - source.center)
    return np.concatenate([homography, shift[:, None]], axis=1).astype(np.float32)
