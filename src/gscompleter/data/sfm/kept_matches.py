"""Tracks of features that are kept back from structure from motion, and what they say of it.

The cameras are found without them. So they tell whether cameras are right, which the matches that
the cameras were fitted to cannot: a photograph in a wrong place fits its own matches, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gscompleter.numerics.two_views import (
    ERROR_SIDE,
    Focals,
    Rays,
    compute_sampson_distances,
)

KEPT_BACK = 5
"""One track of features in so many is kept back, on average: each is drawn by itself."""
MIN_PAIR_MATCHES = 5
"""Fewest matches of a pair that were kept back for it to say something."""
MAX_DISTANCE = 1.0
"""Largest median distance of a photograph's kept matches from their epipolar lines, in pixels of an
image whose shorter side is `ERROR_SIDE`."""
MAX_PAIR_DISTANCE = 1.5
"""Largest such distance between two photographs one of which confirms the other."""
MIN_CONFIRMING_PHOTOGRAPHS = 2
"""Fewest photographs that confirm the place of one. One alone does not tell how far away it was
taken: any point of the line between both has the same epipolar lines."""

ImagePair = tuple[int, int]
"""Numbers of two images."""
NumberedMatches = dict[ImagePair, Int[np.ndarray, "_ 2"]]
"""Numbers of the matching features of two images, by the numbers of the images."""
Keypoints = dict[int, Float[np.ndarray, "_ 2"]]
"""Features in pixels, by the numbers of the images."""


def keep_back_tracks(database: pycolmap.Database, numbers: list[int]) -> NumberedMatches:
    """Take the matches of one track in `KEPT_BACK` out of the database, and return them.

    A track is a connected component of matches: a feature that any photograph contributes to a
    point is kept back with all others of that point.
    """
    pairs = [
        (i, j)
        for a, i in enumerate(numbers)
        for j in numbers[a + 1 :]
        if database.exists_two_view_geometry(i, j)
    ]
    found = {pair: database.read_two_view_geometry(*pair) for pair in pairs}
    # In one graph the features of all photographs are the nodes, numbered one photograph after the
    # other, and the matches are the edges.
    counts = [len(database.read_keypoints(number)) for number in numbers]
    first_nodes = dict(zip(numbers, np.cumsum([0, *counts[:-1]]).tolist(), strict=True))
    edges = [
        geometry.inlier_matches.astype(np.int64) + np.array([first_nodes[i], first_nodes[j]])
        for (i, j), geometry in found.items()
    ]
    joined = np.concatenate([np.zeros((0, 2), np.int64), *edges])
    graph = coo_array((np.ones(len(joined)), joined.T), shape=(sum(counts),) * 2)
    _, track_of = connected_components(graph, directed=False)
    is_kept_back = np.random.default_rng(0).random(track_of.max(initial=0) + 1) < 1 / KEPT_BACK

    kept: NumberedMatches = {}
    for (pair, geometry), nodes in zip(found.items(), edges, strict=True):
        # Both features of a match are of one track.
        chosen: Bool[np.ndarray, "n"] = is_kept_back[track_of[nodes[:, 0]]]
        matches = geometry.inlier_matches
        if chosen.any():
            kept[pair] = matches[chosen].astype(np.int64)
        geometry.inlier_matches = matches[~chosen]
        database.update_two_view_geometry(*pair, geometry)
    return kept


def measure_pair_distances(
    matches: NumberedMatches,
    rays: dict[int, Rays],
    focals: dict[int, Focals],
    poses: dict[int, pycolmap.Rigid3d],
) -> dict[ImagePair, Float[np.ndarray, "_"]]:
    """Measure the distances of all matches from their epipolar lines, in pixels, of each pair.

    `poses` are world to camera.
    """
    distances = {}
    for (i, j), rows in matches.items():
        relative = (poses[j] * poses[i].inverse()).matrix()
        matched = (rays[i][rows[:, 0]], rays[j][rows[:, 1]])
        signed = compute_sampson_distances(
            relative[:, :3], relative[:, 3], matched, (focals[i], focals[j])
        )
        distances[i, j] = np.abs(signed)
    return distances


@dataclass(frozen=True)
class CheckedPlaces:
    """What matches that were kept back say of a model."""

    dropped: list[int]
    """Numbers of the images that were taken out of it."""
    distance: float
    """Median distance of the others' matches from their epipolar lines, as in `measure_model`."""


def drop_wrong_places(
    model: pycolmap.Reconstruction, kept: NumberedMatches, keypoints: Keypoints
) -> CheckedPlaces:
    """Take photographs out of a model whose places the matches that were kept back do not confirm.

    The worst goes first, since a photograph in a wrong place also contradicts those around it.
    """
    dropped: list[int] = []
    while model.num_reg_images() > 0:
        distances = measure_model(model, kept, keypoints)
        medians = rate_places(distances, list(model.reg_image_ids()))
        # Of several that too few confirm any may go first: without it the others are confirmed no
        # more than with it.
        worst = max(medians, key=lambda number: (medians[number], -number))
        if medians[worst] <= MAX_DISTANCE:
            return CheckedPlaces(dropped, float(np.median(np.concatenate([*distances.values()]))))
        model.deregister_frame(model.images[worst].frame_id)
        dropped.append(worst)
    return CheckedPlaces(dropped, math.inf)


def measure_model(
    model: pycolmap.Reconstruction, kept: NumberedMatches, keypoints: Keypoints
) -> dict[ImagePair, Float[np.ndarray, "_"]]:
    """Measure the distances of kept matches from epipolar lines under the cameras of a model.

    In pixels of an image whose shorter side is `ERROR_SIDE`; infinite for features that the lens of
    the model cannot show. Pairs with fewer than `MIN_PAIR_MATCHES` matches are left out.
    """
    numbers = set(model.reg_image_ids())
    cameras = {number: model.cameras[model.images[number].camera_id] for number in numbers}
    among = {
        pair: rows
        for pair, rows in kept.items()
        if numbers.issuperset(pair) and len(rows) >= MIN_PAIR_MATCHES
    }
    rays = {}
    for number, camera in cameras.items():
        # Without distortion, at z = 1. Pixels that no ray reaches through the lens are NaN.
        flat = np.asarray(camera.cam_from_img(keypoints[number].astype(np.float64)))
        rays[number] = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    # The model has one focal length for both axes (`mapping_process.LENS_MODEL`).
    focals = {n: np.full(2, camera.mean_focal_length()) for n, camera in cameras.items()}
    poses = {number: model.images[number].cam_from_world() for number in numbers}
    distances = measure_pair_distances(among, rays, focals, poses)
    sides = {number: min(camera.width, camera.height) for number, camera in cameras.items()}
    # A distance in two images of unlike size is nearly one in the smaller, whose pixels are wider.
    scaled = {
        (i, j): one * (ERROR_SIDE / min(sides[i], sides[j])) for (i, j), one in distances.items()
    }
    # A feature where the lens shows nothing contradicts it. As NaN it would be the median of all.
    return {pair: np.where(np.isnan(one), np.inf, one) for pair, one in scaled.items()}


def rate_places(
    distances: dict[ImagePair, Float[np.ndarray, "_"]], numbers: list[int]
) -> dict[int, float]:
    """Return the median distance of each image's matches; infinity where too few confirm it."""
    medians = {}
    for number in numbers:
        own = [one for pair, one in distances.items() if number in pair]
        confirming = sum(float(np.median(one)) <= MAX_PAIR_DISTANCE for one in own)
        is_enough = confirming >= MIN_CONFIRMING_PHOTOGRAPHS
        medians[number] = float(np.median(np.concatenate(own))) if is_enough else math.inf
    return medians
