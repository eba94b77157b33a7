"""Colours by direction of many photographs: each keeps its own tone where it stands."""

from dataclasses import replace

import pytest
import torch

from color_fits import fit_with, measure_covered
from gscompleter.reconstructors.plane_sweep.linear_colors import (
    LinearColors,
    fit_linear_colors,
    invert_3x3,
)
from gscompleter.reconstructors.plane_sweep.virtual_views import (
    find_nearest_camera,
    make_virtual_views,
)
from gscompleter.render.loading import load_renderer
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import View, merge
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 64
PLACES = {-0.3: 1.0, 0.0: 0.92, 0.3: 0.85}
"""Places of three photographs, and how bright each is."""


def take_photographs() -> list[View]:
    """Photographs of a room that get darker from left to right."""
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in PLACES]
    return [
        replace(view, image=gain * view.image)
        for view, gain in zip(views, PLACES.values(), strict=True)
    ]


def test_each_photograph_keeps_its_tone_and_cameras_beyond_see_the_nearest_one():
    views = take_photographs()
    scene, fitted = fit_with(fit_linear_colors, views)
    for view in views:
        assert measure_covered(fitted, view) > measure_covered(scene, view) + 1
    for gain, x in ((1.0, -0.55), (0.85, 0.55)):
        unseen = view_of(Room(), camera_at(x, size=SIZE))
        unseen = replace(unseen, image=gain * unseen.image)
        assert measure_covered(fitted, unseen) > measure_covered(scene, unseen) + 0.5


def test_colours_stay_calm_far_off_the_photographs():
    _, fitted = fit_with(fit_linear_colors, take_photographs())
    for x in (-1.5, 1.5):
        colors = evaluate_colors(fitted.sh, fitted.means, camera_at(x, size=SIZE).center)
        middle = evaluate_colors(fitted.sh, fitted.means, torch.zeros(3))
        assert (colors - middle).abs().quantile(0.95) < 0.25


def test_harmonics_are_linear_in_the_ray_in_every_direction():
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=-1)
    reference = torch.nn.functional.normalize(torch.tensor([[0.1, -0.2, 1.0]]), dim=-1)
    colors = LinearColors(
        reference.expand(50, 3),
        0.5 + 0.1 * torch.rand(50, 3, generator=generator),
        0.05 * torch.randn(50, 3, 3, generator=generator),
    )
    expected = colors.evaluate(directions - reference)
    # The Gaussians stand where the directions from the origin lead.
    found = evaluate_colors(colors.to_sh(), directions, torch.zeros(3))
    assert torch.allclose(found, expected.clamp_min(0), atol=1e-5)


def test_a_matrix_times_its_inverse_is_one():
    generator = torch.Generator().manual_seed(0)
    roots = torch.randn(20, 3, 3, generator=generator)
    matrices = roots @ roots.transpose(1, 2) + 0.1 * torch.eye(3)
    products = matrices @ invert_3x3(matrices)
    assert torch.allclose(products, torch.eye(3).expand(20, 3, 3), atol=1e-3)


def test_each_virtual_photograph_stands_beyond_the_nearest_neighbour():
    views = take_photographs()
    cameras = [view.camera for view in views]
    assert find_nearest_camera(cameras[0], cameras) == 1
    # A second photograph from the same place gives no direction to go on in.
    assert find_nearest_camera(cameras[2], [*cameras, cameras[2]]) == 1
    renderer = load_renderer("cpu")
    scene = merge([gaussians_of(view) for view in views])
    depths = [renderer.render(scene, camera).depth_map() for camera in cameras]
    virtual = make_virtual_views(scene, views, depths, renderer)
    places = [view.camera.center[0].item() for view in virtual]
    assert places[0] == pytest.approx(-0.6, abs=1e-5)
    assert abs(places[1]) == pytest.approx(0.3, abs=1e-5)
    assert places[2] == pytest.approx(0.6, abs=1e-5)
