"""Witnesses of a splat: cameras from which additions must not hide what it shows."""

import math
from dataclasses import replace

import pytest
import torch

from gscompleter.numerics.geometry import compute_field_of_view, resize_camera
from gscompleter.render.loading import load_renderer
from gscompleter.trust.lifted import find_pixel_center
from gscompleter.types import Camera, Gaussians, merge
from gscompleter.virtual_capture.witnesses import (
    MAX_WITNESSES,
    WIDE,
    WITNESS_SIDE,
    Witnesses,
    choose_witnesses,
    divide_witnesses,
    find_witnesses,
)
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 48
RENDERER = load_renderer("cpu")
UP = torch.tensor([0.0, -1.0, 0.0])


@pytest.fixture(autouse=True)
def _short_search(monkeypatch):
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 60)
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_IMPROVED", 4)


@pytest.fixture(scope="module")
def trained() -> Gaussians:
    """Return a room all around, whose Gaussians have sizes that tell of no camera."""
    cameras = [camera_at(yaw=angle, size=SIZE, focal=0.45) for angle in (0, 90, 180, 270)]
    room = merge([gaussians_of(view_of(Room(), camera)) for camera in cameras])
    return replace(room, scales=torch.full_like(room.scales, 0.08))


def places_of(witnesses: Witnesses) -> set[tuple[float, ...]]:
    found = (*witnesses.guarding, *witnesses.testing)
    return {tuple(camera.center.tolist()) for camera in found}


def path_of(count: int) -> list[Camera]:
    return [camera_at(0.02 * number, size=SIZE) for number in range(count)]


def test_every_fourth_tests_and_the_others_guard():
    cameras = path_of(8)
    witnesses = divide_witnesses(cameras)
    assert witnesses.testing == (cameras[3], cameras[7])
    assert len(witnesses.guarding) == 6
    # Those that guard look around.
    for guard in witnesses.guarding:
        assert math.degrees(max(compute_field_of_view(guard))) == pytest.approx(WIDE)


def test_cameras_of_a_file_are_witnesses_and_of_many_those_that_are_spread(trained):
    known = path_of(20)
    witnesses = choose_witnesses(trained, None, [], known, UP, RENDERER)
    assert places_of(witnesses) == {tuple(camera.center.tolist()) for camera in known}
    many = choose_witnesses(trained, None, [], path_of(200), UP, RENDERER)
    assert len(many.guarding) + len(many.testing) == MAX_WITNESSES


def test_with_few_known_cameras_others_are_found_all_over_the_splat(trained):
    (known,) = path_of(1)
    witnesses = choose_witnesses(trained, None, [], [known], UP, RENDERER)
    found = [*witnesses.guarding, *witnesses.testing]
    assert tuple(known.center.tolist()) in places_of(witnesses)
    assert len(found) > 12
    # They look at all sides of the room.
    directions = torch.stack([camera.forward for camera in found])
    assert directions[:, 2].min() < -0.5
    assert directions[:, 2].max() > 0.5


def test_renders_are_no_witnesses_of_themselves(trained):
    first, *others = find_witnesses(trained, None, UP, RENDERER)
    witnesses = choose_witnesses(trained, None, [resize_camera(first, 64, 64)], [], UP, RENDERER)
    found = [*witnesses.guarding, *witnesses.testing]
    assert len(found) == len(others)
    assert tuple(first.center.tolist()) not in places_of(witnesses)


def test_witnesses_of_a_lifted_splat_stand_beside_its_camera():
    scene = gaussians_of(view_of(Room(), camera_at(size=SIZE)))
    found = find_witnesses(scene, find_pixel_center(scene), UP, RENDERER)
    assert len(found) > 12
    for camera in found:
        assert (camera.width, camera.height) == (WITNESS_SIDE, WITNESS_SIDE)
        assert camera.center.norm() < 1.5
        assert camera.forward[2] > 0.9
