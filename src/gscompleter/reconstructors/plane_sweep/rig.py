"""Images of the views and the transforms between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float32

from gscompleter.reconstructors.features.neighbours import Neighbours, find_neighbours
from gscompleter.reconstructors.features.stereo_image import (
    StereoImage,
    compute_source_from_reference,
    make_stereo_images,
)
from gscompleter.reconstructors.plane_sweep.epipolar import rotate_to_matches
from gscompleter.reconstructors.plane_sweep.fusion import Transforms
from gscompleter.types import View


@dataclass(frozen=True)
class Rig:
    """Images, and the transforms between their pixels."""

    images: list[StereoImage]
    unit: float
    """Widest baseline in scene units; stereo lengths are multiples of it."""
    neighbours: Neighbours
    transforms: Transforms

    def halve(self) -> Rig:
        """Halve the size of all images."""
        transforms = {pair: halve_transform(t) for pair, t in self.transforms.items()}
        return replace(self, images=[halve_image(i) for i in self.images], transforms=transforms)


def build_rig(views: Sequence[View]) -> Rig:
    """Relate the views by their poses, corrected to fit the feature matches."""
    images, unit = make_stereo_images(views)
    neighbours = find_neighbours(images)
    transforms = {}
    for i, j in combinations(range(len(images)), 2):
        source = images[j]
        if (i, j) in neighbours.matches:
            source = rotate_to_matches(images[i], source, *neighbours.matches[i, j])
        transforms[i, j] = compute_source_from_reference(images[i], source)
        transforms[j, i] = compute_source_from_reference(source, images[i])
    return Rig(images, unit, neighbours, transforms)


def halve_image(image: StereoImage) -> StereoImage:
    """Halve an image; the last row or column of an odd size is repeated first."""
    h, w = image.size
    even = np.pad(image.image, ((0, h % 2), (0, w % 2), (0, 0)), mode="edge")
    rows = even[::2] + even[1::2]
    pixels = (rows[:, ::2] + rows[:, 1::2]) / 4
    K = image.K * np.array([[0.5], [0.5], [1.0]])
    ignored = None if image.ignore_mask is None else image.ignore_mask[::2, ::2]
    return replace(image, image=pixels.astype(np.float32), K=K, ignore_mask=ignored)


def halve_transform(transform: Float32[np.ndarray, "3 4"]) -> Float32[np.ndarray, "3 4"]:
    """Convert a transform between two views to their halved images."""
    half, twice = np.diag([0.5, 0.5, 1.0]), np.diag([2.0, 2.0, 1.0, 1.0])
    return (half @ transform @ twice).astype(np.float32)
