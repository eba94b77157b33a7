"""Stage 3, coarse: the affine is found, and fallbacks are reported."""

from dataclasses import replace

import pytest
import torch

from gscompleter.config import AlignmentConfig, CompleterConfig, DepthAgreementConfig
from gscompleter.guards import Attempt
from gscompleter.guards.agreement import DepthAgreement
from gscompleter.stages.additions import Refined
from gscompleter.stages.align_depth import align_depth, refit_at_target
from gscompleter.stages.align_paper import compare_depth_maps, fit_affine
from gscompleter.stages.select_anchor import choose_anchor
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.types import DepthAffine, DepthMap, Lift, View, merge
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of
from target_views import observe

CONFIG = AlignmentConfig()
CAMERA, SOME = camera_at(size=8), random_gaussians(3)


def depths(low: float = 2.0, high: float = 6.0, size: int = 64) -> torch.Tensor:
    return low + (high - low) * torch.rand(size, size, generator=torch.Generator().manual_seed(1))


def everywhere(depth: torch.Tensor) -> DepthMap:
    return DepthMap(depth, torch.ones_like(depth, dtype=torch.bool))


def fit(predicted: DepthMap, context: DepthMap):
    return fit_affine(compare_depth_maps(predicted, context), torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("scale", "shift"), [(1.3, -0.4), (0.7, 0.9), (1.0, 0.0)])
def test_a_known_affine_is_recovered_under_40_percent_outliers(scale, shift):
    predicted = depths()
    context = scale * predicted + shift
    wrong = torch.rand(64, 64, generator=torch.Generator().manual_seed(2)) < 0.4
    context = torch.where(wrong, depths(1, 20), context)
    affine = fit(everywhere(predicted), everywhere(context))
    assert affine.method == "ransac"
    assert affine.scale == pytest.approx(scale, rel=0.01)
    assert affine.shift == pytest.approx(shift, abs=0.03)
    assert affine.inliers == pytest.approx(1 - wrong.float().mean().item(), abs=0.06)


def test_noise_averages_out_in_the_refit():
    predicted = depths()
    noise = 0.01 * torch.randn(64, 64, generator=torch.Generator().manual_seed(3))
    affine = fit(everywhere(predicted), everywhere((1.1 * predicted + 0.2) * (1 + noise)))
    assert affine.scale == pytest.approx(1.1, abs=2e-3)
    assert affine.shift == pytest.approx(0.2, abs=1e-2)


@pytest.mark.parametrize("unit", [0.001, 1.0, 1000.0])
def test_the_unit_of_the_scene_scales_the_shift_and_nothing_else(unit):
    predicted = depths() * unit
    affine = fit(everywhere(predicted), everywhere(1.2 * predicted + 0.5 * unit))
    assert affine.scale == pytest.approx(1.2, rel=1e-4)
    assert affine.shift == pytest.approx(0.5 * unit, rel=1e-3)


def test_a_wall_without_depth_range_gets_a_scale_and_no_shift():
    wall = 3.0 + 0.01 * depths(0, 1)
    affine = fit(everywhere(wall), everywhere(1.5 * wall))
    assert affine.method == "median"
    assert (affine.scale, affine.shift) == (pytest.approx(1.5, rel=1e-5), 0.0)


def test_depths_that_agree_on_no_line_get_the_median_ratio():
    affine = fit(everywhere(depths(1, 9)), everywhere(depths(1, 90).flip(0)))
    assert affine.method == "median"
    assert affine.shift == 0.0
    assert affine.scale > 0


def test_depth_that_runs_the_wrong_way_is_not_fitted_with_a_negative_scale():
    predicted = depths()
    affine = fit(everywhere(predicted), everywhere(10 - predicted))
    assert affine.scale > 0


def test_with_nothing_to_compare_the_identity_is_left():
    nowhere = DepthMap(depths(), torch.zeros(64, 64, dtype=torch.bool))
    affine = fit(nowhere, everywhere(depths()))
    assert (affine.scale, affine.shift, affine.inliers, affine.method) == (1, 0, 0, "identity")


def test_the_same_seed_gives_the_same_fit():
    predicted, context = everywhere(depths(size=128)), everywhere(depths(1, 9, size=128))
    assert fit(predicted, context) == fit(predicted, context)


def checked(
    scale: float,
    context: torch.Tensor,
    config: AlignmentConfig = CONFIG,
):
    """Check an affine that fits the anchor at a target with the depths `context`."""
    random = torch.Generator().manual_seed(0)
    through_anchor = DepthAffine(scale, 0.0, 0.9, "ransac")
    at_target = compare_depth_maps(everywhere(depths()), everywhere(context))
    return refit_at_target(through_anchor, at_target, random, config)


def test_an_affine_that_the_target_contradicts_is_fitted_there():
    affine = checked(1.2, depths() / 5)
    assert affine.is_refitted_at_target
    assert affine.scale == pytest.approx(0.2, rel=0.01)
    assert affine.inliers > 0.9
    assert (affine.agreement, affine.coverage) == (affine.inliers, 1.0)


def test_a_fit_at_the_target_is_held_to_the_wanted_agreement():
    like = torch.rand(64, 64, generator=torch.Generator().manual_seed(6)) < 0.5
    affine = checked(1.2, torch.where(like, depths() / 5, unlike()))
    assert affine.is_refitted_at_target
    assert 0.4 < affine.agreement < 0.6
    assert not is_rejected(affine)
    assert is_rejected(affine, reject_below=0.8)


def test_an_affine_that_the_target_confirms_or_cannot_judge_stays():
    assert checked(1.0, depths() * 1.02) == DepthAffine(1.0, 0.0, 0.9, "ransac", 1.0, coverage=1.0)
    none = DepthMap(depths(), torch.zeros(64, 64, dtype=torch.bool))
    affine = DepthAffine(3.0, 0.0, 0.9, "ransac")
    at_target = compare_depth_maps(everywhere(depths()), none)
    assert refit_at_target(affine, at_target, torch.Generator(), CONFIG) == affine


def unlike() -> torch.Tensor:
    """Make depths without any relation to others."""
    return torch.rand(64, 64, generator=torch.Generator().manual_seed(5)) * 50


def is_rejected(affine: DepthAffine, **settings: float) -> bool:
    """Ask the guard whether Gaussians with this alignment may be added."""
    config = CompleterConfig(depth_agreement=DepthAgreementConfig(**settings))
    seen = observe(SOME, [View(torch.zeros(8, 8, 3), CAMERA)], CAMERA, config)
    image = GeneratedView(torch.zeros(8, 8, 3), CAMERA)
    attempt = Attempt(seen, image, affine, Refined(SOME, (), ()))
    return len(DepthAgreement().verify(SOME, attempt)) == 0


def test_where_no_affine_fits_what_the_target_sees_the_one_of_the_anchor_is_refuted():
    affine = checked(1.0, unlike())
    assert (is_rejected(affine), affine.is_refitted_at_target, affine.scale) == (True, False, 1.0)
    assert 0 < affine.agreement < 0.1


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_where_enough_agrees_the_affine_is_not_refuted(share):
    like = torch.rand(64, 64, generator=torch.Generator().manual_seed(6)) < share
    affine = checked(1.0, torch.where(like, depths(), unlike()))
    assert is_rejected(affine) == (share < 0.15)
    assert affine.agreement == pytest.approx(share, abs=0.05)


def test_what_is_seen_of_little_refutes_nothing():
    seen = torch.zeros(128, 128, dtype=torch.bool)
    seen[:10, :10] = True
    random, config = torch.Generator().manual_seed(0), AlignmentConfig()
    predicted = everywhere(depths(size=128))
    through_anchor = DepthAffine(1.0, 0.0, 0.9, "ransac")
    for share, refuted in ((seen, False), (torch.ones_like(seen), True)):
        context = DepthMap(unlike().repeat(2, 2), share)
        at_target = compare_depth_maps(predicted, context)
        affine = refit_at_target(through_anchor, at_target, random, config)
        assert is_rejected(affine) == refuted
        assert affine.agreement < 0.1


def test_the_paper_trusts_the_anchor_always():
    config = CompleterConfig.paper().alignment
    for context in (depths() / 5, unlike()):
        affine = checked(1.2, context, config)
        assert (affine.scale, affine.shift) == (1.2, 0.0)


@pytest.mark.parametrize(("align_at", "scale"), [("anchor", 1.25), ("target", 0.8), ("none", 1.0)])
def test_eq_8_compares_depths_at_the_anchor_and_its_ablation_at_the_target(align_at, scale):
    room = Room()
    target, anchor = camera_at(0.2, size=48), camera_at(-0.2, size=48)
    seen_at = [view_of(room, camera) for camera in (anchor, target)]
    context = merge([gaussians_of(view) for view in seen_at])
    config = CompleterConfig.paper()
    config = replace(config, alignment=replace(config.alignment, align_at=align_at))
    view = observe(context, seen_at[:1], target, config)
    at_anchor, at_target = (known.depth for known in seen_at)
    lift = Lift(context, everywhere(at_target / 0.8), everywhere(at_anchor / 1.25), None)
    found = align_depth(lift, choose_anchor(view), view, torch.Generator().manual_seed(0))
    assert found.scale == pytest.approx(scale, rel=0.05)
