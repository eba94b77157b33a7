"""Finds the similarity from the photographs' frame to the splat's frame by matching features.

The splat is rendered from all directions until some photographs match a render. Then it is rendered
at the cameras of the photographs, mapped into its frame, which refines the result.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import unproject
from gscompleter.reconstructors.features.matches import Features, detect_features, match_features
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.render.protocols import Renderer
from gscompleter.render.view_map import get_view_map
from gscompleter.splats.alignment.fit import render_from
from gscompleter.splats.alignment.similarity import (
    Matrix,
    fit_pose_similarity,
    get_camera_pose,
    has_baseline,
    make_similarity,
    transform_camera,
)
from gscompleter.splats.alignment.trainer_frames import Points, align_directions
from gscompleter.types import Camera, Gaussians, View

MIN_AGREEING_MATCHES = 15
"""Fewest matches that must agree with a pose."""
MAX_REPROJECTION_ERROR = 3.0
"""Largest reprojection error of an inlier, in pixels."""
NUM_DIRECTIONS = 40
"""Directions around the splat, about 30° apart; features tolerate half of that and any roll."""
SCALE_FACTORS = (1.0, 0.6, 1.7)
"""Factors on the measured size of the splat, which are all tried, since far Gaussians and floaters
make it uncertain."""
NUM_REFINEMENTS = 2
"""Iterations of the refinement, each with renders at the cameras that the previous one found."""

PhotoFeatures = tuple[Camera, Features]
"""A photograph's camera and features."""
RenderedFeatures = tuple[Features, Float[np.ndarray, "h w 3"]]
"""Features of a render, and per pixel the visible point in the splat's frame, or NaN."""


@dataclass(frozen=True)
class LocatedPhoto:
    """A photograph whose pose in the splat was found."""

    camera: Camera
    """In the photographs' frame."""
    pose: Matrix
    """Camera-to-world in the splat's frame."""
    points: Float[np.ndarray, "m 3"]
    """Inliers, in the splat's frame."""
    pixels: Float[np.ndarray, "m 2"]
    """Pixels of the photograph that show these points."""


def search_similarities(
    scene: Gaussians, photographs: Sequence[PhotoFeatures], points: Points, renderer: Renderer
) -> Iterator[Matrix]:
    """Yield similarities from the photographs' to the splat's frame for which photographs match.

    `points` are points of the scene in the photographs' frame.
    """
    # The camera `seer` is placed around the splat, and each photograph is located by its features
    # in what that camera sees.
    seer = photographs[len(photographs) // 2][0]
    if len(scene) == 0 or not has_baseline([get_camera_pose(camera) for camera, _ in photographs]):
        return
    # The fainter half of the Gaussians, floaters among them, says little about the extent.
    solid = scene.means[scene.opacities >= scene.opacities.median()].detach().cpu().double().numpy()
    for transform in generate_starts(get_camera_pose(seer), points, solid):
        rendered = render_features(scene, transform_camera(seer, transform), renderer)
        similarity = fit_similarity(
            [locate_photo(rendered, photograph) for photograph in photographs]
        )
        if similarity is not None:
            yield similarity


def generate_starts(
    pose: Matrix, points: Points, solid: Float[np.ndarray, "n 3"]
) -> Iterator[Matrix]:
    """Yield similarities that map `points` onto `solid`, one for each direction of view and size.

    `pose` (camera-to-world) and `points` are in the photographs' frame, `solid` in the splat's.
    """
    center, radius = compute_center_radius(points)
    new_center, new_radius = compute_center_radius(solid)
    if new_radius == 0:  # most of it is one point: all directions are alike
        return
    for zoom in SCALE_FACTORS:
        scale = zoom * new_radius / max(radius, 1e-12)
        for direction in sample_directions(NUM_DIRECTIONS):
            # The camera then looks along `direction`, with any roll, which features tolerate.
            turn = align_directions(pose[:3, 2], direction)
            yield make_similarity(scale, turn, new_center - scale * turn @ center)


def compute_center_radius(points: Points) -> tuple[Float[np.ndarray, "3"], float]:
    """Compute centre and radius of points as medians, which ignore floaters."""
    center = np.median(points, axis=0)
    return center, float(np.median(np.linalg.norm(points - center, axis=1)))


def sample_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Sample unit vectors on a golden spiral over the sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def refine_similarity(
    scene: Gaussians, photographs: Sequence[PhotoFeatures], start: Matrix, renderer: Renderer
) -> Matrix | None:
    """Refine a similarity (photographs' to splat's frame); None if too few photographs match."""

    def locate(photograph: PhotoFeatures, camera: Camera) -> LocatedPhoto | None:
        return locate_photo(render_features(scene, camera, renderer), photograph)

    transform: Matrix | None = start
    for _ in range(NUM_REFINEMENTS):
        if transform is not None:
            cameras = [transform_camera(camera, transform) for camera, _ in photographs]
            located = list(get_view_map(scene.means)(locate, photographs, cameras))
            transform = fit_similarity(located)
    return transform


def fit_similarity(photos: Sequence[LocatedPhoto | None]) -> Matrix | None:
    """Fit the similarity from the photographs' to the splat's frame; None without a solution.

    Photographs that were not located are None. The others need a baseline: poses at one place
    determine no scale.
    """
    located = [photo for photo in photos if photo is not None]
    before = [get_camera_pose(photo.camera) for photo in located]
    if not has_baseline(before):
        return None
    start = fit_pose_similarity(before, [photo.pose for photo in located])
    # The poses found in the splat may coincide, too, which makes the scale zero.
    if not np.linalg.det(start[:3, :3]) > 0:
        return None
    return minimize_reprojection(located, start)


def minimize_reprojection(photos: Sequence[LocatedPhoto], start: Matrix) -> Matrix:
    """Minimize the robust reprojection error over similarities, from `start` on.

    `start` and the result map the photographs' frame to the splat's. The splat's points are taken
    to the photographs' frame by the inverse of `start`. Seven unknowns then move them there:
    logarithm of the scale, rotation vector, and shift in units of the points' spread.
    """
    # Imported here, because it takes half a second and few splats need it.
    from scipy.optimize import least_squares

    back = np.linalg.inv(start)
    points = [photo.points @ back[:3, :3].T + back[:3, 3] for photo in photos]
    center = np.median(np.concatenate(points), axis=0)
    unit = float(np.median(np.linalg.norm(np.concatenate(points) - center, axis=1)))

    def change(unknowns: Float[np.ndarray, "7"]) -> Matrix:
        turn = np.exp(unknowns[0]) * cv2.Rodrigues(unknowns[1:4])[0]
        return make_similarity(1.0, turn, center + unit * unknowns[4:] - turn @ center)

    def errors(unknowns: Float[np.ndarray, "7"]) -> Float[np.ndarray, "m"]:
        moved = change(unknowns)
        return np.concatenate(
            [
                _compute_residuals(own_points @ moved[:3, :3].T + moved[:3, 3], photo)
                for photo, own_points in zip(photos, points, strict=True)
            ]
        )

    # Some matches are false; a Cauchy loss bounds their pull.
    solution = least_squares(
        errors, np.zeros(7), loss="cauchy", f_scale=0.3 * MAX_REPROJECTION_ERROR
    )
    # `change` maps the splat's points to where they belong, so that the frame moves inversely.
    return start @ np.linalg.inv(change(solution.x))


def _compute_residuals(
    points: Float[np.ndarray, "m 3"], photo: LocatedPhoto
) -> Float[np.ndarray, "k"]:
    """Compute the reprojection errors along x and y, in pixels, at the camera of `photo`.

    `points` are in the photographs' frame.
    """
    pose = get_camera_pose(photo.camera)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    homogeneous = local @ photo.camera.K.detach().cpu().double().numpy().T
    # A point behind the camera gets a large error instead of a mirrored pixel.
    ahead = np.maximum(homogeneous[:, 2:], 1e-9 * np.abs(homogeneous).max())
    return np.clip(homogeneous[:, :2] / ahead - photo.pixels, -1e4, 1e4).ravel()


def extract_view_features(view: View) -> Features:
    """Extract the features of one view."""
    pose = get_camera_pose(view.camera)
    pixels = np.ascontiguousarray(view.image.detach().cpu().clamp(0, 1).float().numpy())
    K = view.camera.K.detach().cpu().double().numpy()
    unknown = np.zeros(pixels.shape[:2], np.float32)
    ignored = None if view.ignore_mask is None else view.ignore_mask.cpu().numpy()
    return detect_features(StereoImage(pixels, K, pose[:3, :3], pose[:3, 3], unknown, ignored))


def render_features(scene: Gaussians, camera: Camera, renderer: Renderer) -> RenderedFeatures:
    """Extract the features of what `camera`, in the splat's frame, sees of the splat."""
    render = render_from(scene, camera, renderer)
    surface = unproject(render.depth, camera).where((render.alpha >= COVERED)[..., None], torch.nan)
    features = extract_view_features(View(render.image, camera))
    return features, surface.detach().cpu().double().numpy()


def locate_photo(rendered: RenderedFeatures, photograph: PhotoFeatures) -> LocatedPhoto | None:
    """Estimate a photograph's pose in the splat's frame by PnP; None with too few inliers."""
    features, surface = rendered
    camera, own_features = photograph
    # Each feature of the render has a point of the splat, which gives 2D to 3D matches.
    places, pixels = match_features(features, own_features)
    columns, rows = np.floor(places).astype(int).T
    points = surface[rows.clip(0, len(surface) - 1), columns.clip(0, surface.shape[1] - 1)]
    known = np.isfinite(points).all(axis=1)
    points = points[known]
    pixels = pixels[known]
    if len(points) < MIN_AGREEING_MATCHES:
        return None
    K = camera.K.detach().cpu().double().numpy()
    is_solved, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, K, None, iterationsCount=300, reprojectionError=MAX_REPROJECTION_ERROR
    )
    if not is_solved or inliers is None or len(inliers) < MIN_AGREEING_MATCHES:
        return None
    viewmat = np.eye(4)
    viewmat[:3, :3] = cv2.Rodrigues(turn)[0]
    viewmat[:3, 3] = shift.ravel()
    chosen = inliers.ravel()
    return LocatedPhoto(camera, np.linalg.inv(viewmat), points[chosen], pixels[chosen])
