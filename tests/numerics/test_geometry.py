"""Rays and projection undo each other, and relations between cameras are right."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from gscompleter.numerics.geometry import (
    axis_angle_to_matrix,
    embed_cameras,
    is_inside,
    is_same_camera,
    measure_baseline,
    measure_distances,
    measure_rotation,
    multiply_quats,
    pad_camera,
    pad_like,
    project,
    quats_to_rotations,
    remove_padding,
    resize_camera,
    rotations_to_quats,
    sample,
    slerp_rotation,
    unproject,
)
from scenes import Room, camera_at, cast


def test_a_point_behind_a_pixel_projects_to_that_pixels_centre():
    camera = camera_at(0.4, -0.2, 0.1, yaw=20, size=16)
    depth = torch.rand(16, 16, generator=torch.Generator().manual_seed(0)) + 2
    pixels, z = project(unproject(depth, camera), camera)
    centre = torch.arange(16) + 0.5
    assert torch.allclose(pixels[..., 0], centre.expand(16, 16), atol=1e-4)
    assert torch.allclose(pixels[..., 1], centre[:, None].expand(16, 16), atol=1e-4)
    assert torch.allclose(z, depth, atol=1e-5)


def test_the_optical_axis_points_along_z_and_the_top_left_ray_up_and_left():
    camera = camera_at(size=2, focal=0.5)  # pixel centres half a focal length off the axis
    assert camera.z_rays()[0, 0].tolist() == [-0.5, -0.5, 1.0]
    assert torch.allclose(camera.forward, torch.tensor([0.0, 0.0, 1.0]))


def test_points_behind_the_camera_are_not_inside_its_image():
    camera = camera_at()
    pixels, z = project(torch.tensor([[0.0, 0, 3], [0, 0, -3], [9, 0, 3]]), camera)
    assert is_inside(pixels, z, camera).tolist() == [True, False, False]


@pytest.mark.parametrize("angle", [0.0, 1e-3, 44.9, 90.0, 179.0])
def test_rotation_is_the_full_angle_in_degrees(angle):
    assert measure_rotation(camera_at(), camera_at(yaw=angle)) == pytest.approx(angle, abs=1e-4)


def test_baseline_is_the_distance_of_the_centres():
    assert measure_baseline(camera_at(x=1), camera_at(x=4, y=4, yaw=30)) == pytest.approx(5)


def test_the_same_camera_is_recognised_in_any_unit():
    for unit in (0.001, 1.0, 1000.0):
        camera = camera_at(0.3, 0, 0, yaw=10, unit=unit)
        assert is_same_camera(camera, camera_at(0.3, 0, 0, yaw=10, unit=unit))
        assert not is_same_camera(camera, camera_at(0.301, 0, 0, yaw=10, unit=unit))
        assert not is_same_camera(camera, camera_at(0.3, 0, 0, yaw=10.1, unit=unit))


def test_distances_between_cameras_are_the_same_far_from_the_origin():
    cameras = [camera_at(step / 64, step**2 / 64, size=16) for step in range(30)]
    far = torch.tensor([8000.0, 8000.0, 0.0])
    moved = [replace(camera, c2w=camera.c2w.clone()) for camera in cameras]
    for camera in moved:
        camera.c2w[:3, 3] += far
    near, there = (embed_cameras(placed) for placed in (cameras, moved))
    assert torch.allclose(torch.cdist(there, there), torch.cdist(near, near), atol=1e-3)


def test_sampling_at_pixel_centres_returns_the_pixels():
    values = torch.rand(3, 5, 2, generator=torch.Generator().manual_seed(0))
    x, y = torch.meshgrid(torch.arange(5) + 0.5, torch.arange(3) + 0.5, indexing="xy")
    assert torch.allclose(sample(values, torch.stack([x, y], dim=-1)), values, atol=1e-6)


def test_sampling_at_no_pixel_gives_nothing():
    assert sample(torch.zeros(4, 5, 3), torch.zeros(0, 2)).shape == (0, 3)


def test_the_synthetic_room_shows_the_same_colour_from_everywhere():
    room, a, b = Room(), camera_at(-0.3, size=64), camera_at(0.3, size=64)
    image_a, depth_a = cast(room, a)
    image_b, depth_b = cast(room, b)
    pixels, z = project(unproject(depth_a, a), b)
    seen = is_inside(pixels, z, b)
    agrees = seen & ((sample(depth_b[..., None], pixels)[..., 0] - z).abs() < 0.02 * z)
    difference = (sample(image_b, pixels) - image_a).abs().mean(-1)[agrees]
    assert agrees.float().mean() > 0.5
    assert difference.median() < 0.02


def test_a_rotation_is_its_quaternion():
    """Half turns, whose quaternions have a first component of 0, and any others."""
    half_turns = torch.eye(4)[1:]
    others = torch.randn(20, 4, generator=torch.Generator().manual_seed(0))
    rotations = quats_to_rotations(torch.cat([half_turns, others]))
    quats = rotations_to_quats(rotations)
    assert torch.allclose(quats.norm(dim=-1), torch.ones(23))
    assert torch.allclose(quats_to_rotations(quats), rotations, atol=1e-6)


def test_a_product_of_quaternions_turns_by_the_second_and_then_by_the_first():
    first, second = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0))
    turned = quats_to_rotations(multiply_quats(first, second))
    assert torch.allclose(turned, quats_to_rotations(first) @ quats_to_rotations(second), atol=1e-6)
    one_after_all = multiply_quats(first[0], second)
    assert torch.allclose(one_after_all, multiply_quats(first[:1].expand(5, 4), second))


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.5, -2.0, math.pi])
def test_a_turn_about_an_axis_is_its_rotation_vector(angle):
    axis = torch.tensor([2.0, -3.0, 6.0], dtype=torch.float64) / 7
    expected = torch.from_numpy(Rotation.from_rotvec(angle * axis.numpy()).as_matrix())
    assert torch.allclose(axis_angle_to_matrix(axis, angle), expected, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.5, 2.0, 3.1])
def test_two_shares_of_a_turn_are_the_turn(angle):
    axis = torch.tensor([2.0, -3.0, 6.0], dtype=torch.float64) / 7
    turn = axis_angle_to_matrix(axis, angle)
    assert torch.allclose(
        slerp_rotation(turn, 0.25), axis_angle_to_matrix(axis, angle / 4), atol=1e-14
    )
    both = slerp_rotation(turn, 0.25) @ slerp_rotation(turn, 0.75)
    assert torch.allclose(both, turn, atol=1e-14)


def test_of_the_two_ways_to_turn_the_shorter_one_is_shared():
    down = torch.tensor([0.0, 1.0, 0.0])
    turn = axis_angle_to_matrix(down, math.radians(270))
    expected = axis_angle_to_matrix(down, -math.radians(45))
    assert torch.allclose(slerp_rotation(turn, 0.5), expected, atol=1e-6)


def test_a_padded_camera_knows_the_image_that_it_pads():
    camera = camera_at(0.4, yaw=20, size=32)
    pair = pad_camera(camera, 0.25)
    assert (pair.padded.width, pair.padded.padding) == (48, (8, 8))
    inner = remove_padding(pair.padded).target
    assert torch.equal(inner.K, camera.K)
    assert (inner.width, inner.height, inner.padding) == (32, 32, (0, 0))
    # Padding of a padded image, and of one in another size
    assert pad_like(pair.padded, pad_camera(camera, 0.5).padded).padded.padding == (16, 16)
    for size in (5, 24, 96):
        resized = resize_camera(pair.padded, size, size)
        assert abs(resized.padding[0] - size / 6) < 1
    image = torch.rand(48, 48, 3)
    assert torch.equal(pair.crop(pair.paste(torch.ones(32, 32, 3), image)), torch.ones(32, 32, 3))
    assert torch.equal(pair.paste(pair.crop(image), image), image)


def test_a_camera_is_as_far_as_the_nearest_target():
    cameras = [camera_at(0.0), camera_at(2.0), camera_at(-1.0)]
    distances = measure_distances(cameras, [camera_at(0.5), camera_at(-3.0)])
    assert distances.tolist() == pytest.approx([0.5, 1.5, 1.5])
    assert len(measure_distances([], [camera_at(0.0)])) == 0
