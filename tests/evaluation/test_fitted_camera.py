"""The score without the errors of the target's own camera."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter.evaluation.metrics.fitted_camera import (
    MAX_MOVE,
    blur,
    clamp_image,
    compute_move_jacobian,
    fit_gains,
    measure_fitted,
    move_camera_by,
)
from gscompleter.evaluation.metrics.scores import compute_view_psnr
from gscompleter.render.loading import load_renderer
from gscompleter.types import Camera, Gaussians, View
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 96
NO_HOLES = torch.zeros(SIZE, SIZE, dtype=torch.bool)


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    """Lift a photograph of the room with its true depth."""
    return gaussians_of(view_of(Room(), camera_at(size=2 * SIZE)))


@pytest.fixture(scope="module")
def target(scene) -> View:
    """Take the picture of the scene itself as the photograph, so that nothing else is wrong."""
    # Askew: the discs of a wall that is seen head-on have one depth, and the smallest turn changes
    # which of them is in front.
    camera = move_camera_by(camera_at(0.1, size=SIZE), np.array([5.0, 4.0, 3.0, 0, 0, 0]), 1.0)
    return View(load_renderer("cpu").render(scene, camera).image.clamp(0, 1), camera)


@pytest.mark.parametrize("move", [[0.0, 1.5, 0.0, 0.0, 0.0, 0.0], [0.8, -0.5, 0.6, 0.7, -1.0, 0.5]])
def test_a_camera_that_was_shifted_on_purpose_costs_nothing(scene, target, move):
    renderer = load_renderer("cpu")
    shifted = replace(target, camera=move_camera_by(target.camera, np.array(move), 0.03))
    plain = compute_view_psnr(renderer.render(scene, shifted.camera).image, shifted)
    fitted = measure_fitted(scene, shifted, NO_HOLES, renderer)
    assert fitted is not None
    assert plain < 28
    assert fitted.psnr > plain + 20
    assert fitted.moved > 0.5
    assert fitted.gain == pytest.approx(1, abs=0.02)


def test_a_large_image_does_not_get_worse(scene):
    """The pose is searched for in a small image, where the scene has to look the same."""
    room = Room()
    large = view_of(room, camera_at(size=640))
    lifted = gaussians_of(large)
    renderer = load_renderer("cpu")
    target = view_of(room, camera_at(0.05, size=640))
    plain = compute_view_psnr(renderer.render(lifted, target.camera).image, target)
    fitted = measure_fitted(lifted, target, torch.zeros(640, 640, dtype=torch.bool), renderer)
    assert fitted is not None
    assert fitted.psnr > plain - 0.01


def stretch_rows(camera: Camera, factor: int) -> Camera:
    """Give a camera pixels that are as wide, and only a part as high."""
    K = camera.K.clone()
    K[1] *= factor
    return replace(camera, K=K, height=factor * camera.height)


@pytest.mark.parametrize("factor", [1, 2])
def test_derivatives_are_how_colours_change_with_the_camera(scene, target, factor):
    renderer, camera = load_renderer("cpu"), stretch_rows(target.camera, factor)
    median, focal = 3.5, float(camera.K[0, 0])
    render = renderer.render(scene, camera)
    rays = camera.z_rays() @ camera.c2w[:3, :3]
    depth = render.depth.where(render.alpha > 0.5, median)
    points = (rays * depth[..., None]).double().numpy()
    image = blur(clamp_image(render), 1.5)
    jacobian = compute_move_jacobian(image, points, median, (focal, factor * focal))
    for number in range(6):
        move = 0.1 * np.eye(6)[number]
        moved = renderer.render(scene, move_camera_by(camera, move, median / focal))
        change = (blur(clamp_image(moved), 1.5) - image) / 0.1
        # Not at the border, where the blur sees no further.
        ours, truth = (x[8:-8, 8:-8].ravel() for x in (jacobian[..., number], change))
        assert np.corrcoef(ours, truth)[0, 1] > 0.9
        assert (ours @ truth) / (truth @ truth) == pytest.approx(1, abs=0.25)


def test_a_camera_whose_pixels_are_not_square_costs_nothing(scene, target):
    renderer = load_renderer("cpu")
    camera = stretch_rows(target.camera, 2)
    photograph = renderer.render(scene, camera).image.clamp(0, 1)
    move = np.array([0.8, -0.5, 0.6, 0.7, -1.0, 0.5])
    shifted = View(photograph, move_camera_by(camera, move, 0.03))
    holes = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    fitted = measure_fitted(scene, shifted, holes, renderer)
    assert fitted is not None
    assert fitted.psnr > 60


def test_another_exposure_costs_nothing(scene, target):
    darker = replace(target, image=target.image * 0.8)
    fitted = measure_fitted(scene, darker, NO_HOLES, load_renderer("cpu"))
    assert fitted is not None
    assert fitted.gain == pytest.approx(0.8, abs=0.005)
    assert fitted.psnr > 45
    assert fitted.moved < 0.05


def test_a_right_camera_stays_and_what_is_wrong_in_the_scene_still_counts(scene, target):
    renderer = load_renderer("cpu")
    # A black square in the photograph, which the scene does not have.
    image = target.image.clone()
    image[30:50, 30:50] = 0
    wrong = replace(target, image=image)
    fitted = measure_fitted(scene, wrong, NO_HOLES, renderer)
    assert fitted is not None
    assert fitted.moved < 0.5
    plain = compute_view_psnr(renderer.render(scene, target.camera).image, wrong)
    assert fitted.psnr == pytest.approx(plain, abs=0.6)


def test_pixels_in_holes_decide_nothing(scene, target):
    holes = NO_HOLES.clone()
    holes[:, 60:] = True
    image = target.image.clone()
    image[:, 60:] = 0.5
    fitted = measure_fitted(scene, replace(target, image=image), holes, load_renderer("cpu"))
    assert fitted is not None
    assert fitted.moved < 0.05
    assert fitted.observed_psnr > 60
    assert fitted.psnr < 30
    assert measure_fitted(scene, target, ~NO_HOLES, load_renderer("cpu")) is None


@pytest.mark.filterwarnings("error")
def test_no_pose_is_fitted_where_shrinking_leaves_no_pixel(scene, target):
    # A strip of 2,400 pixels, of which a smaller image has no whole row outside of the margin.
    size = 400
    camera = camera_at(0.1, size=size)
    photograph = View(torch.full((size, size, 3), 0.5), camera)
    holes = torch.ones(size, size, dtype=torch.bool)
    holes[100:106] = False
    assert measure_fitted(scene, photograph, holes, load_renderer("cpu")) is None


def test_a_camera_far_from_its_photograph_is_not_searched_for(scene, target):
    far = replace(target, camera=move_camera_by(target.camera, np.full(6, 20.0), 0.03))
    fitted = measure_fitted(scene, far, NO_HOLES, load_renderer("cpu"))
    assert fitted is not None
    assert fitted.moved <= MAX_MOVE * np.sqrt(6)


def test_gains_are_those_of_least_squares():
    image = np.random.default_rng(0).random((8, 9, 3))
    image[..., 2] = 0
    gains = fit_gains(image, image * [0.5, 2.0, 1.0], np.ones((8, 9), bool))
    assert gains.tolist() == pytest.approx([0.5, 2.0, 1.0])
