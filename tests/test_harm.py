"""Stage 4: additions make no photograph worse."""

from dataclasses import replace

import pytest
import torch

from gscompleter.config import PsnrGuardConfig
from gscompleter.metrics.image import psnr, ssim
from gscompleter.render import in_colours, load_renderer
from gscompleter.stages import harm
from gscompleter.stages.harm import (
    do_no_harm,
    error_budgets,
    error_with_loss,
    errors,
    fewest,
    is_undone,
    squared_error,
)
from gscompleter.types import ErrorBudget, View, merge
from scenes import Room, camera_at, gaussians_of, half_a_room_of, view_of

SIZE = 48
ROOM = Room()
CAMERA = camera_at(size=SIZE)


def half_a_room():
    """Return a context that lacks the right half of a view, and the right half."""
    return half_a_room_of(ROOM, CAMERA)


def mse(view: View, limit: float) -> ErrorBudget:
    return ErrorBudget(view, "mse", limit)


MENDED = PsnrGuardConfig(max_opacity_loss=None)
"""Budgets without a limit on the lost opacity."""


@pytest.mark.parametrize(("halvings", "removals"), [(0, 0), (0, 12), (16, 12)])
def test_no_photograph_is_matched_worse_than_allowed(halvings, removals, monkeypatch):
    """Gaussians of wrong colour occlude everything that the camera sees."""
    view = view_of(ROOM, CAMERA)
    context = gaussians_of(view)
    harmful = replace(gaussians_of(view, torch.full((SIZE, SIZE), 1.0)), sh=-context.sh)
    renderer = load_renderer("cpu")
    frozen = renderer.freeze(context, CAMERA)
    before = squared_error(frozen.context.image, view.image).item()
    assert squared_error(frozen.composite(harmful).image, view.image).item() > 10 * before

    allowed = error_with_loss(before, 0.05)
    monkeypatch.setattr(harm, "HALVINGS", halvings)
    monkeypatch.setattr(harm, "REMOVALS", removals)
    mended = do_no_harm(harmful, [frozen], [[mse(view, allowed)]], MENDED)
    assert squared_error(frozen.composite(mended).image, view.image).item() <= allowed
    assert len(mended) == len(harmful)


def test_what_has_to_go_for_the_most_part_goes_altogether_and_soon(monkeypatch):
    view = view_of(ROOM, CAMERA)
    context = gaussians_of(view)
    harmful = replace(gaussians_of(view, torch.full((SIZE, SIZE), 1.0)), sh=-context.sh)
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    allowed = error_with_loss(squared_error(frozen.context.image, view.image).item(), 0.05)
    trials: list[bool] = []

    def counted(*arguments: torch.Tensor) -> bool:
        trials.append(is_undone(*arguments))
        return trials[-1]

    monkeypatch.setattr(harm, "is_undone", counted)
    assert len(do_no_harm(harmful, [frozen], [[mse(view, allowed)]])) == 0
    assert trials == [*[False] * (len(trials) - 1), True]
    assert len(trials) < harm.HALVINGS


def test_drawings_that_are_known_already_are_asked_instead():
    view = view_of(ROOM, CAMERA)
    context = gaussians_of(view)
    harmful = replace(gaussians_of(view, torch.full((SIZE, SIZE), 1.0)), sh=-context.sh)
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    allowed = error_with_loss(squared_error(frozen.context.image, view.image).item(), 0.05)
    asked: list[torch.Tensor] = []
    folded = in_colours(frozen.plan_appearance(harmful, view.counted), harmful.sh)

    def draw(opacities: torch.Tensor) -> torch.Tensor:
        asked.append(opacities)
        return folded(opacities)

    mended = do_no_harm(harmful, [frozen], [[mse(view, allowed)]], MENDED, [draw])
    assert len(asked) > 2
    assert squared_error(folded(mended.opacities), view.image).item() <= allowed
    expected = do_no_harm(harmful, [frozen], [[mse(view, allowed)]], MENDED)
    assert (mended.opacities - expected.opacities).abs().mean() < 1e-3


def test_where_halving_does_not_help_only_the_worst_pixels_are_given_up(monkeypatch):
    """Half of the image is filled correctly; something wrong occludes the other half."""
    view, context, added = half_a_room()
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    near = gaussians_of(view, torch.full((SIZE, SIZE), 1.0))
    wrong = replace(near, sh=-near.sh)[: SIZE // 4]
    allowed = error_with_loss(squared_error(frozen.composite(added).image, view.image).item(), 0.05)
    monkeypatch.setattr(harm, "HALVINGS", 0)
    mended = do_no_harm(merge([added, wrong]), [frozen], [[mse(view, allowed)]])
    assert squared_error(frozen.composite(mended).image, view.image).item() <= allowed
    assert mended.opacities[: len(added)].mean() > 0.9 * added.opacities.mean()
    assert mended.opacities[len(added) :].mean() < 0.5 * wrong.opacities.mean()


def test_the_whole_photograph_is_judged_with_the_holes_of_the_context():
    """Additions may not make a hole worse."""
    view, context, added = half_a_room()
    dark = replace(view, image=0.02 * view.image)
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    image, holes = frozen.context.image, frozen.context.alpha < 0.5
    assert holes.float().mean() > 0.3
    budgets = error_budgets(dark, image, holes, 0.02, 0.001)
    for budget in budgets[1:]:
        assert errors(frozen.composite(added).image, budget).sum() > budget.limit
    mended = do_no_harm(added, [frozen], [budgets], MENDED)
    change = psnr(frozen.composite(mended).image, dark.image) - psnr(image, dark.image)
    assert change >= -0.02
    assert ssim(frozen.composite(mended).image, dark.image) >= ssim(image, dark.image) - 0.001
    only_seen = do_no_harm(added, [frozen], [budgets[:1]], MENDED)
    assert psnr(frozen.composite(only_seen).image, dark.image) < psnr(image, dark.image) - 1


def test_what_keeps_psnr_but_loses_ssim_gives_way():
    """A veil reduces contrast; only SSIM is limited."""
    view = view_of(ROOM, CAMERA)
    context = gaussians_of(view)
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    image = frozen.context.image
    near = gaussians_of(view, torch.full((SIZE, SIZE), 1.0))
    veil = replace(near, sh=-near.sh, opacities=near.opacities * 0.3)
    holes = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    budgets = error_budgets(view, image, holes, 100.0, 0.001)
    assert [budget.metric for budget in budgets] == ["mse", "dssim"]
    assert ssim(frozen.composite(veil).image, view.image) < ssim(image, view.image) - 0.01
    mended = do_no_harm(veil, [frozen], [budgets], MENDED)
    assert ssim(frozen.composite(mended).image, view.image) >= ssim(image, view.image) - 0.0011
    assert mended.opacities.sum() > 0


def test_the_error_of_similarity_is_that_of_the_scores():
    view = view_of(ROOM, CAMERA)
    image = load_renderer("cpu").render(gaussians_of(view), CAMERA).image.clamp(0, 1)
    error = errors(image, ErrorBudget(view, "dssim", 0.0)).sum().item()
    assert 1 - error == pytest.approx(ssim(image, view.image), abs=1e-3)


def test_what_does_no_harm_keeps_its_opacity():
    view, context, added = half_a_room()
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    before = squared_error(frozen.context.image, view.image).item()
    kept = do_no_harm(added, [frozen], [[mse(view, error_with_loss(before, 0.05))]])
    assert torch.equal(kept.opacities, added.opacities)


def test_the_fewest_gaussians_that_suffice_are_lowered():
    relief = torch.tensor([0.1, 0.4, -1.0, 0.3, 0.2])
    assert fewest(relief, 0.3).tolist() == [False, True, False, False, False]
    assert fewest(relief, 0.45).tolist() == [False, True, False, True, False]
    assert fewest(relief, 9.0).tolist() == [False, True, False, True, False]


def test_without_a_tolerance_nothing_is_checked():
    view, context, added = half_a_room()
    frozen = load_renderer("cpu").freeze(context, CAMERA)
    assert do_no_harm(added, [frozen], [[mse(view, 0.0)]], PsnrGuardConfig(max_drop=None)) is added


def test_half_a_decibel_is_an_error_larger_by_an_eighth():
    assert error_with_loss(1.0, 0.5) == pytest.approx(1.122, abs=1e-3)
