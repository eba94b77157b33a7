"""The alpha threshold of holes is one number, and every stage uses it."""

from dataclasses import replace

import pytest
import torch

from gscompleter import CompleterConfig, GSCompleter, load_renderer
from gscompleter.config import GapConfig, HoleConfig
from gscompleter.config.settings import COVERED
from gscompleter.generators.warp import warp_photographs
from gscompleter.numerics.geometry import project
from gscompleter.stages.align_depth import align_depth
from gscompleter.stages.register import register_along_rays
from gscompleter.stages.select_anchor import choose_anchor
from gscompleter.types import DepthMap, Gaussians, Lift, Reconstruction, Render, merge
from scenes import Room, camera_at, gaussians_of, view_of
from target_views import observe

SIZE = 48
TARGET, ANCHOR = camera_at(0.3, size=SIZE), camera_at(-0.3, size=SIZE)
REFERENCE = view_of(Room(), TARGET)
THIN = torch.zeros(SIZE, SIZE, dtype=torch.bool)
THIN[16:32, 16:32] = True
INNER = torch.zeros_like(THIN)
INNER[18:30, 18:30] = True
"""Pixels inside the thin square, away from its mixed border."""


def thin_scene(depth_error: float = 1.0) -> Gaussians:
    """Make the room at the target, with a square of alpha about 2/3."""
    assert REFERENCE.depth is not None
    scene = gaussians_of(REFERENCE, torch.where(THIN, depth_error, 1.0) * REFERENCE.depth)
    opacities = torch.where(THIN.flatten(), 0.25, scene.opacities)
    return replace(scene, opacities=opacities)


def room_of(views) -> Reconstruction:
    """Make a reconstructor that knows the room."""
    depths = tuple(view_of(Room(), view.camera).depth for view in views)
    return Reconstruction(
        merge([gaussians_of(v, d) for v, d in zip(views, depths, strict=True)]),
        tuple(DepthMap(d, torch.ones_like(d, dtype=torch.bool)) for d in depths),
        torch.cat([torch.full((d.numel(),), i) for i, d in enumerate(depths)]),
        torch.cat([torch.arange(d.numel()) for d in depths]),
    )


def test_the_square_of_these_tests_is_covered_by_more_than_half_and_less_than_four_fifths():
    alpha = load_renderer("cpu").render(thin_scene(), TARGET).alpha
    assert ((alpha[INNER] > COVERED) & (alpha[INNER] < 0.8)).all()


@pytest.mark.parametrize("max_alpha", [COVERED, 0.8])
def test_a_pixel_covered_by_less_than_max_alpha_is_a_hole_that_is_painted_and_kept(max_alpha):
    painted = []

    def phi(nearest, target, context):
        painted.append(~warp_photographs(nearest, target, context).known)
        assert torch.equal(painted[0], context.holes)
        return view_of(Room(), target).image

    # The photographs show the thin square, too, and would fill it before the target.
    config = CompleterConfig(
        margin=0.0,
        holes=HoleConfig(max_alpha, dilation=0),
        add_observed=False,
        gaps=GapConfig(displacement=0.0),
    ).without_guard("free-space")
    views = [view_of(Room(), camera_at(x, size=SIZE), i) for i, x in enumerate((-0.3, 0.0))]
    (result,) = GSCompleter(room_of, phi, config=config)(views, TARGET, thin_scene()).targets
    thin_is_a_hole = max_alpha > COVERED
    assert bool(result.hole_mask[INNER].all()) == thin_is_a_hole
    assert bool(result.hole_mask[INNER].any()) == thin_is_a_hole
    pixels, _ = project(result.added.means, TARGET)
    x, y = pixels.long().unbind(-1)
    assert INNER[y, x].sum() == (INNER.sum() if thin_is_a_hole else 0)
    if thin_is_a_hole:
        assert painted[0][INNER].all()


def test_the_depth_of_a_thin_pixel_is_followed_by_default_and_carried_into_where_it_is_a_hole():
    """The thin square is 10 % too far; its surroundings are correct."""
    scene = thin_scene(1.1)
    truth = REFERENCE.depth
    everywhere = DepthMap(truth, torch.ones_like(THIN))
    anchor = view_of(Room(), ANCHOR)
    candidates = Lift(
        gaussians_of(REFERENCE),
        everywhere,
        DepthMap(anchor.depth, torch.ones_like(THIN)),
        torch.arange(SIZE * SIZE),
    )

    def error(max_alpha: float) -> float:
        config = CompleterConfig(holes=HoleConfig(max_alpha))
        view = observe(scene, [anchor], TARGET, config)
        at_anchor = choose_anchor(view)
        affine = align_depth(candidates, at_anchor, view, torch.Generator().manual_seed(0))
        found = register_along_rays(candidates, affine, REFERENCE, at_anchor, view)
        _, z = project(found.gaussians.means, TARGET)
        return ((z.reshape(SIZE, SIZE) / truth - 1).abs()[INNER]).median().item()

    assert error(COVERED) > 0.04
    assert error(0.8) < 0.015


def test_rendered_depth_is_valid_where_half_of_the_pixel_is_covered():
    alpha = torch.tensor([[0.49, COVERED, 0.79, 1.0]])
    render = Render(torch.zeros(1, 4, 3), torch.ones(1, 4), alpha)
    assert render.depth_map().valid.tolist() == [[False, True, True, True]]
    assert HoleConfig().max_alpha == COVERED
