"""Φ: photographed surfaces are shown, holes are filled plausibly, and results are repeatable."""

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from gscompleter import InputError, load_generator, load_renderer
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.generators.exposure import match_exposures
from gscompleter.generators.warp import WarpedImage, fill_background_first, warp_photographs
from gscompleter.generators.warp_inpaint import (
    Sources,
    WarpInpaint,
    fill_by_patches,
    remove_cracks,
)
from gscompleter.numerics.smooth import compute_distance_to_known, continue_smoothly
from gscompleter.types import Camera, GeneratorInput, Render, View, merge
from known_room import SIZE, TARGET, known_room
from scenes import Room, answer, camera_at, gaussians_of, view_of


def synthesized(context: GeneratorInput, seed: int = 0) -> torch.Tensor:
    return WarpInpaint(seed=seed)(context.views[1], TARGET, context)


def within(mask: torch.Tensor, image: torch.Tensor, truth: torch.Tensor) -> float:
    """PSNR in dB over the pixels of `mask`."""
    return psnr(image[mask][None], truth[mask][None])


def test_the_observed_part_is_sharper_than_the_render_and_the_hole_follows_its_border():
    """The wave texture is predictable only near the border of the hole."""
    context, truth = known_room(), view_of(Room(), TARGET).image
    image = synthesized(context)
    hole = context.target_render.alpha < 0.5
    assert hole.float().mean() > 0.1
    assert within(~hole, image, truth) > within(~hole, context.target_render.image, truth) + 2
    border = hole & (compute_distance_to_known(~hole) <= 4)
    flat = image[~hole].mean(dim=0).expand_as(image)
    assert within(border, image, truth) > within(border, flat, truth) + 1


def test_a_photograph_of_another_exposure_leaves_no_seam():
    """The farther photograph is 1.3 times as bright; shared surfaces show the ratio."""
    truth = view_of(Room(), TARGET).image
    even, uneven = known_room(), known_room(gain=1.3)
    seen = even.target_render.alpha >= 0.5
    expected, image = synthesized(even), synthesized(uneven)
    assert within(seen, image, truth) > within(seen, expected, truth) - 1
    _, gain_of_nearest = warped_gains(uneven)
    assert torch.equal(gain_of_nearest, torch.ones(3))


def warped_gains(context: GeneratorInput) -> tuple[torch.Tensor, ...]:
    return warp_photographs(context.views[1], TARGET, context).gains


def test_the_gain_between_two_exposures_is_found():
    gain_of_farther, _ = warped_gains(known_room(gain=0.8))
    assert torch.allclose(gain_of_farther, torch.full((3,), 1 / 0.8), rtol=0.03)


def test_photographs_that_share_nothing_keep_their_exposure():
    bright, dark = torch.full((20, 20, 3), 0.8), torch.full((20, 20, 3), 0.4)
    left = torch.arange(20).expand(20, 20) < 10
    first, second = match_exposures([bright, dark], [left, ~left], reference=0)
    assert torch.equal(first, torch.ones(3))
    assert torch.equal(second, torch.ones(3))


def test_a_photograph_is_matched_through_another_one():
    colors = [torch.full((20, 20, 3), value) for value in (0.4, 0.6, 0.8)]
    column = torch.arange(20).expand(20, 20)
    visible = [column < 8, (column >= 2) & (column < 14), column >= 8]
    gains = match_exposures(colors, visible, reference=0)
    assert torch.allclose(torch.stack(gains)[:, 0], torch.tensor([1, 2 / 3, 1 / 2]), rtol=1e-5)


def test_what_was_photographed_but_is_missing_in_the_scene_is_shown():
    """A ball of Gaussians is cut out of the wall that both photographs show."""
    target = camera_at(0.4, yaw=5, size=SIZE)
    views = tuple(view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, 0.1))
    scene = merge([gaussians_of(view) for view in views])
    scene = scene[(scene.means - torch.tensor([-1.2, -0.3, 5.0])).norm(dim=-1) > 0.8]
    renderer = load_renderer("cpu")
    at_views = tuple(renderer.render(scene, view.camera) for view in views)
    context = GeneratorInput(views, at_views, renderer.render(scene, target))
    missing = context.target_render.alpha < 0.5
    missing[:, SIZE // 2 :] = False
    assert missing.sum() > 100
    truth = view_of(Room(), target).image
    image = WarpInpaint()(views[1], target, context)
    assert within(missing, image, truth) > 17
    filled_only = continue_smoothly(
        context.target_render.image, (context.target_render.alpha >= 0.5).float()
    )
    assert within(missing, image, truth) > within(missing, filled_only, truth) + 3


def test_a_smooth_continuation_keeps_a_ramp_going_and_knows_its_border():
    ramp = torch.linspace(0, 1, 64)[:, None, None].expand(64, 64, 3).contiguous()
    weight = torch.ones(64, 64)
    weight[:, 40:] = 0
    filled = continue_smoothly(ramp, weight)
    assert torch.equal(filled[:, :40], ramp[:, :40])
    assert (filled[8:-8, 40:48] - ramp[8:-8, 40:48]).abs().max() < 0.05


@pytest.mark.parametrize(("h", "w"), [(64, 64), (63, 64), (51, 77), (9, 200), (3, 5)])
def test_a_smooth_continuation_takes_images_of_any_size(h, w):
    values = torch.rand(h, w, 4, generator=torch.Generator().manual_seed(0))
    weight = torch.ones(h, w)
    weight[:, w // 2 :] = 0
    filled = continue_smoothly(values, weight)
    assert torch.equal(filled[:, : w // 2], values[:, : w // 2])
    assert torch.isfinite(filled).all()
    assert filled.min() >= values.min() - 1e-4
    assert filled.max() <= values.max() + 1e-4


def test_an_image_of_odd_size_is_completed():
    target = replace(TARGET, width=SIZE - 7, height=SIZE - 15)
    context = known_room()
    scene = merge([gaussians_of(view) for view in context.views])
    odd = replace(context, target_render=load_renderer("cpu").render(scene, target))
    image = WarpInpaint()(context.views[1], target, odd)
    assert image.shape == (SIZE - 15, SIZE - 7, 3)
    assert torch.isfinite(image).all()


def test_a_crack_is_no_hole():
    hole = torch.zeros(40, 40, dtype=torch.bool)
    hole[:, 10:13] = True
    hole[:, 30:] = True
    assert torch.equal(remove_cracks(hole, 4).any(dim=0), torch.arange(40) >= 30)


def test_the_background_fills_what_an_object_uncovers():
    """Red at depth 1 on the left of the gap, blue at depth 4 on its right."""
    image = torch.zeros(32, 48, 3)
    image[:, :16, 0] = 1
    image[:, 32:, 2] = 1
    known = torch.ones(32, 48, dtype=torch.bool)
    known[:, 16:32] = False
    depth = torch.where(torch.arange(48) < 24, 1.0, 4.0).expand(32, 48).contiguous()
    filled = fill_background_first(WarpedImage(image, known, depth, torch.ones(0, 3)))
    middle = filled.image[16, 24]
    assert middle[2] > 5 * middle[0]
    assert filled.depth[16, 24] > 3
    assert torch.equal(filled.depth[known], depth[known])


def test_one_thread_gives_the_same_bytes_as_three(monkeypatch):
    context, images = known_room(), []
    for threads in (1, 3):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        images.append(synthesized(context))
    assert torch.equal(*images)


def test_the_unit_of_length_does_not_matter():
    image = synthesized(known_room())
    for unit in (1e-3, 1e3):
        context = known_room()
        target = in_unit(TARGET, unit)
        larger = GeneratorInput(
            tuple(replace(v, camera=in_unit(v.camera, unit)) for v in context.views),
            tuple(replace(r, depth=unit * r.depth) for r in context.view_renders),
            replace(context.target_render, depth=unit * context.target_render.depth),
        )
        again = WarpInpaint()(larger.views[1], target, larger)
        assert (again - image).abs().mean() < 1e-3


def in_unit(camera: Camera, unit: float) -> Camera:
    c2w = camera.c2w.clone()
    c2w[:3, 3] *= unit
    return replace(camera, c2w=c2w)


def test_the_image_is_complete_and_in_range():
    image = synthesized(known_room())
    assert image.shape == (SIZE, SIZE, 3)
    assert image.isfinite().all()
    assert ((image >= 0) & (image <= 1)).all()


def test_the_same_seed_gives_the_same_bytes_and_another_one_others():
    context = known_room()
    first = synthesized(context, seed=1)
    assert torch.equal(first, synthesized(context, seed=1))
    assert not torch.equal(first, synthesized(context, seed=2))


def test_a_target_without_a_hole_and_one_that_sees_nothing_are_answered():
    context = known_room()
    view = context.views[1]
    seen = replace(context, target_render=context.view_renders[1])
    image = WarpInpaint()(view, view.camera, seen)
    assert psnr(image, view.image) > 25
    black = Render(torch.zeros(SIZE, SIZE, 3), torch.zeros(SIZE, SIZE), torch.zeros(SIZE, SIZE))
    image = WarpInpaint()(view, TARGET, replace(context, target_render=black))
    assert torch.allclose(image, view.image.mean(dim=(0, 1)).expand_as(image))


def test_a_hole_too_small_for_the_coarse_levels_is_filled():
    context = known_room()
    view, render = context.views[1], context.view_renders[1]
    alpha = render.alpha.clone()
    alpha[40:42, 50:52] = 0
    pierced = replace(context, target_render=replace(render, alpha=alpha))
    image = WarpInpaint()(view, view.camera, pierced)
    assert (image - view.image)[40:42, 50:52].abs().mean() < 0.1


def test_stripes_continue_into_the_hole():
    x = torch.arange(96)
    stripes = ((x // 4) % 2).float()[None, :, None].expand(96, 96, 3).contiguous()
    known = torch.ones(96, 96, dtype=torch.bool)
    known[36:60, 36:60] = False
    flat_depth = torch.zeros(96, 96)
    sources = Sources.stack_images([stripes], [known], [torch.ones(96, 96)])
    hollow = torch.where(known[..., None], stripes, torch.zeros_like(stripes))
    filled = fill_by_patches(hollow, known, flat_depth, sources, seed=0)
    assert torch.equal(filled[known], stripes[known])
    assert psnr(filled[~known][None], stripes[~known][None]) > 12


def test_a_foreground_object_is_not_copied_behind_itself():
    """Left of the hole lies a red object near by, right of it a grey wall far away."""
    image = torch.full((64, 96, 3), 0.5)
    image += 0.05 * torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(0))
    image[:, :32] = torch.tensor([0.9, 0.1, 0.1])
    depth = torch.full((64, 96), 4.0)
    depth[:, :32] = 1.0
    known = torch.ones(64, 96, dtype=torch.bool)
    known[:, 32:52] = False
    sources = Sources.stack_images([image], [known], [depth])
    behind = torch.full((64, 96), float(np.log(4.0)))
    filled = fill_by_patches(image, known, behind, sources, seed=0)
    right_half = filled[:, 42:52]
    assert (right_half[..., 0] - right_half[..., 1]).mean() < 0.2


def test_the_oracle_returns_the_photograph_and_refuses_without_one():
    photograph = view_of(Room(), TARGET)
    context = known_room()
    image = answer(
        load_generator("oracle", photographs=[*context.views, photograph]),
        context.views[0],
        TARGET,
        context,
    ).image
    assert torch.equal(image, photograph.image)
    with pytest.raises(InputError, match="photograph"):
        oracle = load_generator("oracle", photographs=context.views)
        answer(oracle, context.views[0], TARGET, context)


def test_an_unknown_generator_is_refused():
    with pytest.raises(InputError, match="no generator 'dall-e'"):
        load_generator("dall-e")


def test_photographs_of_another_size_than_the_target_are_used():
    context = known_room()
    small = camera_at(-0.3, size=SIZE // 2)
    view = view_of(Room(), small)
    render = load_renderer("cpu").render(gaussians_of(view), small)
    mixed = GeneratorInput(
        (view, context.views[1]), (render, context.view_renders[1]), context.target_render
    )
    image = WarpInpaint()(View(view.image, small), TARGET, mixed)
    assert image.shape == (SIZE, SIZE, 3)
