"""Cameras around a target, whose renders show what surrounds its hole."""

from dataclasses import replace

import pytest
import torch

from gscompleter.config.settings import COVERED
from gscompleter.numerics.geometry import measure_baseline, measure_rotation
from gscompleter.render.loading import load_renderer
from gscompleter.types import Gaussians, merge
from gscompleter.virtual_capture.around_target import choose_cameras_around
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 64
RENDERER = load_renderer("cpu")
TARGET = replace(camera_at(size=SIZE), near=None, far=None)


@pytest.fixture(scope="module")
def room() -> Gaussians:
    """Return what four cameras see of a room."""
    cameras = [camera_at(x, size=SIZE, focal=0.5) for x in (-0.5, 0.5)]
    return merge([gaussians_of(view_of(Room(), camera)) for camera in cameras])


def cut_back_wall(room: Gaussians) -> Gaussians:
    """Cut a hole into the back wall, in the middle of what the target sees."""
    x, y, z = room.means.unbind(1)
    return room[~((z > 4) & (x.abs() < 0.8) & (y.abs() < 0.5))]


def test_cameras_see_the_border_of_the_hole_from_places_of_their_own(room):
    cut = cut_back_wall(room)
    cameras = choose_cameras_around(cut, TARGET, RENDERER)
    assert len(cameras) == 3
    depth = 5.0
    for camera in cameras:
        assert 0.05 * depth < measure_baseline(camera, TARGET) < 0.5 * depth
        assert measure_rotation(camera, TARGET) < 30
        alpha = RENDERER.render(cut, camera).alpha
        assert 0.6 < (alpha >= COVERED).float().mean() < 1.0
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert measure_baseline(cameras[first], cameras[second]) > 0.01 * depth
    assert len(choose_cameras_around(cut, TARGET, RENDERER, count=1)) == 1


def test_without_a_hole_there_are_none_and_a_marked_place_is_one(room):
    assert choose_cameras_around(room, replace(TARGET, K=zoom(TARGET)), RENDERER) == []
    marked = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    marked[20:30, 30:40] = True
    close = replace(TARGET, K=zoom(TARGET))
    assert len(choose_cameras_around(room, close, RENDERER, holes=marked)) == 3


def zoom(camera) -> torch.Tensor:
    """Return intrinsics of a longer lens, which sees nothing but the back of the room."""
    K = camera.K.clone()
    K[[0, 1], [0, 1]] *= 1.5
    return K


def test_the_same_splat_gives_the_same_cameras(room):
    cut = cut_back_wall(room)
    first = choose_cameras_around(cut, TARGET, RENDERER)
    again = choose_cameras_around(cut, TARGET, RENDERER)
    assert all(torch.equal(a.c2w, b.c2w) for a, b in zip(first, again, strict=True))
