"""Φ: what was photographed is shown, what was not is filled plausibly, always the same way."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import InputError, load_generator, load_renderer
from gscompleter.evaluation.metrics import psnr
from gscompleter.generators.oracle import Oracle
from gscompleter.generators.warp_inpaint import WarpInpaint
from gscompleter.generators.warp_inpaint.exemplar import Sources, fill_by_patches
from gscompleter.types import Render, SceneContext, View, merge
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 96
TARGET = camera_at(0.7, yaw=12, size=SIZE)


def known_room(gain: float = 1.0) -> SceneContext:
    """Two photographs and the scene they give, as seen by them and by the target."""
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, 0.1)]
    views[0] = replace(views[0], image=gain * views[0].image)
    scene = merge([gaussians_of(view) for view in views])
    renderer = load_renderer("cpu")
    return SceneContext(
        tuple(views),
        tuple(renderer.render(scene, view.camera) for view in views),
        renderer.render(scene, TARGET),
    )


def synthesized(context: SceneContext, seed: int = 0) -> torch.Tensor:
    return WarpInpaint(seed=seed)(context.views[1], TARGET, context)


def test_the_observed_part_is_right_and_the_hole_is_better_than_black():
    context, truth = known_room(), view_of(Room(), TARGET).image
    image = synthesized(context)
    hole = context.at_target.alpha < 0.5
    assert hole.float().mean() > 0.1
    assert psnr(image[~hole][None], truth[~hole][None]) > 22
    black = context.at_target.image
    gain = psnr(image[hole][None], truth[hole][None]) - psnr(black[hole][None], truth[hole][None])
    assert gain > 2


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
    seen = replace(context, at_target=context.at_views[1])
    image = WarpInpaint()(view, view.camera, seen)
    assert psnr(image, view.image) > 25
    black = Render(torch.zeros(SIZE, SIZE, 3), torch.zeros(SIZE, SIZE), torch.zeros(SIZE, SIZE))
    image = WarpInpaint()(view, TARGET, replace(context, at_target=black))
    assert torch.allclose(image, view.image.mean(dim=(0, 1)).expand_as(image))


def test_a_hole_too_small_for_the_coarse_levels_is_filled():
    context = known_room()
    view, render = context.views[1], context.at_views[1]
    alpha = render.alpha.clone()
    alpha[40:42, 50:52] = 0
    pierced = replace(context, at_target=replace(render, alpha=alpha))
    image = WarpInpaint()(view, view.camera, pierced)
    assert (image - view.image)[40:42, 50:52].abs().mean() < 0.1


def test_stripes_continue_into_the_hole():
    x = torch.arange(96)
    stripes = ((x // 4) % 2).float()[None, :, None].expand(96, 96, 3).contiguous()
    known = torch.ones(96, 96, dtype=torch.bool)
    known[36:60, 36:60] = False
    flat_depth = torch.zeros(96, 96)
    sources = Sources.stacked([stripes], [known], [torch.ones(96, 96)])
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
    sources = Sources.stacked([image], [known], [depth])
    behind = torch.full((64, 96), float(np.log(4.0)))
    filled = fill_by_patches(image, known, behind, sources, seed=0)
    right_half = filled[:, 42:52]
    assert (right_half[..., 0] - right_half[..., 1]).mean() < 0.2


def test_the_oracle_returns_the_photograph_and_refuses_without_one():
    photograph = view_of(Room(), TARGET)
    context = known_room()
    image = Oracle([*context.views, photograph])(context.views[0], TARGET, context)
    assert torch.equal(image, photograph.image)
    with pytest.raises(InputError, match="photograph"):
        Oracle(context.views)(context.views[0], TARGET, context)


def test_an_unknown_generator_is_refused():
    with pytest.raises(InputError, match="no generator 'dall-e'"):
        load_generator("dall-e")


def test_photographs_of_another_size_than_the_target_are_used():
    context = known_room()
    small = camera_at(-0.3, size=SIZE // 2)
    view = view_of(Room(), small)
    render = load_renderer("cpu").render(gaussians_of(view), small)
    mixed = SceneContext((view, context.views[1]), (render, context.at_views[1]), context.at_target)
    image = WarpInpaint()(View(view.image, small), TARGET, mixed)
    assert image.shape == (SIZE, SIZE, 3)
