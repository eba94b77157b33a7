"""Refines a similarity by features matched in all photographs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from gscompleter.render import Renderer, get_view_map
from gscompleter.splat_alignment.matching import (
    MAX_REPROJECTION_ERROR,
    LocatedPhoto,
    PhotoFeatures,
    locate_photos,
)
from gscompleter.splat_alignment.similarity import (
    Matrix,
    fit_pose_similarity,
    get_pose,
    has_baseline,
    make_similarity,
    transform_camera,
)
from gscompleter.types import Gaussians

NUM_ROUNDS = 2
"""Iterations, each with renders at the cameras of the previous one."""
MAX_SHIFT = 0.25
"""Median change of the reprojected points, in pixels, at which the iteration stops."""


def refine_similarity(
    scene: Gaussians, photographs: Sequence[PhotoFeatures], transform: Matrix, renderer: Renderer
) -> Matrix | None:
    """Refine a similarity (photographs to splat) by features; None if too few match."""
    for _ in range(NUM_ROUNDS):
        cameras = [transform_camera(photograph.camera, transform) for photograph in photographs]
        alone = [[photograph] for photograph in photographs]
        places = get_view_map(scene)(
            partial(locate_photos, scene, renderer=renderer), cameras, alone
        )
        found = [place for these in places for place in these]
        better = fit_similarity(found)
        if better is None:
            return None
        moved = np.median([_compute_shift(place, transform, better) for place in found])
        transform = better
        if moved <= MAX_SHIFT:
            break
    return transform


def fit_similarity(found: Sequence[LocatedPhoto]) -> Matrix | None:
    """Fit photographs' frame to splat's frame by located photographs; None if too few."""
    before = [get_pose(place.photograph.camera) for place in found]
    if not has_baseline(before):
        return None
    start = fit_pose_similarity(before, [place.pose for place in found])
    return minimize_reprojection(found, start) if np.linalg.det(start[:3, :3]) > 0 else None


def minimize_reprojection(found: Sequence[LocatedPhoto], start: Matrix) -> Matrix:
    """Minimize the robust reprojection error over similarities.

    The seven unknowns move the splat's points in the photographs' frame: logarithm of the scale,
    rotation vector, and shift in units of the points' spread.
    """
    # Imported here, because it takes half a second and few splats need it.
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    points = [transform_back(place, start) for place in found]
    center = np.median(np.concatenate(points), axis=0)
    unit = float(np.median(np.linalg.norm(np.concatenate(points) - center, axis=1)))

    def change(unknowns: Float[np.ndarray, "7"]) -> Matrix:
        turn = np.exp(unknowns[0]) * Rotation.from_rotvec(unknowns[1:4]).as_matrix()
        return make_similarity(1.0, turn, center + unit * unknowns[4:] - turn @ center)

    def errors(unknowns: Float[np.ndarray, "7"]) -> Float[np.ndarray, "m"]:
        moved = change(unknowns)
        pairs = zip(found, points, strict=True)
        return np.concatenate(
            [_compute_residuals(p @ moved[:3, :3].T + moved[:3, 3], f) for f, p in pairs]
        )

    answer = least_squares(errors, np.zeros(7), loss="cauchy", f_scale=0.3 * MAX_REPROJECTION_ERROR)
    return start @ np.linalg.inv(change(answer.x))


def transform_back(photo: LocatedPhoto, transform: Matrix) -> Float[np.ndarray, "m 3"]:
    """Transform the inlier points of a photograph to the photographs' frame."""
    back = np.linalg.inv(transform)
    return photo.points @ back[:3, :3].T + back[:3, 3]


def _compute_shift(photo: LocatedPhoto, before: Matrix, after: Matrix) -> float:
    """Compute the median change of the reprojection error between two similarities, in pixels."""
    seen = [_compute_residuals(transform_back(photo, m), photo) for m in (before, after)]
    return float(np.median(np.abs(seen[1] - seen[0])))


def _compute_residuals(
    points: Float[np.ndarray, "m 3"], photo: LocatedPhoto
) -> Float[np.ndarray, "k"]:
    """Compute the reprojection errors along x and y, in pixels."""
    pose = get_pose(photo.photograph.camera)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    homogeneous = local @ photo.photograph.camera.K.detach().cpu().double().numpy().T
    ahead = np.maximum(homogeneous[:, 2:], 1e-9 * np.abs(homogeneous).max())
    return np.clip(homogeneous[:, :2] / ahead - photo.pixels, -1e4, 1e4).ravel()
