"""Likeness of a scene to unused photographs, and consistency of poses with shared features."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gscompleter.evaluation.metrics.image import compute_masked_ssim, ssim
from gscompleter.evaluation.metrics.unused_photographs import measure_likeness, shrink_view
from gscompleter.numerics.geometry import axis_angle_to_matrix
from gscompleter.reconstructors.features.consistency import (
    count_consistent_matches,
    measure_pose_errors,
)
from gscompleter.types import Render, View
from scenes import Room, camera_at, view_of

ROOM = Room()
USED, OTHER = view_of(ROOM, camera_at(-0.3)), view_of(ROOM, camera_at(0.1, yaw=3))


def render_of(image: torch.Tensor, alpha: float = 1.0) -> Render:
    size = image.shape[:2]
    return Render(image, torch.ones(size), torch.full(size, alpha))


def test_what_shows_the_photograph_is_nearer_than_a_colour_and_than_other_photographs():
    exact = measure_likeness(render_of(0.8 * OTHER.image + 0.1), OTHER, [USED.image])
    assert exact is not None
    assert exact.above_photograph > 30  # another exposure counts for nothing
    assert exact.above_color > 30
    unmoved = measure_likeness(render_of(USED.image), OTHER, [USED.image])
    assert unmoved is not None
    assert unmoved.above_photograph == pytest.approx(0, abs=1e-9)
    noise = torch.rand(OTHER.image.shape, generator=torch.Generator().manual_seed(0))
    wrong = measure_likeness(render_of(noise), OTHER, [USED.image])
    assert wrong is not None
    assert wrong.above_photograph < 0 < 3 > wrong.above_color


def test_only_covered_pixels_that_are_not_ignored_are_compared():
    assert measure_likeness(render_of(OTHER.image, alpha=0.4), OTHER, [USED.image]) is None
    half = torch.zeros_like(OTHER.image[..., 0], dtype=torch.bool)
    half[:, 48:] = True
    spoilt = torch.where(half[..., None], 0.0, OTHER.image)
    masked = measure_likeness(render_of(spoilt), replace(OTHER, ignore_mask=half), [USED.image])
    whole = measure_likeness(render_of(spoilt), OTHER, [USED.image])
    assert masked is not None
    assert whole is not None
    assert masked.above_color > 30 > whole.above_color


def test_a_small_view_averages_areas_and_keeps_its_rays():
    small = shrink_view(OTHER, 48)
    assert (small.camera.width, small.camera.height) == (48, 48)
    means = OTHER.image.reshape(48, 2, 48, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(small.image, means, atol=1e-5)
    corner = OTHER.camera.z_rays()[:2, :2].mean(dim=(0, 1))
    assert torch.allclose(small.camera.z_rays()[0, 0], corner, atol=1e-5)
    masked = replace(OTHER, ignore_mask=torch.zeros(96, 96, dtype=torch.bool))
    masked.ignore_mask[0, 1] = True
    assert shrink_view(masked, 48).ignore_mask.nonzero().tolist() == [[0, 0]]
    assert shrink_view(OTHER, 200) is OTHER


@pytest.mark.parametrize(("width", "height"), [(640, 427), (1000, 667), (1920, 1280)])
def test_a_small_view_without_a_mask_ignores_nothing(width, height):
    camera = replace(OTHER.camera, width=width, height=height)
    small = shrink_view(View(torch.zeros(height, width, 3), camera))
    assert small.valid_mask.all()


def test_the_best_single_colour_has_a_mean_of_each_channel():
    green = torch.tensor([0.1, 0.8, 0.1]).expand(OTHER.image.shape)
    likeness = measure_likeness(render_of(green), replace(OTHER, image=green), [USED.image])
    assert likeness is not None
    assert likeness.above_color == pytest.approx(0, abs=1e-6)


def test_ssim_of_a_region_is_that_of_its_pixels_alone():
    everywhere = torch.ones(96, 96, dtype=torch.bool)
    both = USED.image, OTHER.image
    assert compute_masked_ssim(*both, everywhere) == pytest.approx(ssim(*both), abs=1e-6)
    left = everywhere.clone()
    left[:, 48:] = False
    spoilt = torch.where(left[..., None], OTHER.image, 0.0)
    assert compute_masked_ssim(spoilt, OTHER.image, left) == pytest.approx(1, abs=1e-6)
    assert compute_masked_ssim(spoilt, OTHER.image, everywhere) < 0.8
    assert compute_masked_ssim(*both, ~everywhere) is None


def test_features_fit_true_poses_and_not_wrong_ones():
    cameras = [camera_at(x, yaw=yaw, size=128) for x, yaw in ((-0.5, -16), (0.0, 0), (0.5, 16))]
    views = [view_of(ROOM, camera) for camera in cameras]
    true = count_consistent_matches(views)
    assert true.total > 30
    assert true.share > 0.8
    roll = axis_angle_to_matrix(torch.tensor([0.0, 0.0, 1.0]), math.radians(30))
    turned = []
    for number, view in enumerate(views):
        c2w = view.camera.c2w.clone()
        if number != 1:
            c2w[:3, :3] @= roll if number == 0 else roll.T
        turned.append(replace(view, camera=replace(view.camera, c2w=c2w)))
    wrong = count_consistent_matches(turned)
    assert wrong.total > 30
    assert wrong.share < 0.3


def test_features_without_parallax_confirm_a_rotation():
    near = camera_at(0.0, size=128)
    turned = camera_at(0.002, yaw=10, size=128)
    count = count_consistent_matches([view_of(ROOM, near), view_of(ROOM, turned)])
    assert count.total > 30
    assert count.share > 0.8


@pytest.mark.parametrize("pixels", [3, 15, 60])
def test_the_pose_that_is_off_has_the_largest_error_in_pixels(pixels):
    """However far it is off: its matches are not false, although they are far from its poses."""
    cameras = [camera_at(x, size=128) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    views = [view_of(ROOM, camera) for camera in cameras]
    true = measure_pose_errors(views)
    assert all(error is not None and error < 0.4 for error in true)
    # A rotation about the horizontal axis moves pixels across the epipolar lines.
    off = measure_pose_errors(pitch_middle(views, pixels / views[0].camera.K[1, 1].item()))
    assert all(error is not None for error in off)
    assert max(range(5), key=lambda number: off[number]) == 2
    assert off[2] == pytest.approx(pixels, rel=0.3)


@pytest.mark.parametrize("number", [0, 2, 4])
def test_a_photograph_of_twice_the_size_is_off_by_twice_as_many_of_its_pixels(number):
    """Wherever it stands among the others: each error is in pixels of its own photograph."""
    sizes = [256 if each == number else 128 for each in range(5)]
    places = zip((-0.4, -0.2, 0.0, 0.2, 0.4), sizes, strict=True)
    views = [view_of(ROOM, camera_at(x, size=size)) for x, size in places]
    pixels = 12.0
    off = measure_pose_errors(
        turn_camera(views, number, pixels / views[number].camera.K[1, 1].item())
    )
    assert off[number] == pytest.approx(pixels, rel=0.2)


def test_a_camera_that_looks_back_is_off_by_an_image():
    views = [view_of(ROOM, camera_at(x, size=128)) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    assert measure_pose_errors(pitch_middle(views, math.pi))[2] == 128


def pitch_middle(views: list[View], radians: float) -> list[View]:
    """Turn the third camera about its horizontal axis, not its photograph."""
    return turn_camera(views, 2, radians)


def turn_camera(views: list[View], number: int, radians: float) -> list[View]:
    """Turn a camera about its horizontal axis, not its photograph."""
    pitch = axis_angle_to_matrix(torch.tensor([1.0, 0.0, 0.0]), radians)
    view = views[number]
    c2w = view.camera.c2w.clone()
    c2w[:3, :3] @= pitch
    turned = replace(view, camera=replace(view.camera, c2w=c2w))
    return [*views[:number], turned, *views[number + 1 :]]


def test_pose_errors_are_unknown_without_features_or_without_a_baseline():
    flat = [
        replace(view_of(ROOM, camera_at(x, size=64)), image=OTHER.image[:64, :64] * 0)
        for x in (0, 1, 2)
    ]
    assert measure_pose_errors(flat) == [None] * 3
    here = [view_of(ROOM, camera_at(0.0, yaw=yaw, size=64)) for yaw in (0, 5, 10)]
    assert measure_pose_errors(here) == [None] * 3
