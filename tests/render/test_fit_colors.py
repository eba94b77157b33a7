"""Colours are fitted to an image, whatever else the scene shows there."""

from dataclasses import replace

import pytest
import torch

from gscompleter.evaluation.metrics.image import psnr
from gscompleter.render.fit_colors import fit_colors
from gscompleter.render.loading import load_renderer
from gscompleter.types import SH_C0
from scenes import Room, camera_at, gaussians_of, half_a_room_of, view_of

CAMERA = camera_at(size=48)
VIEW = view_of(Room(), CAMERA)


@pytest.mark.parametrize("name", ["cpu", pytest.param("reference", marks=pytest.mark.slow)])
def test_an_image_gets_back_what_rendering_blurs(name):
    blurred, renderer = gaussians_of(VIEW), load_renderer(name)
    fitted = fit_colors(blurred, [renderer.freeze(blurred[:0], CAMERA)], [VIEW], [1.7] * 4)
    before, after = (
        psnr(renderer.render(scene, CAMERA).image, VIEW.image) for scene in (blurred, fitted)
    )
    assert after > before + 2
    for kept in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(fitted, kept), getattr(blurred, kept))


def test_new_gaussians_make_up_for_what_the_scene_shows_before_and_behind_them():
    _, context, added = half_a_room_of(Room(), CAMERA)
    thin = replace(context, opacities=0.5 * context.opacities, means=0.99 * context.means)
    frozen = load_renderer("cpu").freeze(thin, CAMERA)
    before, after = (
        psnr(frozen.composite(new).image, VIEW.image)
        for new in (added, fit_colors(added, [frozen], [VIEW], [1.7] * 4))
    )
    assert after > before + 0.5


def test_colours_change_alike_in_all_directions():
    plain, renderer = gaussians_of(VIEW), load_renderer("cpu")
    linear = 0.1 * torch.randn(len(plain), 3, 3, generator=torch.Generator().manual_seed(0))
    tinted = replace(plain, sh=torch.cat([plain.sh, linear], dim=1))
    fitted = fit_colors(tinted, [renderer.freeze(plain[:0], CAMERA)], [VIEW], [1.7] * 8)
    assert torch.equal(fitted.sh[:, 1:], linear)
    before, after = (
        psnr(renderer.render(scene, CAMERA).image, VIEW.image) for scene in (tinted, fitted)
    )
    assert after > before + 5


def test_no_round_keeps_the_colours():
    scene = gaussians_of(VIEW)
    kept = fit_colors(scene, [load_renderer("cpu").freeze(scene[:0], CAMERA)], [VIEW], [])
    assert torch.equal(kept.sh, scene.sh)


def test_no_colour_is_brighter_than_what_the_images_show():
    _, context, added = half_a_room_of(Room(), CAMERA)
    # Dark smoke in front of the additions, through which they are to show as bright as they are.
    dark = replace(context, sh=torch.full_like(context.sh, -1.7), means=0.99 * context.means)
    thin = replace(dark, opacities=0.9 * dark.opacities)
    frozen = load_renderer("cpu").freeze(thin, CAMERA)
    fitted = fit_colors(added, [frozen], [VIEW], [1.7] * 4)
    colors = 0.5 + SH_C0 * fitted.sh[:, 0]
    assert colors.max() == pytest.approx(1.0, abs=1e-5)
    assert colors.min() > -1e-5
