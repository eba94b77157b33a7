"""Objects on nothing are told from scenes by their Gaussians."""

from dataclasses import replace

import pytest
import torch

from gscompleter.render.loading import load_renderer
from gscompleter.types import Camera, Gaussians, merge
from gscompleter.virtual_capture import kind
from gscompleter.virtual_capture.kind import is_object
from gscompleter.virtual_capture.standpoints import find_standpoints
from scenes import Room, camera_at, gaussians_of, view_of
from solids import (
    ALL_FACES,
    CEILING,
    FLOOR,
    armchair,
    box,
    chair,
    cover,
    figure_on_disc,
    garden,
    person,
    room,
    stone,
    street,
    table,
)

RENDERER = load_renderer("cpu")
UP = torch.tensor([0.0, -1.0, 0.0])
OBJECTS = {
    "chair": chair,
    "person": person,
    "armchair": armchair,
    "table": table,
    "figure on a disc": figure_on_disc,
    "stone": stone,
}
SCENES = {
    "closed room": lambda: room(ALL_FACES),
    "room without a ceiling": lambda: room([face for face in ALL_FACES if face != CEILING]),
    "kitchen of three walls": lambda: room([FLOOR, (0, -1), (0, 1), (2, 1)]),
    "corner": lambda: room([FLOOR, (0, -1), (2, 1)]),
    "garden": garden,
    "street": street,
}


def turn(scene: Gaussians, degrees: float) -> Gaussians:
    """Turn a scene of round Gaussians about its vertical axis."""
    angle = torch.deg2rad(torch.tensor(degrees))
    c, s = angle.cos().item(), angle.sin().item()
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return replace(scene, means=scene.means @ rotation.T)


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_on_nothing_is_one(name):
    assert is_object(OBJECTS[name](), RENDERER)


@pytest.mark.parametrize(
    "name",
    [
        *("closed room", "kitchen of three walls", "garden"),
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("room without a ceiling", "corner", "street")
        ),
    ],
)
def test_a_scene_is_none(name):
    assert not is_object(SCENES[name](), RENDERER)


def test_it_depends_neither_on_the_unit_nor_on_the_axes_nor_on_outliers():
    seat = merge([chair(), cover([3000 * torch.eye(3) - 900], 0.02, opacity=0.1)])
    seat = turn(seat, 35.0)
    assert is_object(
        replace(seat, means=1e3 * seat.means + 5e3, scales=1e3 * seat.scales), RENDERER
    )
    kitchen = SCENES["kitchen of three walls"]()
    assert not is_object(turn(kitchen, 20.0), RENDERER)


# `test_witnesses.py` finds such cameras; the next test has cameras of the user.
@pytest.mark.slow
def test_cameras_that_were_found_close_to_an_object_say_nothing(monkeypatch):
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 80)
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_IMPROVED", 8)
    seat = chair()
    found = find_standpoints(seat, UP, 32, RENDERER, 4)
    # They see the chair in nearly all of their images, as they are chosen.
    covered = [RENDERER.render(seat, replace(one, near=0.01)).alpha >= 0.5 for one in found]
    assert min(mask.float().mean().item() for mask in covered) > 0.5
    assert is_object(seat, RENDERER)


def test_cameras_of_the_user_that_stand_between_walls_make_a_scene(monkeypatch):
    # A room whose walls nobody would take for those of a scene, if it were not for the cameras.
    monkeypatch.setattr(kind, "MAX_BOUNDED", 1.0)
    monkeypatch.setattr(kind, "MIN_SEEN_FROM_OUTSIDE", 0.0)
    hall = room([face for face in ALL_FACES if face != CEILING])
    inside = [make_camera((x, 0.0, -1.2)) for x in (-1.0, 0.0, 1.0)]
    outside = [make_camera((x, -3.0, -9.0)) for x in (-1.0, 0.0, 1.0)]
    assert is_object(hall, RENDERER, outside)
    assert not is_object(hall, RENDERER, inside)


def make_camera(center: tuple[float, float, float]) -> Camera:
    c2w = torch.eye(4)
    c2w[:3, 3] = torch.tensor(center)
    return replace(camera_at(size=32), c2w=c2w, near=None, far=None)


def test_what_surrounds_a_splat_makes_it_a_scene():
    shell = cover([box((0, 0, 0), (4.0, 4.0, 4.0), 0.2, [(2, 1), (0, 1), (0, -1)])], 0.2, 0.9)
    # A backdrop has few Gaussians, and so lies outside of the extent.
    assert not is_object(merge([chair(0.01), shell]), RENDERER)


def test_a_part_of_a_room_is_an_object_and_the_room_is_none():
    inside = [camera_at(yaw=angle, size=64, focal=0.3) for angle in (0, 90, 180, 270)]
    whole = merge([gaussians_of(view_of(Room(), camera)) for camera in inside])
    assert not is_object(whole, RENDERER)
    crate = whole[(whole.means - torch.tensor([-0.1, 0.9, 2.6])).norm(dim=1) < 1.0]
    assert is_object(crate, RENDERER)
