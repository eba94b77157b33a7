"""Standpoints in a trained splat, and cameras around a place in it."""

import math
from dataclasses import replace

import pytest
import torch

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import add_near_plane, measure_rotation
from gscompleter.render.loading import load_renderer
from gscompleter.types import Gaussians, merge
from gscompleter.virtual_capture.quality import NOTHING, measure_camera_quality
from gscompleter.virtual_capture.standpoints import (
    choose_cameras_around_place,
    find_standpoints,
)
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of

SIZE = 48
RENDERER = load_renderer("cpu")
UP = torch.tensor([0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def room() -> Gaussians:
    """Return what four wide cameras see of a room, all around."""
    cameras = [camera_at(yaw=angle, size=SIZE, focal=0.45) for angle in (0, 90, 180, 270)]
    return merge([gaussians_of(view_of(Room(), camera)) for camera in cameras])


def measure(scene: Gaussians, camera) -> float:
    return measure_camera_quality(scene, camera, RENDERER.freeze(scene, camera)).score


def test_a_view_of_surfaces_is_better_than_one_of_mist_or_of_nothing(room):
    inside = camera_at(size=SIZE)
    assert measure(room, inside) > 0.2
    assert measure(random_gaussians(2000), inside) < 0.5 * measure(room, inside)
    away = camera_at(z=-50.0, yaw=180, size=SIZE)
    assert measure_camera_quality(room, away, RENDERER.freeze(room, away)) == NOTHING
    # Close to a wall, one Gaussian fills much of the image.
    assert measure(room, camera_at(z=4.9, size=SIZE)) < measure(room, inside)


def test_standpoints_are_level_covered_and_apart(room, monkeypatch):
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 80)
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_IMPROVED", 8)
    cameras = find_standpoints(room, UP, 32, RENDERER, 4)
    assert len(cameras) == 4
    for camera in cameras:
        assert (camera.width, camera.height) == (32, 32)
        # The horizon is level, and the camera is the right way up.
        assert camera.c2w[1, 0].abs() < 1e-4
        assert camera.c2w[1, 1] > 0.5
        alpha = RENDERER.render(room, add_near_plane(camera, room.means)).alpha
        assert (alpha >= COVERED).float().mean() > 0.8
    turns = [measure_rotation(cameras[0], other) for other in cameras[1:]]
    assert max(turns) > 20


# `test_around_target.py` finds the same cameras again in short.
@pytest.mark.slow
def test_the_same_standpoints_are_found_again(room, monkeypatch):
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 80)
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_IMPROVED", 8)
    first, again = (find_standpoints(room, UP, 32, RENDERER, 4) for _ in "ab")
    assert all(torch.equal(a.c2w, b.c2w) for a, b in zip(first, again, strict=True))


def test_cameras_around_a_place_show_it_from_several_sides(room):
    crate = torch.tensor([-0.1, 0.9, 2.4])
    chosen = (room.means - crate).norm(dim=1) < 0.8
    cameras = choose_cameras_around_place(room, chosen, UP, 64, RENDERER)
    assert 3 <= len(cameras) <= 6
    middle = room.means[chosen].median(dim=0).values
    for camera in cameras:
        away = middle - camera.center
        assert camera.forward @ (away / away.norm()) > math.cos(0.1)
        frozen = RENDERER.freeze(room, add_near_plane(camera, room.means))
        assert (frozen.splat(chosen.float()) > 0.5).float().mean() > 0.01
    assert measure_rotation(cameras[0], cameras[1]) > 10


def test_what_nothing_shows_has_no_cameras_around(room):
    hidden = random_gaussians(50)
    hidden = hidden[:20]
    closed = merge([room, hidden])
    chosen = torch.zeros(len(closed), dtype=torch.bool)
    chosen[-20:] = True
    invisible = torch.where(chosen, 0.0, closed.opacities)
    scene = replace(closed, opacities=invisible)
    assert choose_cameras_around_place(scene, chosen, UP, 64, RENDERER) == []
