"""Searches the frame of a splat: rendered from all directions until photographs match."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from gscompleter.frames.matching import Photograph, located
from gscompleter.frames.refinement import similarity_of
from gscompleter.frames.similarity import Matrix, moved_camera, pose_of, similarity
from gscompleter.frames.trainers import Points, shortest_turn
from gscompleter.render import Renderer
from gscompleter.types import Gaussians

Middle = tuple[Float[np.ndarray, "3"], float]
"""Centre and radius of points."""

DIRECTIONS = 40
"""Directions around the splat, about 30° apart; features tolerate half of that and any roll."""
ZOOMS = (1.0, 0.6, 1.7)
"""Trial factors on the size of the splat, which far Gaussians and floaters blur."""


def searched(
    scene: Gaussians, photographs: Sequence[Photograph], points: Points, renderer: Renderer
) -> Iterator[Matrix]:
    """Yield similarities from photographs to splat by which some photographs match."""
    seer = photographs[len(photographs) // 2].camera
    if len(scene) == 0:
        return
    solid = scene.means[scene.opacities >= scene.opacities.median()].detach().cpu().double().numpy()
    goal = middle_of(solid)
    if goal[1] == 0:  # most of it is one point: all directions are alike
        return
    for transform in starts(pose_of(seer), middle_of(points), goal):
        found = located(scene, moved_camera(seer, transform), photographs, renderer)
        answer = similarity_of(found)
        if answer is not None:
            yield answer


def starts(pose: Matrix, place: Middle, goal: Middle) -> Iterator[Matrix]:
    """Yield similarities that map `place` to `goal` (centre, radius), from all directions."""
    (center, radius), (new_center, new_radius) = place, goal
    for zoom in ZOOMS:
        scale = zoom * new_radius / max(radius, 1e-12)
        for direction in directions(DIRECTIONS):
            turn = shortest_turn(pose[:3, 2], direction)
            yield similarity(scale, turn, new_center - scale * turn @ center)


def middle_of(points: Points) -> Middle:
    """Compute centre and radius of points as medians, which ignore floaters."""
    center = np.median(points, axis=0)
    return center, float(np.median(np.linalg.norm(points - center, axis=1)))


def directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Sample unit vectors on a golden spiral over the sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
