"""Images of the views and the transforms between them, with small errors of the poses corrected.

A pose error of one pixel puts a match beside its epipolar line; a small rotation of one camera
moves the lines back onto the feature matches. Motion along a line cannot be separated from depth,
so it is kept small, and depths keep the scale of the given poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float, Float32

from gscompleter.reconstructors.features.matches import Pixels
from gscompleter.reconstructors.features.neighbours import Neighbours, find_neighbours
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
    make_stereo_images,
)
from gscompleter.types import View

MIN_RIG_MATCHES = 20
"""Fewest matches for a correction; with fewer the pose is kept."""
MAX_RIG_DISTANCE = 8.0
"""Largest distance of a valid match from its epipolar line, in pixels."""
RIG_ITERATIONS = 20
"""Iterations of reweighted least squares, which suppresses false matches."""

Transform = Float32[np.ndarray, "3 4"]
Transforms = Mapping[tuple[int, int], Transform]
"""`transforms[i, j]` is j_from_i: pixels of view i with inverse depth -> pixels of view j."""


@dataclass(frozen=True)
class Rig:
    """Images, and the transforms between their pixels."""

    images: list[StereoImage]
    unit: float
    """Widest baseline in scene units; stereo lengths are multiples of it."""
    neighbours: Neighbours
    transforms: Transforms
    device: str = "cpu"
    """Device that matches the images and fits surfaces (`depth_devices`)."""

    def halve(self) -> Rig:
        """Halve the size of all images."""
        transforms = {pair: halve_transform(t) for pair, t in self.transforms.items()}
        return replace(self, images=[halve_image(i) for i in self.images], transforms=transforms)

    def drop_given(self, dropped: Sequence[bool]) -> Rig:
        """Leave out the given depth of the images that are True in `dropped`."""
        return replace(
            self,
            images=[
                replace(image, given=np.zeros_like(image.given)) if is_dropped else image
                for image, is_dropped in zip(self.images, dropped, strict=True)
            ],
        )


def build_rig(views: Sequence[View], device: str = "cpu") -> Rig:
    """Relate the views by their poses, corrected to fit the feature matches."""
    images, unit = make_stereo_images(views)
    neighbours = find_neighbours(images) if len(images) > 1 else Neighbours(((),), {})
    transforms = {}
    for i, j in combinations(range(len(images)), 2):
        # The correction holds for this pair only; each pair of a view gets its own.
        source = images[j]
        if (i, j) in neighbours.matches:
            source = rotate_to_matches(images[i], source, *neighbours.matches[i, j])
        transforms[i, j] = compute_source_from_reference(images[i], source)
        transforms[j, i] = compute_source_from_reference(source, images[i])
    return Rig(images, unit, neighbours, transforms, device)


def halve_image(image: StereoImage) -> StereoImage:
    """Halve an image; the last row or column of an odd size is repeated first."""
    h, w = image.size
    # Colours are means of 2 x 2 pixels. Given depth is the nearest of them, since a mean of two
    # surfaces lies on neither; 0 is unknown, and inverse depth makes the nearest the largest.
    even = np.pad(image.image, ((0, h % 2), (0, w % 2), (0, 0)), mode="edge")
    rows = even[::2] + even[1::2]
    pixels = (rows[:, ::2] + rows[:, 1::2]) / 4
    padded = np.pad(image.given, ((0, h % 2), (0, w % 2)))
    nearest = np.maximum(padded[::2], padded[1::2])
    return replace(
        image,
        image=pixels.astype(np.float32),
        K=image.K * np.array([[0.5], [0.5], [1.0]]),
        given=np.maximum(nearest[:, ::2], nearest[:, 1::2]),
        # One pixel of four is enough for what is read here, the share of a photograph that stands
        # before the near plane. Depths that are kept are masked at full size.
        ignore_mask=None if image.ignore_mask is None else image.ignore_mask[::2, ::2],
    )


def halve_transform(transform: Transform) -> Transform:
    """Convert a transform between two views to their halved images."""
    full_from_half = np.diag([2.0, 2.0, 1.0, 1.0])
    half_from_full = np.diag([0.5, 0.5, 1.0])
    return (half_from_full @ transform @ full_from_half).astype(np.float32)


def rotate_to_matches(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> StereoImage:
    """Rotate `source` about its centre so that matches lie on their epipolar lines.

    Iteratively reweighted least squares for a small rotation vector, in camera axes of the source.
    """
    distance, normal = compute_epipolar_distances(reference, source, pixels, matched)
    near = np.abs(distance) < MAX_RIG_DISTANCE
    if near.sum() < MIN_RIG_MATCHES:
        return source
    distance = distance[near]
    normal = normal[near]

    # Pixel motion per radian, split into its parts across and along the epipolar line [m, 3].
    motion = compute_rotation_motion(source, matched[near])
    beside = (normal[:, :, None] * motion).sum(axis=1)
    along = normal[:, 0, None] * motion[:, 1] - normal[:, 1, None] * motion[:, 0]

    turn = np.zeros(3)
    for _ in range(RIG_ITERATIONS):
        # Cauchy weights; the scale is the median deviation, not below 0.05 pixels.
        miss = distance - beside @ turn
        spread = max(1.4826 * float(np.median(np.abs(miss))), 0.05)
        weight = 1 / (1 + (miss / spread) ** 2)
        cost = (beside.T * weight) @ beside
        # A squared motion along the lines costs as much as a squared distance from them.
        cost += weight.mean() * (along.T @ along)
        # The system stays solvable if all matches lie on one line.
        cost += 1e-9 * np.trace(cost) * np.eye(3)
        turn = np.linalg.solve(cost, (beside.T * weight) @ distance)
    rotation, _ = cv2.Rodrigues(turn)
    return replace(source, rotation=source.rotation @ rotation.T)


def compute_epipolar_distances(
    reference: StereoImage, source: StereoImage, pixels: Pixels, matched: Pixels
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
    """Compute signed distances from the epipolar lines, in pixels, and the line normals."""
    transform = compute_source_from_reference(reference, source).astype(np.float64)
    ones = np.ones((len(pixels), 1))
    # The line joins the images of the ray's point at infinity and of the reference centre. With a
    # normal of length 1, its product with a homogeneous pixel is the distance.
    at_infinity = np.concatenate([pixels, ones], axis=1) @ transform[:, :3].T
    lines = np.cross(at_infinity, transform[:, 3])
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return (lines * np.concatenate([matched, ones], axis=1)).sum(axis=1), lines[:, :2]


def compute_rotation_motion(view: StereoImage, pixels: Pixels) -> Float[np.ndarray, "m 2 3"]:
    """Compute the pixel motion per radian of rotation about each camera axis."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(view.K).T
    # Derivative of X/Z and Y/Z for a point X + turn x X, with Z = 1; K turns it into pixels.
    turned = np.cross(np.eye(3)[None], rays[:, None])
    motion = turned[..., :2] - rays[:, None, :2] * turned[..., 2:]
    return (motion @ view.K[:2, :2].T).transpose(0, 2, 1)
