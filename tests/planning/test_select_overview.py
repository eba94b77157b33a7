"""Selection of context views without a target."""

from itertools import pairwise

import torch

from gscompleter import Camera
from gscompleter.planning.select_context import make_points_in_front
from gscompleter.planning.select_overview import find_medoids, has_partner, select_overview
from scenes import camera_at


def points(cameras: list[Camera]) -> torch.Tensor:
    return torch.cat([make_points_in_front(camera, 2.0, 4.0) for camera in cameras])


def test_of_a_walk_every_nth_photograph_is_taken():
    cameras = [camera_at(0.1 * number) for number in range(15)]
    chosen = select_overview(cameras, points(cameras), 5)
    assert len(chosen) == 5
    gaps = [after - before for before, after in pairwise(chosen)]
    assert min(gaps) >= 2
    assert chosen[0] <= 2
    assert chosen[-1] >= 12


def test_the_order_of_the_photographs_does_not_matter():
    cameras = [camera_at(0.1 * number, yaw=number) for number in range(12)]
    places = [{0.1 * i for i in find_medoids(cameras, 4)}]
    shuffled = cameras[5:] + cameras[:5]
    places.append({0.1 * ((i + 5) % 12) for i in find_medoids(shuffled, 4)})
    assert len(places[0] & places[1]) >= 2


def test_each_photograph_has_another_that_sees_the_same():
    """Three directions without overlap, four photographs each."""
    cameras = [camera_at(x, yaw=yaw) for yaw in (0, 120, 240) for x in (0.0, 0.1, 0.2, 0.3)]
    chosen = select_overview(cameras, points(cameras), 6)
    assert [sum(i // 4 == side for i in chosen) for side in range(3)] == [2, 2, 2]
    assert all(has_partner(i, chosen, cameras, points(cameras)) for i in chosen)


def test_two_photographs_in_one_place_are_no_pair():
    cameras = [camera_at(), camera_at(), camera_at(yaw=180)]
    assert not has_partner(0, [0, 1, 2], cameras, points(cameras))
    assert select_overview(cameras[:2], points(cameras), 8) == [0, 1]
    # Nor are two of which the second stands a thousandth of the distance aside.
    cameras = [camera_at(), camera_at(0.003), camera_at(0.1)]
    assert not has_partner(0, [0, 1], cameras, points(cameras))
    assert has_partner(0, [0, 2], cameras, points(cameras))


def test_no_more_are_chosen_than_are_wanted():
    cameras = [camera_at(x, yaw=90 * x) for x in (0.0, 1.0, 2.0, 3.0)]
    for count in (2, 3, 4, 9):
        assert 2 <= len(select_overview(cameras, points(cameras), count)) <= count
