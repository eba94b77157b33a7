"""Matches features of photographs with renders of the splat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float

from gscompleter.config.coverage import COVERED
from gscompleter.geometry import unproject
from gscompleter.reconstructors.features.matches import Features, detect_features, match_features
from gscompleter.reconstructors.features.stereo_image import StereoImage
from gscompleter.render import Renderer
from gscompleter.splat_alignment.fit import render_from
from gscompleter.splat_alignment.similarity import Matrix, get_pose
from gscompleter.types import Camera, Gaussians, View

MIN_INLIERS = 15
"""Fewest matches that must agree with a pose."""
MAX_REPROJECTION_ERROR = 3.0
"""Largest reprojection error of an inlier, in pixels."""


@dataclass(frozen=True)
class PhotoFeatures:
    """A photograph's camera and features."""

    camera: Camera
    features: Features


@dataclass(frozen=True)
class LocatedPhoto:
    """A photograph whose pose in the splat was found."""

    photograph: PhotoFeatures
    pose: Matrix
    """Camera-to-world in the splat's frame."""
    points: Float[np.ndarray, "m 3"]
    """Inlier points of the splat, in its frame."""
    pixels: Float[np.ndarray, "m 2"]
    """Pixels of the points in the photograph."""


def extract_photo_features(views: Sequence[View]) -> list[PhotoFeatures]:
    """Extract the features of all views."""
    return [PhotoFeatures(view.camera, extract_view_features(view)) for view in views]


def extract_view_features(view: View) -> Features:
    """Extract the features of one view."""
    camera, pose = view.camera, get_pose(view.camera)
    pixels = np.ascontiguousarray(view.image.detach().cpu().clamp(0, 1).float().numpy())
    K = camera.K.detach().cpu().double().numpy()
    return detect_features(StereoImage(pixels, K, pose[:3, :3], pose[:3, 3]))


def locate_photos(
    scene: Gaussians, camera: Camera, photographs: Sequence[PhotoFeatures], renderer: Renderer
) -> list[LocatedPhoto]:
    """Find the poses of the photographs that show what `camera` sees of the splat."""
    render = render_from(scene, camera, renderer)
    features = extract_view_features(View(render.image, camera))
    surface = unproject(render.depth, camera).where((render.alpha >= COVERED)[..., None], torch.nan)
    places = surface.detach().cpu().double().numpy()
    found = (_locate_photo(features, places, photograph) for photograph in photographs)
    return [one for one in found if one is not None]


def _locate_photo(
    features: Features, places: Float[np.ndarray, "h w 3"], photograph: PhotoFeatures
) -> LocatedPhoto | None:
    """Estimate a photograph's pose by PnP against a render; None with too few inliers."""
    rendered, pixels = match_features(features, photograph.features)
    columns, rows = np.floor(rendered).astype(int).T
    points = places[rows.clip(0, len(places) - 1), columns.clip(0, places.shape[1] - 1)]
    known = np.isfinite(points).all(axis=1)
    points, pixels = points[known], pixels[known]
    if len(points) < MIN_INLIERS:
        return None
    K = photograph.camera.K.detach().cpu().double().numpy()
    answer = cv2.solvePnPRansac(
        points, pixels, K, None, iterationsCount=300, reprojectionError=MAX_REPROJECTION_ERROR
    )
    if not answer[0] or answer[3] is None or len(answer[3]) < MIN_INLIERS:
        return None
    chosen = answer[3].ravel()
    return LocatedPhoto(photograph, _make_c2w(answer[1], answer[2]), points[chosen], pixels[chosen])


def _make_c2w(rotation: Float[np.ndarray, "3 1"], shift: Float[np.ndarray, "3 1"]) -> Matrix:
    """Convert OpenCV's world-to-camera vectors to camera-to-world."""
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = cv2.Rodrigues(rotation)[0], shift.ravel()
    return np.linalg.inv(viewmat)
