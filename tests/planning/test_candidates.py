"""Candidate cameras: moves of cameras whose surroundings are known."""

from dataclasses import replace

import pytest
import torch

from gscompleter import Camera
from gscompleter.config import NextBestViewConfig
from gscompleter.numerics.geometry import (
    compute_field_of_view,
    compute_spacing,
    estimate_up,
    measure_baseline,
    measure_rotation,
    select_spread_cameras,
    shrink_camera,
)
from gscompleter.planning.candidates import (
    find_ground_height,
    make_moves,
    propose_candidates,
)
from gscompleter.types import Render
from scenes import Room, camera_at, cast

UP = torch.tensor([0.0, -1.0, 0.0])


def seen_by(camera: Camera, room: Room = Room()) -> Render:
    """Render the room itself at a camera."""
    image, depth = cast(room, camera)
    return Render(image, depth, torch.ones_like(depth))


def tilted(camera: Camera) -> float:
    """Compute the tilt of a camera's horizon, as a sine."""
    return (camera.c2w[:3, 0] @ UP).abs().item()


def test_there_are_six_translations_four_turns_and_four_orbits():
    camera = camera_at(0.3, yaw=20)
    found = make_moves(camera, 3.0, 0.4, 0.25, UP)
    rotations = torch.tensor([measure_rotation(camera, other) for other in found])
    baselines = torch.tensor([measure_baseline(camera, other) for other in found])
    assert torch.allclose(rotations[:6], torch.zeros(6), atol=1e-3)
    assert torch.allclose(baselines[:6], torch.full((6,), 0.4), rtol=1e-4)
    quarter = torch.rad2deg(torch.tensor(compute_field_of_view(camera)[0] / 4))
    assert torch.allclose(rotations[6:10], quarter.expand(4), rtol=1e-3)
    assert torch.allclose(baselines[6:10], torch.zeros(4), atol=1e-6)
    assert torch.allclose(baselines[10:], torch.full((4,), 0.4), rtol=1e-2)
    looked_at = camera.center + 3.0 * camera.forward
    for other in found[10:]:
        assert torch.allclose(other.center + 3.0 * other.forward, looked_at, atol=1e-5)


def test_no_move_tilts_the_horizon():
    for other in make_moves(camera_at(0.3, yaw=20), 3.0, 0.4, 0.25, UP):
        assert tilted(other) < 1e-5


def test_up_is_what_is_up_in_most_images():
    rolled = camera_at()
    rolled.c2w[:3, :2] = -rolled.c2w[:3, :2]
    cameras = [camera_at(yaw=yaw) for yaw in (0, 90, 200)]
    assert torch.allclose(estimate_up([rolled, *cameras]), UP, atol=1e-6)


def test_a_candidate_behind_a_surface_is_none():
    """The camera is one step in front of the wall at z = 5, which a second one sees from afar."""
    cameras = [camera_at(-2.0, z=4.2), camera_at(-2.0, z=1.0)]
    far = NextBestViewConfig(max_step=1.0)
    found = propose_candidates(cameras, [seen_by(c) for c in cameras], 0.74, far)
    centers = torch.stack([c.camera.center for c in found])
    assert (centers[:, 2] < 4.9).all()
    assert len(found) < 28
    assert sum(c.base == 1 for c in found) == 14


def test_no_camera_moves_near_to_the_ground_or_below_it():
    """The floor is 1.5 below the cameras, and what is right below them is in no photograph."""
    cameras = [camera_at(-0.3), camera_at(0.3)]
    renders = [seen_by(camera) for camera in cameras]
    far = NextBestViewConfig(max_step=1.0)
    for step, is_kept in ((0.7, True), (0.8, False), (2.0, False)):
        centers = [c.camera.center for c in propose_candidates(cameras, renders, step, far)]
        assert (max(center[1].item() for center in centers) > 0.6) is is_kept
    # A wall that fills the images tells of no ground.
    wall = Room((((-30.0, -30.0, -1.0), (30.0, 30.0, 5.0)),))
    renders = [seen_by(camera, wall) for camera in cameras]
    assert find_ground_height(cameras[0], renders[0], UP) is None
    centers = [c.camera.center for c in propose_candidates(cameras, renders, 2.0, far)]
    assert max(center[1].item() for center in centers) == pytest.approx(2.0)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_height_of_the_ground_is_in_scene_units(unit):
    camera = camera_at(unit=unit)
    height = find_ground_height(camera, seen_by(camera, Room(unit=unit)), UP)
    assert height == pytest.approx(-1.5 * unit, rel=0.02)


def test_ground_at_the_depth_of_wrong_matches_does_not_count():
    camera = camera_at()
    seen = seen_by(camera)
    # An eighth of the image, to the left, shows the floor twice as deep.
    depth = seen.depth.clone()
    floor = depth.shape[0] // 2 + 10
    depth[floor:, : depth.shape[1] // 8] *= 2
    height = find_ground_height(camera, replace(seen, depth=depth), UP)
    assert height == pytest.approx(-1.5, rel=0.05)


def test_a_step_is_as_long_as_cameras_stand_apart_and_short_of_the_scene():
    cameras = [camera_at(x) for x in (0.0, 0.2, 0.4)]
    renders = [seen_by(camera) for camera in cameras]
    longest = {
        step: max(
            measure_baseline(c.camera, cameras[c.base])
            for c in propose_candidates(cameras, renders, step)
        )
        for step in (compute_spacing(cameras), 50.0, 0.0)
    }
    assert longest[compute_spacing(cameras)] == pytest.approx(0.2, rel=1e-3)
    assert longest[50.0] == longest[0.0] == pytest.approx(0.2 * 4.6, rel=0.2)


def test_cameras_that_are_spread_are_no_neighbours():
    cameras = [camera_at(x) for x in (0.0, 0.01, 0.02, 1.0, 1.01, 2.0)]
    assert sorted(select_spread_cameras(cameras, 3)) == [0, 3, 5]
    turned = [camera_at(), camera_at(), camera_at(yaw=90)]
    assert select_spread_cameras(turned, 2) == [0, 2]
    assert sorted(select_spread_cameras(cameras, 99)) == list(range(6))


def test_beside_photographs_is_level_between_them_and_towards_the_same_scene():
    cameras = [camera_at(x, yaw=yaw) for x, yaw in ((-0.3, 0), (0.1, 10), (0.7, 12))]
    found = propose_candidates(cameras, [seen_by(c) for c in cameras], 0.3, stays_beside=True)
    assert [c.base for c in found] == [index for index in range(3) for _ in range(5)]
    for candidate in found:
        camera, base = candidate.camera, cameras[candidate.base]
        assert camera.center[1].item() == pytest.approx(base.center[1].item(), abs=1e-5)
        assert tilted(camera) < 1e-5
        assert measure_rotation(camera, base) < 10
        assert measure_baseline(camera, base) < 0.31
    between = found[4].camera
    assert torch.allclose(between.center, (cameras[0].center + cameras[1].center) / 2, atol=1e-6)
    assert measure_rotation(between, cameras[1]) == pytest.approx(5, abs=1e-2)


def test_beside_a_single_photograph_there_is_nothing_between():
    camera = camera_at()
    found = propose_candidates([camera], [seen_by(camera)], 0.3, stays_beside=True)
    assert len(found) == 4
    assert min(measure_baseline(c.camera, camera) for c in found) > 0.29


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_the_unit_of_the_scene_changes_no_candidate(unit):
    places = ((-0.3, 0), (0.1, 10), (0.7, 12))
    found = [
        propose_candidates(
            cameras, [seen_by(c, Room(unit=u)) for c in cameras], compute_spacing(cameras)
        )
        for u in (1.0, unit)
        for cameras in [[camera_at(x, yaw=yaw, unit=u) for x, yaw in places]]
    ]
    assert [c.base for c in found[0]] == [c.base for c in found[1]]
    for one, other in zip(*found, strict=True):
        assert torch.allclose(other.camera.center / unit, one.camera.center, atol=1e-4)


def test_a_small_image_sees_the_same():
    small = shrink_camera(camera_at(size=96), 48)
    assert (small.width, small.height) == (48, 48)
    assert compute_field_of_view(small) == pytest.approx(compute_field_of_view(camera_at(size=96)))
    assert shrink_camera(camera_at(size=40), 48).width == 40


def test_turns_up_and_down_in_place_are_told():
    camera = camera_at()
    turns = [
        candidate.camera
        for candidate in propose_candidates([camera], [seen_by(camera)], 0.3)
        if candidate.looks_up_or_down
    ]
    assert len(turns) == 2
    for turned in turns:
        assert torch.equal(turned.center, camera.center)
        assert (turned.forward - camera.forward)[1].abs() > 0.05
        assert (turned.forward - camera.forward)[0].abs() < 1e-6
