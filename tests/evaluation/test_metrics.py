"""Metrics against plain recomputation."""

import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

from gscompleter.evaluation.metrics.geometry import (
    SurfaceAgreement,
    compare_depths,
    compute_f_score,
    compute_nearest_distances,
    measure_alignment,
    measure_primitive_alignment,
)
from gscompleter.evaluation.metrics.image import (
    MAX_PSNR,
    compute_gradient_energy_ratio,
    compute_masked_psnr,
    psnr,
    ssim,
)
from gscompleter.evaluation.metrics.perceptual import (
    compute_fid,
    compute_flip_map,
    compute_lpips,
    haarpsi,
    load_lpips,
)
from gscompleter.evaluation.metrics.scores import (
    Truth,
    measure_part,
    measure_quality,
    score,
)
from gscompleter.numerics.image_ops import dilate
from gscompleter.render.loading import load_renderer
from gscompleter.stages.filter_holes import select_in_mask
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.system.errors import InputError
from gscompleter.types import Camera, Gaussians, View, merge
from scenes import Room, camera_at, gaussians_of, scaled, view_of


def images(seed: int = 0, size: int = 32) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(size, size + 8, 3, generator=generator)
    noise = torch.randn(truth.shape, generator=generator) * 0.1
    return (truth + noise).clamp(0, 1), truth


# Images


def test_psnr_is_that_of_scikit_image():
    image, truth = images()
    expected = peak_signal_noise_ratio(truth.double().numpy(), image.double().numpy(), data_range=1)
    assert psnr(image, truth) == pytest.approx(expected, rel=1e-6)


def test_psnr_of_an_image_that_is_not_finite_is_no_number():
    image, truth = images()
    broken = image.clone()
    broken[3, 4, 1] = torch.nan
    assert np.isnan(psnr(broken, truth))
    assert psnr(truth, truth) == MAX_PSNR


def test_ssim_of_an_image_with_itself_is_one_and_noise_lowers_it():
    image, truth = images()
    assert ssim(truth, truth) == pytest.approx(1.0)
    assert ssim(image, truth) < 0.99


@pytest.mark.parametrize("size", [(11, 11), (37, 52)])
def test_ssim_is_what_scikit_image_gives(size):
    truth, noise = torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(1))
    image = (truth + 0.2 * noise).clamp(0, 1)
    expected = structural_similarity(
        image.numpy(),
        truth.numpy(),
        win_size=11,
        gaussian_weights=True,
        channel_axis=-1,
        data_range=1.0,
    )
    assert ssim(image, truth) == pytest.approx(float(expected), abs=1e-7)


def test_ssim_asks_for_a_window():
    with pytest.raises(ValueError, match="11 x 11"):
        ssim(torch.rand(10, 20, 3), torch.rand(10, 20, 3))


def test_masked_psnr_sees_its_pixels_only():
    image, truth = images()
    hole = torch.zeros(truth.shape[:2], dtype=torch.bool)
    hole[4:20, 10:30] = True
    difference = (image.double() - truth.double()).numpy()[hole.numpy()]
    assert compute_masked_psnr(image, truth, hole) == pytest.approx(
        -10 * np.log10(np.mean(difference**2)), rel=1e-6
    )
    patched = torch.where(hole[..., None], truth, image)
    assert compute_masked_psnr(patched, truth, hole) == MAX_PSNR
    assert compute_masked_psnr(patched, truth, ~hole) == compute_masked_psnr(image, truth, ~hole)


def test_masked_psnr_of_no_pixel_is_none():
    image, truth = images()
    assert compute_masked_psnr(image, truth, torch.zeros(truth.shape[:2], dtype=torch.bool)) is None


# Metrics that do not reward blur


def blurred(image: Tensor, sigma: float) -> Tensor:
    return torch.from_numpy(gaussian_filter(image.numpy(), sigma, axes=(0, 1)))


def left_half(image: Tensor) -> Tensor:
    return (torch.arange(image.shape[1]) < image.shape[1] // 2).expand(image.shape[:2])


def photograph_of(image: Tensor) -> View:
    height, width = image.shape[:2]
    return View(image, replace(camera_at(), height=height, width=width))


def test_haarpsi_is_that_of_piq():
    """Compare with values of piq for the same images, in float64."""
    generator = torch.Generator().manual_seed(0)
    for size, expected in (((32, 40), 0.6336810476687134), ((64, 64), 0.6368790044733689)):
        truth = torch.rand(*size, 3, generator=generator)
        image = (truth + 0.2 * torch.randn(*size, 3, generator=generator)).clamp(0, 1)
        everywhere = torch.ones(size, dtype=torch.bool)
        assert haarpsi(image, truth, everywhere) == pytest.approx(expected, rel=1e-5)


def test_haarpsi_of_a_step_by_hand():
    """Compare with the formula: similarity c / (step² + c), as a black image has no wavelets."""
    truth, image = torch.zeros(32, 32, 3), torch.zeros(32, 32, 3)
    truth[:, 16:] = 1.0
    inner = torch.zeros(32, 32, dtype=torch.bool)
    inner[16:18, 14:16] = True  # row 8, column 7 of 16 x 16: before the step
    # Along the columns: 2 x 1/2 x 255, 8 x 1/4 x 255 and 32 x 1/8 x 255; down the rows nothing.
    fine, middle, coarse = 255.0, 510.0, 1020.0
    similar = (30 / (fine**2 + 30) + 30 / (middle**2 + 30)) / 2
    # Chrominance is 0 in both, with half of that weight.
    logistic = 1 / (1 + np.exp(-4.2 * np.array([similar, 1.0])))
    mean = (coarse * logistic[0] + coarse / 2 * logistic[1]) / (1.5 * coarse)
    expected = (np.log(mean / (1 - mean)) / 4.2) ** 2
    assert haarpsi(image, truth, inner) == pytest.approx(expected, rel=1e-3)


def test_blur_costs_by_haarpsi_and_takes_gradient_energy():
    _, truth = images()
    everywhere = torch.ones(truth.shape[:2], dtype=torch.bool)
    softer = [truth, *(blurred(truth, sigma) for sigma in (0.5, 1.0, 2.0))]
    similar = [haarpsi(image, truth, everywhere) for image in softer]
    energies = [compute_gradient_energy_ratio(image, truth, everywhere) for image in softer]
    assert similar[0] == pytest.approx(1.0)
    assert energies[0] == 1.0
    for values in (similar, energies):
        assert values == sorted(values, reverse=True)
        assert values[-1] < 0.5 * values[0]


def test_gradient_energy_by_hand():
    """A ramp of half the gradient has a quarter of the energy, and a constant none."""
    ramp = torch.linspace(0, 1, 12)[None, :, None].expand(10, 12, 3)
    everywhere = torch.ones(10, 12, dtype=torch.bool)
    assert compute_gradient_energy_ratio(ramp / 2, ramp, everywhere) == pytest.approx(0.25)
    assert compute_gradient_energy_ratio(ramp * 0 + 0.3, ramp, everywhere) == 0.0
    assert compute_gradient_energy_ratio(ramp, ramp * 0, everywhere) is None
    only_green = torch.stack([ramp[..., 0] * 0, ramp[..., 1], ramp[..., 2] * 0], dim=-1)
    assert compute_gradient_energy_ratio(only_green, ramp, everywhere) == pytest.approx(0.587**2)


def test_the_border_of_a_hole_is_no_gradient():
    _, truth = images()
    hole = left_half(truth)
    outside_white = torch.where(hole[..., None], truth, 1.0)
    assert compute_gradient_energy_ratio(outside_white, truth, hole) == pytest.approx(1.0)
    thin = torch.zeros_like(hole)
    thin[5:7] = True
    assert compute_gradient_energy_ratio(truth, truth, thin) is None


def test_looks_are_of_the_pixels_that_are_asked_for():
    pytest.importorskip("flip_evaluator", reason="needs gscompleter[evaluation]")
    _, truth = images(size=64)
    damaged = torch.where(left_half(truth)[..., None], blurred(truth, 2.0), truth)
    inside = torch.arange(truth.shape[1]) < truth.shape[1] // 2 - 12
    outside = torch.arange(truth.shape[1]) > truth.shape[1] // 2 + 12
    photograph = photograph_of(truth)
    bad, good = (
        measure_part(damaged, photograph, where.expand(truth.shape[:2]))
        for where in (inside, outside)
    )
    assert bad.flip > 0.1
    assert bad.haarpsi < 0.5
    assert bad.gradient_energy < 0.1
    assert good.flip == pytest.approx(0.0, abs=1e-3)
    assert good.haarpsi == pytest.approx(1.0)
    assert good.gradient_energy == 1.0
    nowhere = torch.zeros(truth.shape[:2], dtype=torch.bool)
    nothing = measure_part(damaged, photograph, nowhere)
    assert (nothing.flip, nothing.haarpsi, nothing.gradient_energy) == (None, None, None)


def test_flip_is_none_without_its_package(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    image, truth = images()
    assert compute_flip_map(image, truth) is None
    assert measure_part(image, photograph_of(truth), left_half(truth)).flip is None


# Depth


def test_abs_rel_is_the_mean_relative_error_where_truth_is_known():
    generator = torch.Generator().manual_seed(1)
    truth = torch.rand(12, 15, generator=generator) * 5 + 1
    truth[3] = 0
    depth = truth + torch.randn(12, 15, generator=generator) * 0.3
    where = torch.rand(12, 15, generator=generator) > 0.3
    d, t = depth.double().numpy(), truth.double().numpy()
    mask = where.numpy() & (t > 0)
    found = compare_depths(depth, truth, where)
    assert found.abs_rel == pytest.approx(np.mean(abs(d - t)[mask] / t[mask]))
    assert found.pixels == mask.sum()


def test_a_depth_ten_percent_too_great_has_an_abs_rel_of_a_tenth():
    truth = torch.linspace(1, 4, 12).reshape(3, 4)
    everywhere = torch.ones(3, 4, dtype=torch.bool)
    found = compare_depths(1.1 * truth, truth, everywhere)
    assert found.abs_rel == pytest.approx(0.1, abs=1e-6)
    assert compare_depths(truth, 0 * truth, everywhere) == SurfaceAgreement(0)


# Point sets


def brute_force(a: Tensor, b: Tensor) -> tuple[np.ndarray, np.ndarray]:
    x, y = a.double().numpy(), b.double().numpy()
    distances = np.sqrt(((x[:, None] - y[None]) ** 2).sum(-1))
    return distances.min(1), distances.min(0)


def distances(a: Tensor, b: Tensor) -> tuple[np.ndarray, np.ndarray]:
    return compute_nearest_distances(a, b), compute_nearest_distances(b, a)


@pytest.mark.parametrize("seed", range(3))
def test_distances_and_f_score_agree_with_brute_force(seed: int):
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(150, 3, generator=generator)
    b = torch.randn(220, 3, generator=generator) * 1.2 + 0.2
    there, back = brute_force(a, b)
    for found, expected in zip(distances(a, b), (there, back), strict=True):
        assert found == pytest.approx(expected, rel=1e-12)
    for threshold in (0.2, 0.4, 0.8):
        precision, recall = (there <= threshold).mean(), (back <= threshold).mean()
        expected = 2 * precision * recall / (precision + recall)
        assert compute_f_score(*distances(a, b), threshold) == pytest.approx(expected)
        assert compute_f_score(*distances(b, a), threshold) == pytest.approx(expected)


def test_a_plane_moved_along_its_normal_is_that_far_away():
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(20.0), indexing="ij")
    plane = torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3)
    moved = plane + torch.tensor([0.0, 0.0, 0.25])
    assert compute_nearest_distances(plane, moved) == pytest.approx(0.25)
    assert compute_f_score(*distances(plane, moved), 0.2) == 0.0
    assert compute_f_score(*distances(plane, moved), 0.3) == 1.0


def test_coinciding_points_are_at_distance_zero():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).repeat(20, 1)
    assert compute_nearest_distances(points, points[:50]).max() == 0.0
    assert compute_f_score(*distances(points, points[:50]), 1e-9) == 1.0


def test_hundreds_of_thousands_of_points_are_no_trouble():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(200_000, 3, generator=generator) for _ in range(2))
    found = compute_nearest_distances(a, b)
    assert found.shape == (200_000,)
    # A Poisson process of density n: mean nearest distance 0.554 n^(-1/3), more at the border.
    assert found.mean() == pytest.approx(0.554 * 200_000 ** (-1 / 3), rel=0.05)
    few = torch.arange(0, 200_000, 4_000)
    expected = torch.cdist(a[few].double(), b.double()).amin(1)
    assert found[few] == pytest.approx(expected.numpy(), abs=1e-6)


# Alignment of a completion with its context


TARGET = camera_at(x=0.8, yaw=12.0, size=48)
RENDERER = load_renderer("cpu")


def room_context(unit: float = 1.0) -> Gaussians:
    return gaussians_of(view_of(Room(unit=unit), camera_at(size=64, unit=unit)))


def filling(context: Gaussians, factor: float = 1.0, dilation: int = 3) -> Gaussians:
    """Make the true Gaussians of the dilated hole, with depths multiplied by `factor`."""
    hole = dilate(compute_hole_mask(RENDERER.render(context, TARGET).alpha), dilation)
    assert 0.05 < hole.double().mean() < 0.7
    view = view_of(Room(), TARGET)
    assert view.depth is not None
    return gaussians_of(view, factor * view.depth)[hole.flatten()]


def score_of(context: Gaussians, added: Gaussians, target: Camera = TARGET) -> SurfaceAgreement:
    return measure_alignment(added, context, target, RENDERER)


def test_generated_gaussians_that_coincide_with_the_context_are_aligned():
    context = room_context()
    score = score_of(context, context)
    assert (score.abs_rel, score.chamfer, score.f_score) == (0.0, 0.0, 1.0)
    assert score.pixels > 0.5 * TARGET.width * TARGET.height


def test_copies_of_part_of_the_context_are_aligned_wherever_their_border_is():
    context = room_context()
    part = torch.zeros(TARGET.height, TARGET.width, dtype=torch.bool)
    part[10:30, 12:26] = True
    score = score_of(context, select_in_mask(context, None, part, TARGET))
    assert score.abs_rel is not None
    assert score.chamfer is not None
    assert score.f_score is not None
    assert 0 < score.pixels < 0.3 * TARGET.width * TARGET.height
    assert score.abs_rel < 0.02
    assert score.chamfer < 0.02
    assert score.f_score > 0.98


def test_alignment_gets_worse_the_further_the_generated_gaussians_are_shifted():
    context = room_context()
    scores = [
        score_of(context, replace(context, means=context.means + shift * TARGET.forward))
        for shift in (0.0, 0.1, 0.3, 0.9)
    ]
    for metric in ("abs_rel", "chamfer"):
        values = [getattr(score, metric) for score in scores]
        assert values == sorted(values)
        assert values[-1] > 3 * values[1] > 0
    f_scores = [score.f_score for score in scores]
    assert f_scores == sorted(f_scores, reverse=True)
    assert f_scores[0] == 1.0
    assert f_scores[-1] < 0.6


def test_alignment_is_measured_at_the_rim_of_a_filled_hole():
    context = room_context()
    true = score_of(context, filling(context))
    far = score_of(context, filling(context, 1.15))
    assert 0.005 < true.pixels / (TARGET.width * TARGET.height) < 0.4
    # Not 0: the hole borders on the edge of a box, where a render mixes two depths.
    assert true.abs_rel < 0.06
    assert 0.12 < far.abs_rel < 0.22
    assert true.chamfer < 0.4 * far.chamfer
    assert true.f_score > 0.9 > far.f_score


def test_alignment_in_another_unit_of_length_is_the_same():
    context = room_context()
    added = filling(context, 1.05)
    metres = score_of(context, added)
    K, c2w = TARGET.K, TARGET.c2w.clone()
    c2w[:3, 3] *= 1000
    camera = replace(TARGET, c2w=c2w, K=K, near=500.0, far=20000.0)
    millimetres = score_of(scaled(context, 1000.0), scaled(added, 1000.0), camera)
    assert millimetres.abs_rel == pytest.approx(metres.abs_rel, rel=1e-3)
    assert millimetres.chamfer == pytest.approx(metres.chamfer, rel=1e-2)
    assert millimetres.f_score == pytest.approx(metres.f_score, rel=1e-2)


def test_where_nothing_overlaps_there_is_no_alignment():
    context = room_context()
    nothing = score_of(context, context[:0])
    assert nothing == SurfaceAgreement(0, None, None, None)
    unseen = replace(context, opacities=torch.full_like(context.opacities, 0.001))
    assert score_of(context, unseen) == nothing
    assert measure_primitive_alignment(unseen, context, TARGET, RENDERER) == nothing
    behind = replace(context, means=context.means - 50 * TARGET.forward)
    assert measure_primitive_alignment(behind, context, TARGET, RENDERER) == nothing


def test_all_that_was_lifted_is_compared_with_what_the_target_sees_of_the_context():
    context, view = room_context(), view_of(Room(), TARGET)
    covered = RENDERER.render(context, TARGET).depth_map()
    for factor in (1.0, 1.1, 0.8):
        lifted = gaussians_of(view, factor * view.depth)
        found = measure_primitive_alignment(lifted, context, TARGET, RENDERER)
        assert found.pixels == covered.valid.sum()
        z, d = (factor * view.depth)[covered.valid], covered.depth[covered.valid]
        assert found.abs_rel == pytest.approx(((z - d).abs() / d).mean().item(), rel=1e-4)
        assert (found.f_score > 0.95) == (factor == 1.0)


@pytest.mark.parametrize("measure", [measure_alignment, measure_primitive_alignment])
@pytest.mark.parametrize(("share", "f_score"), [(0.045, 1.0), (0.055, 0.0), (0.09, 0.0)])
def test_a_wall_that_is_moved_back_is_at_its_distance_and_matches_within_5_percent(
    measure, share, f_score
):
    """Chamfer is the mean of both directions, so that it is the shift itself, over the depth."""
    view = view_of(Room(), TARGET)
    wall = gaussians_of(view, torch.full_like(view.depth, 4.0))
    moved = replace(wall, means=wall.means + 4.0 * share * TARGET.forward)
    found = measure(moved, wall, TARGET, RENDERER)
    assert found.chamfer == pytest.approx(share, rel=1e-3)
    assert found.abs_rel == pytest.approx(share, rel=1e-2)
    assert found.f_score == f_score


def test_primitives_with_gaps_between_them_are_measured_like_all():
    """Renders of thinned Gaussians cover less and are measured over less."""
    context, view = room_context(), view_of(Room(), TARGET)
    lifted = gaussians_of(view, 1.1 * view.depth)
    few = lifted[::7]
    whole, thin = (measure_primitive_alignment(g, context, TARGET, RENDERER) for g in (lifted, few))
    assert thin.pixels == pytest.approx(whole.pixels / 7, rel=0.1)
    assert thin.abs_rel == pytest.approx(whole.abs_rel, rel=0.1)
    assert score_of(context, few).pixels < 0.5 * score_of(context, lifted).pixels


def test_scores_count_the_pixels_that_they_are_measured_over():
    context, view = room_context(), view_of(Room(), TARGET)
    depth = view.depth.clone()
    depth[:10] = 0
    added, lifted = filling(context), gaussians_of(view)
    truth = Truth((), replace(view, depth=depth))
    scores, seen = score(
        context[:0], context, context, Truth((), view), RENDERER
    )  # everything is a hole that the context fills
    assert scores.depth_observed == SurfaceAgreement(0)
    assert scores.depth_hole.pixels == seen.after.depth_map().valid.sum() > 500
    after = merge([context, added])
    scores, seen = score(context, after, added, truth, RENDERER, lifted)
    known = seen.after.depth_map().valid & (depth > 0)
    assert scores.depth_hole.pixels == (known & seen.holes).sum() > 0
    assert scores.depth_observed.pixels == (known & ~seen.holes).sum() > 0
    assert scores.added == score_of(context, added)
    aligned = measure_primitive_alignment(lifted, context, TARGET, RENDERER)
    assert scores.registered == aligned
    assert aligned.pixels > scores.added.pixels
    scores, _ = score(context, after, added, Truth((), replace(view, depth=None)), RENDERER)
    assert scores.depth_hole is scores.depth_observed is scores.registered is None


# Learned features


def install_stand_in(monkeypatch: pytest.MonkeyPatch, name: str, **classes: object) -> None:
    """Install a stand-in for a module of torchmetrics."""
    for part in ("torchmetrics", "torchmetrics.image"):
        monkeypatch.setitem(sys.modules, part, ModuleType(part))
    module = ModuleType(name)
    vars(module).update(classes)
    monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture(autouse=True)
def no_cached_lpips():
    load_lpips.cache_clear()
    yield
    load_lpips.cache_clear()


def test_without_torchmetrics_there_is_no_lpips_and_fid_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    image, truth = images()
    assert compute_lpips(image, truth, "vgg") is None
    with pytest.raises(InputError, match=r"pip install gscompleter\[evaluation\]"):
        compute_fid([image], [truth])


@pytest.mark.parametrize("error", [ModuleNotFoundError, OSError, RuntimeError])
def test_lpips_that_cannot_be_loaded_is_tried_once(error, monkeypatch: pytest.MonkeyPatch):
    """No torchvision, no connection, and a torchvision built for another torch."""
    tries = []

    def fail(**settings: object) -> None:
        tries.append(settings)
        raise error("not here")

    module = "torchmetrics.image.lpip"
    install_stand_in(monkeypatch, module, LearnedPerceptualImagePatchSimilarity=fail)
    image, truth = images()
    assert [compute_lpips(image, truth, "alex") for _ in range(3)] == [None] * 3
    assert tries == [{"net_type": "alex", "normalize": True}]


def test_lpips_gets_clipped_batches_of_channels_first(monkeypatch: pytest.MonkeyPatch):
    class Metric:
        def __init__(self, net_type: str, normalize: bool) -> None:
            assert net_type in ("vgg", "alex")
            assert normalize

        def __call__(self, a: Tensor, b: Tensor) -> Tensor:
            assert a.shape == b.shape == (1, 3, 32, 40)
            assert 0 <= a.min() <= a.max() <= 1
            return (a - b).abs().mean()

    module = "torchmetrics.image.lpip"
    install_stand_in(monkeypatch, module, LearnedPerceptualImagePatchSimilarity=Metric)
    image, truth = images()
    expected = ((image + 0.5).clamp(0, 1) - truth).abs().mean().item()
    assert compute_lpips(image + 0.5, truth, "vgg") == pytest.approx(expected)
    assert measure_quality(image, photograph_of(truth)).lpips_vgg > 0


def test_fid_hands_over_batches_of_channels_first(monkeypatch: pytest.MonkeyPatch):
    seen: list[tuple[tuple[int, ...], bool]] = []

    class Metric:
        def __init__(self, feature: int, normalize: bool) -> None:
            assert (feature, normalize) == (2048, True)

        def update(self, batch: Tensor, real: bool) -> None:
            seen.append((tuple(batch.shape), real))

        def compute(self) -> Tensor:
            return torch.tensor(7.0)

    install_stand_in(monkeypatch, "torchmetrics.image.fid", FrechetInceptionDistance=Metric)
    image, truth = images()
    assert compute_fid([image, image], [truth, truth]) == 7.0
    assert seen == [((1, 3, 32, 40), True)] * 2 + [((1, 3, 32, 40), False)] * 2
    with pytest.raises(InputError, match="at least two photographs, got 1"):
        compute_fid([image, image], [truth])
