"""Selection of context views, on cameras whose scene is known."""

from dataclasses import replace

import pytest
import torch

from gscompleter import Camera
from gscompleter.numerics.geometry import measure_baseline
from gscompleter.planning.select_context import make_points_in_front, select_context
from scenes import camera_at

TARGET = camera_at(0.0)
WALL = make_points_in_front(TARGET, 2.0, 4.0)
"""Points two to four units in front of the target."""


def chosen(candidates: list[Camera], count: int = 2, targets: tuple[Camera, ...] = (TARGET,)):
    return select_context(list(targets), candidates, WALL, count)


def test_the_photographs_on_both_sides_of_the_target_are_chosen():
    cameras = [camera_at(x) for x in (-2.0, -1.0, -0.2, 0.2, 1.0, 2.0)]
    assert chosen(cameras) == [2, 3]
    assert chosen(cameras, 3)[:2] == [1, 2] or chosen(cameras, 3)[1:] == [3, 4]


def test_two_that_stand_in_one_place_are_no_pair():
    """The closest photograph exists twice; depth needs one from another place."""
    cameras = [camera_at(0.1), camera_at(0.1), camera_at(0.6)]
    first, second = (cameras[i] for i in chosen(cameras))
    assert measure_baseline(first, second) > 0.1


def test_no_photograph_is_chosen_twice_where_all_stand_in_one_place():
    """A camera that only turns, or the parts of a panorama: no pair has any parallax."""
    cameras = [camera_at(yaw=30 * turn) for turn in range(12)]
    assert chosen(cameras, 3) == [0, 1, 11]


def test_a_photograph_that_looks_away_loses_to_one_farther_off():
    away, turned, far = camera_at(0.1, yaw=180), camera_at(-0.1, yaw=75), camera_at(0.9)
    assert chosen([away, turned, far, camera_at(-0.3)]) == [2, 3]


def test_a_tele_photograph_of_a_corner_loses_to_one_that_shows_all():
    tele = camera_at(0.1, yaw=20, focal=6.0)
    assert chosen([tele, camera_at(-0.2), camera_at(0.3)]) == [1, 2]


def test_every_target_gets_photographs_of_its_own():
    other = camera_at(0.0, yaw=120)
    cameras = [camera_at(x, yaw=yaw) for yaw in (0, 120) for x in (-0.3, -0.2, 0.2, 0.3)]
    points = torch.cat([WALL, make_points_in_front(other, 2.0, 4.0)])
    found = select_context([TARGET, other], cameras, points, 4)
    assert sum(index < 4 for index in found) == 2


def test_where_nothing_overlaps_the_closest_are_left():
    cameras = [camera_at(x, yaw=180) for x in (-9.0, 0.4, 9.0, -0.4)]
    assert chosen(cameras) == [1, 3]


def test_a_target_that_sees_no_point_is_taken_to_see_a_plane():
    behind = torch.tensor([[0.0, 0.0, -3.0]]).repeat(30, 1)
    cameras = [camera_at(x, yaw=yaw) for x, yaw in ((0.1, 170), (0.2, 0), (-0.2, 0))]
    assert select_context([TARGET], cameras, behind, 2) == [1, 2]


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_the_unit_of_the_scene_changes_nothing(unit):
    cameras = [camera_at(x, yaw=5 * x) for x in (-2, -1.1, -0.3, 0.2, 0.9, 1.7)]
    scaled = [camera_at(x, yaw=5 * x, unit=unit) for x in (-2, -1.1, -0.3, 0.2, 0.9, 1.7)]
    target = camera_at(0.0, unit=unit)
    assert select_context([target], scaled, WALL * unit, 3) == chosen(cameras, 3)


def test_no_more_are_chosen_than_there_are():
    assert chosen([camera_at(0.2)], 8) == [0]
    assert chosen([camera_at(0.2), camera_at(0.4)], 8) == [0, 1]
    same = [replace(camera_at(0.2)) for _ in range(3)]
    assert len(chosen(same, 3)) == 3


def test_the_nearest_follow_before_those_that_show_a_little_more():
    """A camera that moves ahead: those far behind the target show more of its borders."""
    places = [number for number in range(-8, 9) if number]
    ahead = [camera_at(0.1 * (i % 3), z=0.1 * number) for i, number in enumerate(places)]
    points = make_points_in_front(TARGET, 0.6, 27.0)
    found = select_context([TARGET], ahead, points, 5)
    assert [places[index] for index in found] == [-4, -2, -1, 1, 2]
    # One that looks away is none of them, wherever it stands.
    away = camera_at(0.01, yaw=180)
    assert 0 not in select_context([TARGET], [away, *ahead], points, 5)
