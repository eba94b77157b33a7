"""Stage 4: only Gaussians in holes are kept, and only opacities are refined."""

from dataclasses import replace

import pytest
import torch

from gscompleter.config import CompleterConfig, HoleConfig, RefineConfig
from gscompleter.numerics.image_ops import dilate
from gscompleter.render.loading import load_renderer
from gscompleter.stages.filter_holes import select_in_mask
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.stages.refine import refine, refine_opacities
from gscompleter.types import View, merge
from scenes import Room, camera_at, gaussians_of, half_a_room_of, view_of
from target_views import observe

SIZE = 48
ROOM = Room()
CAMERA = camera_at(size=SIZE)


def test_a_hole_is_where_the_scene_covers_less_than_half_of_the_pixel():
    alpha = torch.tensor([[0.0, 0.49, 0.5, 1.0]])
    assert compute_hole_mask(alpha).tolist() == [[True, True, False, False]]
    assert compute_hole_mask(alpha, HoleConfig(max_alpha=0.3)).tolist() == [
        [True, False, False, False]
    ]


def test_dilation_grows_the_mask_by_its_radius_on_every_side():
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[4, 4] = True
    assert dilate(mask, 3).sum() == 7 * 7
    assert dilate(mask, 3)[1:8, 1:8].all()
    assert torch.equal(dilate(mask, 0), mask)


def test_pixel_aligned_gaussians_are_kept_by_their_pixel():
    view = view_of(ROOM, CAMERA)
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[:, :10] = True
    kept = select_in_mask(gaussians_of(view), torch.arange(SIZE * SIZE), mask, CAMERA)
    assert len(kept) == 10 * SIZE


def test_other_gaussians_are_kept_by_where_they_project():
    view = view_of(ROOM, CAMERA)
    gaussians = gaussians_of(view)
    behind = replace(gaussians, means=-gaussians.means)
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[:, :10] = True
    assert len(select_in_mask(gaussians, None, mask, CAMERA)) == 10 * SIZE
    assert len(select_in_mask(behind, None, mask, CAMERA)) == 0


def half_a_room():
    """Return a context that lacks the right half of a view, and the right half."""
    return half_a_room_of(ROOM, CAMERA)


def refined_by(added, frozen, reference, views, config=RefineConfig()):
    """Refine `added` at one camera, which also took the photographs."""
    plan = frozen.vary_opacities(added)
    return refine_opacities(added, plan, reference, [plan] * len(views), views, config)


@pytest.mark.parametrize("parametrization", ["logit", "linear"])
def test_opacities_rise_where_the_hole_shows_and_nothing_else_moves(parametrization):
    view, context, added = half_a_room()
    faint = replace(added, opacities=torch.full((len(added),), 0.3))
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    config = RefineConfig(parametrization=parametrization)
    refined, losses = refined_by(faint, frozen, view, [view], config)
    assert losses[-1] < 0.8 * losses[0]
    assert refined.opacities.mean() > 0.5
    assert ((refined.opacities >= 0) & (refined.opacities <= 1)).all()
    for name in ("means", "quats", "scales", "sh"):
        assert torch.equal(getattr(refined, name), getattr(faint, name))


def test_a_floater_before_a_photograph_loses_opacity():
    """The photograph is black where the new Gaussians would be visible."""
    view, context, added = half_a_room()
    photograph = view.image.clone()
    photograph[:, SIZE // 2 :] = 0
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    dark = View(photograph, CAMERA)
    refined, _ = refined_by(added, frozen, dark, [dark])
    assert (refined.opacities < added.opacities).float().mean() > 0.5
    assert refined.opacities.mean() < 0.8


def test_refinement_ends_where_nothing_is_to_be_gained():
    """The image at the target equals the render, and no photograph shows the new Gaussians."""
    _, context, added = half_a_room()
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    shown = View(frozen.composite(added).image, CAMERA)
    config = RefineConfig()
    _, losses = refined_by(added, frozen, shown, [], config)
    assert len(losses) == 2
    _, losses = refined_by(added, frozen, shown, [], replace(config, rel_tol=None))
    assert len(losses) == config.iterations


def test_without_iterations_opacities_stay_as_they_were_lifted():
    view, context, added = half_a_room()
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    config = RefineConfig(iterations=0)
    refined, losses = refined_by(added, frozen, view, [view], config)
    assert refined is added
    assert losses == ()


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1, 0, 2)])
def test_the_loss_of_eq_13_weighs_the_target_and_sums_the_nearest_photographs(order):
    """λ = 0.1 at the target, and the k = 2 photographs whose cameras are closest to it."""
    config = CompleterConfig.paper()
    _, context, added = half_a_room()
    # Each photograph is darker than the one before, so that each has another error.
    seen = [view_of(ROOM, camera_at(x, size=SIZE)) for x in (0.1, -0.2, 0.5, -0.7)]
    photographs = [replace(v, image=v.image * 0.8**n) for n, v in enumerate(seen)]
    reference = replace(seen[0], image=1 - seen[0].image, camera=CAMERA)
    view = observe(context, [photographs[i] for i in order], CAMERA, config)
    whole = merge([context, added])

    def compute_error(photograph: View) -> float:
        image = load_renderer("cpu").render(whole, photograph.camera).image
        return (image - photograph.image).abs().mean().item()

    expected = 0.1 * compute_error(reference) + sum(map(compute_error, photographs[:2]))
    assert refine(added, reference, view).losses[0] == pytest.approx(expected, rel=1e-4)
