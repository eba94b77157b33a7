"""Given poses beside the poses that matches allow."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from gscompleter import load_views
from gscompleter.numerics.two_views import compute_sampson_distances
from gscompleter.reconstructors.features.consistency import measure_pose_errors
from gscompleter.reconstructors.features.epipolar import (
    fit_relative_pose,
    measure_pose_fit,
)
from gscompleter.types import View
from scenes import Room, camera_at, view_of

FOCALS = (np.array([300.0, 300.0]), np.array([300.0, 300.0]))


def turn_view(view: View, degrees: float) -> View:
    """Turn the camera of a view to the side and up, not its photograph."""
    turn = cv2.Rodrigues(np.radians([degrees, degrees, 0.0]))[0]
    c2w = view.camera.c2w.clone()
    c2w[:3, :3] = c2w[:3, :3] @ torch.from_numpy(turn).float()
    return replace(view, camera=replace(view.camera, c2w=c2w))


@pytest.fixture(scope="module")
def pair() -> list[View]:
    """Photograph a room from two places."""
    return [view_of(Room(), camera_at(x=x, size=160)) for x in (-0.2, 0.2)]


@pytest.mark.parametrize("degrees", [0.3, 8.0])
def test_matches_contradict_a_camera_that_is_turned(pair, degrees):
    right = measure_pose_fit(pair)
    assert right is not None
    assert not right.is_contradicted
    turned = measure_pose_fit([pair[0], turn_view(pair[1], degrees)])
    assert turned is not None
    assert turned.is_contradicted
    assert turned.given > 3 * right.given
    # The fit finds the pose that the photograph was taken with.
    assert turned.fitted == pytest.approx(right.fitted, rel=0.3)


def test_a_photograph_alone_and_cameras_in_one_place_contradict_nothing(pair):
    assert measure_pose_fit(pair[:1]) is None
    assert measure_pose_fit([pair[0], turn_view(pair[0], 1.0)]) is None


@pytest.mark.parametrize("measure", [measure_pose_fit, lambda views: measure_pose_errors(views)[0]])
def test_centres_that_differ_by_rounding_are_one_place(pair, measure):
    """In float32, 10.000001 is the next number after 10."""
    views = []
    for x in (10.0, 10.000001, 10.0):
        c2w = pair[0].camera.c2w.clone()
        c2w[0, 3] = x
        views.append(replace(pair[0], camera=replace(pair[0].camera, c2w=c2w)))
    assert measure(views) is None


def test_a_small_photograph_does_not_magnify_distances_in_large_ones(pair):
    places = (-0.2, 0.0, 0.2)
    views = [view_of(Room(), camera_at(x=x, size=256)) for x in places]
    alone = measure_pose_fit(views)
    blank = view_of(Room(), camera_at(x=0.1, size=32))
    blank = replace(blank, image=torch.zeros_like(blank.image))
    beside = measure_pose_fit([*views, blank])
    assert alone is not None
    assert beside is not None
    # A photograph without features has no match, and so no part in the medians.
    assert beside.given == pytest.approx(alone.given, rel=0.05)


def test_the_distance_is_that_of_both_features_from_their_lines():
    # A camera moves along x, so that epipolar lines are rows of the image.
    pose = np.eye(3), np.array([1.0, 0.0, 0.0])
    a = np.array([[0.1, 0.2, 1.0]])
    b = np.array([[0.4, 0.2 + 3 / FOCALS[1][1], 1.0]])
    # Three pixels between rows: both features move half of it, each by 1.5, so √2 · 1.5 together.
    distance = compute_sampson_distances(*pose, (a, b), FOCALS)
    assert np.abs(distance[0]) == pytest.approx(3 / np.sqrt(2))


def test_the_pose_of_points_is_found_from_one_beside_it():
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 2], [1, 1, 5], (80, 3))
    turn = cv2.Rodrigues(np.array([0.02, -0.1, 0.03]))[0]
    shift = np.array([0.5, 0.1, -0.2])
    seen = points @ turn.T + shift
    rays = points / points[:, 2:], seen / seen[:, 2:]
    beside = cv2.Rodrigues(np.array([0.003, 0.004, -0.002]))[0]
    start = turn @ beside, np.array([0.9, 0.2, -0.3]) / np.linalg.norm([0.9, 0.2, -0.3])
    rotation, direction = fit_relative_pose(start, rays, FOCALS)
    assert np.abs(rotation - turn).max() < 1e-6
    assert np.abs(direction - shift / np.linalg.norm(shift)).max() < 1e-5


def test_false_matches_of_a_pair_with_nearly_right_poses_do_not_count(shared):
    # More matches fit a geometry without poses, false ones among them; with these no pose fits.
    views = load_views(shared / "data" / "hololens_room", [0, 3], (256, 256), near=0.5, far=10.0)
    fit = measure_pose_fit(views)
    assert fit is not None
    assert fit.is_contradicted
