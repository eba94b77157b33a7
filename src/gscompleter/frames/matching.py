"""Features of photographs that are found again in renders of the splat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float

from gscompleter.coverage import COVERED
from gscompleter.frames.fit import seen_from
from gscompleter.frames.similarity import Matrix, pose_of
from gscompleter.geometry import unproject
from gscompleter.matching.features import Features, features_of, matches
from gscompleter.matching.stereo_image import StereoImage
from gscompleter.render import Renderer
from gscompleter.types import Camera, Gaussians, View

MIN_INLIERS = 15
"""Fewest matches that must agree with a pose."""
MAX_ERROR = 3.0
"""Pixels by which a match may miss its place."""


@dataclass(frozen=True)
class Photograph:
    """A photograph's camera and features."""

    camera: Camera
    features: Features


@dataclass(frozen=True)
class Located:
    """A photograph whose camera was found in the splat."""

    photograph: Photograph
    pose: Matrix
    """Camera-to-world in the splat's frame."""
    points: Float[np.ndarray, "m 3"]
    """Of the splat, in its frame, that agree with that pose."""
    pixels: Float[np.ndarray, "m 2"]
    """Where the photograph shows them."""


def photographs_of(views: Sequence[View]) -> list[Photograph]:
    """The views with their features."""
    return [Photograph(view.camera, features_in(view)) for view in views]


def features_in(view: View) -> Features:
    """The features of an image."""
    camera, pose = view.camera, pose_of(view.camera)
    pixels = np.ascontiguousarray(view.image.detach().cpu().clamp(0, 1).float().numpy())
    K = camera.K.detach().cpu().double().numpy()
    return features_of(StereoImage(pixels, K, pose[:3, :3], pose[:3, 3]))


def located(
    scene: Gaussians, camera: Camera, photographs: Sequence[Photograph], renderer: Renderer
) -> list[Located]:
    """Those of the photographs that show what `camera` sees of the splat, with their poses."""
    render = seen_from(scene, camera, renderer)
    features = features_in(View(render.image, camera))
    surface = unproject(render.depth, camera).where((render.alpha >= COVERED)[..., None], torch.nan)
    places = surface.detach().cpu().double().numpy()
    found = (_located(features, places, photograph) for photograph in photographs)
    return [one for one in found if one is not None]


def _located(
    features: Features, places: Float[np.ndarray, "h w 3"], photograph: Photograph
) -> Located | None:
    """The photograph's pose by what it shares with a render; None where that is too little."""
    drawn, pixels = matches(features, photograph.features)
    columns, rows = np.floor(drawn).astype(int).T
    points = places[rows.clip(0, len(places) - 1), columns.clip(0, places.shape[1] - 1)]
    known = np.isfinite(points).all(axis=1)
    points, pixels = points[known], pixels[known]
    if len(points) < MIN_INLIERS:
        return None
    K = photograph.camera.K.detach().cpu().double().numpy()
    answer = cv2.solvePnPRansac(
        points, pixels, K, None, iterationsCount=300, reprojectionError=MAX_ERROR
    )
    if not answer[0] or answer[3] is None or len(answer[3]) < MIN_INLIERS:
        return None
    chosen = answer[3].ravel()
    return Located(photograph, _pose(answer[1], answer[2]), points[chosen], pixels[chosen])


def _pose(rotation: Float[np.ndarray, "3 1"], shift: Float[np.ndarray, "3 1"]) -> Matrix:
    """Camera-to-world of OpenCV's world-to-camera rotation vector and shift."""
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = cv2.Rodrigues(rotation)[0], shift.ravel()
    return np.linalg.inv(viewmat)
