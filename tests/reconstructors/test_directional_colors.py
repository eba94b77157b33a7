"""Colours by direction: each photograph keeps its own, and cameras beyond it see them too."""

from dataclasses import replace

import pytest
import torch

from color_fits import fit_with, measure_covered
from gscompleter.numerics.geometry import axis_angle_to_matrix
from gscompleter.reconstructors.plane_sweep.directional_colors import (
    ColorLine,
    fit_directional_colors,
)
from gscompleter.reconstructors.plane_sweep.virtual_views import (
    UNCONFIRMED_DETAIL,
    WarpedPhotograph,
    confirm_detail,
    extrapolate_camera,
    find_nearest_camera,
    make_virtual_views,
)
from gscompleter.render.loading import load_renderer
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import View, merge
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 96
GAIN = 0.85
WALL = 4.0


def take_pair() -> list[View]:
    """Two photographs of a room; the second is darker."""
    first, second = (view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.2, 0.2))
    return [first, replace(second, image=GAIN * second.image)]


def test_rays_of_the_two_photographs_are_at_minus_one_and_one():
    views = take_pair()
    scene = gaussians_of(views[0])
    line = ColorLine.between(scene, views[0].camera, views[1].camera)
    for view, expected in zip(views, (-1.0, 1.0), strict=True):
        at = line.locate(scene, view.camera)
        assert torch.allclose(at, torch.full_like(at, expected), atol=1e-3)


def test_harmonics_are_the_line_in_every_direction():
    views = take_pair()
    scene = gaussians_of(views[0])
    line = ColorLine.between(scene, views[0].camera, views[1].camera)
    generator = torch.Generator().manual_seed(0)
    colors = 0.4 + 0.2 * torch.rand(len(scene), 3, generator=generator)
    gradients = 0.02 * torch.randn(len(scene), 3, generator=generator)
    sh = line.to_sh(colors, gradients)
    for x in (-0.2, 0.0, 0.2, 0.6):
        camera = camera_at(x, size=SIZE)
        expected = colors + line.locate(scene, camera) * gradients
        found = evaluate_colors(sh, scene.means, camera.center)
        assert torch.allclose(found, expected.clamp_min(0), atol=1e-3)


def test_a_camera_is_extrapolated_in_place_and_rotation():
    before, camera = camera_at(0.0, size=SIZE), camera_at(0.3, size=SIZE)
    turned = camera.c2w.clone()
    turned[:3, :3] = axis_angle_to_matrix(torch.tensor([0.0, 1.0, 0.0]), 0.1) @ turned[:3, :3]
    beyond = extrapolate_camera(before, replace(camera, c2w=turned))
    twice = axis_angle_to_matrix(torch.tensor([0.0, 1.0, 0.0]), 0.2) @ before.c2w[:3, :3]
    assert torch.allclose(beyond.c2w[:3, :3], twice, atol=1e-5)
    assert torch.allclose(beyond.center, 2 * camera.center - before.center, atol=1e-6)


@pytest.mark.parametrize("offset", [0.0, 3e-8])
def test_the_nearest_camera_is_none_that_looks_elsewhere_from_the_same_place(offset):
    """Views of a panorama have one place, up to the rounding of their poses."""
    cameras = [camera_at(0.1, yaw=yaw, size=SIZE) for yaw in (0, 90)] + [camera_at(0.5, size=SIZE)]
    moved = cameras[1].c2w.clone()
    moved[0, 3] += offset
    cameras[1] = replace(cameras[1], c2w=moved)
    assert [find_nearest_camera(camera, cameras) for camera in cameras[:2]] == [2, 2]


def test_virtual_photographs_show_what_the_nearer_photograph_does():
    views, renderer = take_pair(), load_renderer("cpu")
    scene = merge([gaussians_of(view) for view in views])
    depths = [renderer.render(scene, view.camera).depth_map() for view in views]
    virtual = make_virtual_views(scene, views, depths, renderer)
    for made, gain, x in zip(virtual, (1.0, GAIN), (-0.6, 0.6), strict=True):
        truth = gain * view_of(Room(), camera_at(x, size=SIZE)).image
        seen = renderer.render(scene, made.camera).alpha > 0.9
        assert made.camera.center[0] == pytest.approx(x, abs=1e-5)
        difference = (made.image - truth).abs().mean(dim=-1)[seen]
        assert difference.median() < 0.01


def look_at_fine_wall(x: float) -> View:
    """Photograph a wall with waves that are 3 pixels long, from `x`."""
    camera = camera_at(x, size=SIZE)
    across, down = (camera.center + WALL * camera.z_rays())[..., :2].unbind(dim=-1)
    wavenumber = 2 * torch.pi / (3 * WALL / camera.K[0, 0])
    waves = torch.sin(wavenumber * across) * torch.cos(0.1 * wavenumber * down)
    image = (0.5 + 0.3 * waves)[..., None].expand(SIZE, SIZE, 3).contiguous()
    return View(image, camera, depth=torch.full((SIZE, SIZE), WALL))


def test_virtual_photographs_keep_the_finest_detail_that_both_photographs_show():
    views, renderer = [look_at_fine_wall(x) for x in (-0.2, 0.23)], load_renderer("cpu")
    scene = merge([gaussians_of(view) for view in views])
    depths = [renderer.render(scene, view.camera).depth_map() for view in views]
    for made in make_virtual_views(scene, views, depths, renderer):
        truth = look_at_fine_wall(made.camera.center[0].item()).image
        middle = slice(SIZE // 3, 2 * SIZE // 3)
        shown, wanted = (one[middle, middle] - 0.5 for one in (made.image, truth))
        assert (shown * wanted).sum() > 0.75 * wanted.square().sum()


def test_detail_counts_as_far_as_the_other_photograph_has_it_there():
    generator = torch.Generator().manual_seed(0)
    noises = [0.5 + 0.1 * torch.randn(SIZE, SIZE, 3, generator=generator) for _ in range(2)]
    seen = torch.ones(SIZE, SIZE)
    own, other = (WarpedPhotograph(noise, seen) for noise in noises)

    def measure_detail(by: WarpedPhotograph) -> float:
        return ((confirm_detail(own, by) - 0.5).std() / (own.image - 0.5).std()).item()

    assert measure_detail(own) > 0.99
    # Of detail that is elsewhere little more than the blurred image is left.
    assert measure_detail(other) < 0.4
    unseen = replace(own, share=torch.zeros(SIZE, SIZE))
    assert measure_detail(unseen) == pytest.approx(UNCONFIRMED_DETAIL, abs=0.05)


def test_each_photograph_keeps_its_tone_and_cameras_beyond_see_the_nearer_one():
    views = take_pair()
    scene, fitted = fit_with(fit_directional_colors, views)
    for view in views:
        assert measure_covered(fitted, view) > measure_covered(scene, view) + 1
    for gain, x in ((1.0, -0.45), (GAIN, 0.45)):
        unseen = view_of(Room(), camera_at(x, size=SIZE))
        unseen = replace(unseen, image=gain * unseen.image)
        assert measure_covered(fitted, unseen) > measure_covered(scene, unseen) + 0.5


def test_colours_stay_calm_far_off_the_photographs():
    _, fitted = fit_with(fit_directional_colors, take_pair())
    for x in (-1.5, 1.5):
        center = camera_at(x, size=SIZE).center
        colors = evaluate_colors(fitted.sh, fitted.means, center)
        middle = evaluate_colors(fitted.sh, fitted.means, torch.zeros(3))
        assert (colors - middle).abs().quantile(0.95) < 0.25


def test_without_parallax_colours_do_not_depend_on_the_direction():
    """Gaussians very far away, as those of the sky, get no gradient."""
    views = take_pair()
    far = [gaussians_of(view, torch.full((SIZE, SIZE), 1e5)) for view in views]
    scene, renderer = merge(far), load_renderer("cpu")
    depths = [renderer.render(scene, view.camera).depth_map() for view in views]
    fitted = fit_directional_colors(scene, views, depths, renderer)
    center = views[0].camera.center
    ahead = evaluate_colors(fitted.sh, fitted.means, center)
    aside = evaluate_colors(fitted.sh, fitted.means, center + torch.tensor([1e5, 0.0, 0.0]))
    assert (ahead - aside).abs().max() < 0.05
