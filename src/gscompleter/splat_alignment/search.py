"""Searches the frame of a splat: rendered from all directions until photographs match."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from gscompleter.render import Renderer
from gscompleter.splat_alignment.matching import PhotoFeatures, locate_photos
from gscompleter.splat_alignment.refinement import fit_similarity
from gscompleter.splat_alignment.similarity import (
    Matrix,
    get_pose,
    make_similarity,
    transform_camera,
)
from gscompleter.splat_alignment.trainer_frames import Points, align_directions
from gscompleter.types import Gaussians

CenterRadius = tuple[Float[np.ndarray, "3"], float]
"""Centre and radius of points."""

NUM_DIRECTIONS = 40
"""Directions around the splat, about 30° apart; features tolerate half of that and any roll."""
SCALE_FACTORS = (1.0, 0.6, 1.7)
"""Trial factors on the size of the splat, which far Gaussians and floaters blur."""


def search_similarities(
    scene: Gaussians, photographs: Sequence[PhotoFeatures], points: Points, renderer: Renderer
) -> Iterator[Matrix]:
    """Yield similarities from photographs to splat by which some photographs match."""
    seer = photographs[len(photographs) // 2].camera
    if len(scene) == 0:
        return
    solid = scene.means[scene.opacities >= scene.opacities.median()].detach().cpu().double().numpy()
    goal = compute_center_radius(solid)
    if goal[1] == 0:  # most of it is one point: all directions are alike
        return
    for transform in generate_starts(get_pose(seer), compute_center_radius(points), goal):
        found = locate_photos(scene, transform_camera(seer, transform), photographs, renderer)
        answer = fit_similarity(found)
        if answer is not None:
            yield answer


def generate_starts(pose: Matrix, start: CenterRadius, goal: CenterRadius) -> Iterator[Matrix]:
    """Yield similarities that map `place` to `goal` (centre, radius), from all directions."""
    (center, radius), (new_center, new_radius) = start, goal
    for zoom in SCALE_FACTORS:
        scale = zoom * new_radius / max(radius, 1e-12)
        for direction in sample_directions(NUM_DIRECTIONS):
            turn = align_directions(pose[:3, 2], direction)
            yield make_similarity(scale, turn, new_center - scale * turn @ center)


def compute_center_radius(points: Points) -> CenterRadius:
    """Compute centre and radius of points as medians, which ignore floaters."""
    center = np.median(points, axis=0)
    return center, float(np.median(np.linalg.norm(points - center, axis=1)))


def sample_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Sample unit vectors on a golden spiral over the sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
