"""Other completion methods, for comparison."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from gscompleter import load_renderer
from gscompleter.evaluation.baselines.optimization import (
    OptimizationConfig,
    compute_image_gradients,
    control_density,
    optimize,
    ssim_map,
)
from gscompleter.evaluation.baselines.reggs import (
    Mixture,
    RegGSConfig,
    Similarity,
    cluster_gaussians,
    compute_matrix_root,
    compute_mixture_wasserstein,
    compute_pairwise_costs,
    move_into_scene,
    move_mixture,
    move_scene,
    reduce_mixture,
    register_by_similarity,
)
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.types import Gaussians, View, merge
from parity import assert_close
from paths import FIXTURES
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of

FIXTURE = FIXTURES / "reggs_mw2.npz"


@pytest.fixture(scope="module")
def upstream() -> dict[str, torch.Tensor]:
    """Numbers of RegGS's own functions on two random mixtures."""
    return {key: torch.from_numpy(np.array(value)) for key, value in np.load(FIXTURE).items()}


def mixtures(upstream: dict[str, torch.Tensor]) -> tuple[Mixture, Mixture]:
    a = Mixture(upstream["mu"], upstream["cov"], upstream["w"])
    b = Mixture(upstream["mu2"], upstream["cov2"], upstream["w2"])
    return reduce_mixture(a, upstream["clusters_a"]), reduce_mixture(b, upstream["clusters_b"])


def test_reduced_mixtures_equal_upstreams(upstream):
    for mixture, name in zip(mixtures(upstream), "ab", strict=True):
        assert_close(mixture.means, upstream[f"{name}_mu"], "mu")
        assert_close(mixture.covariances, upstream[f"{name}_cov"], "cov")
        assert_close(mixture.weights, upstream[f"{name}_w"], "w")


def test_costs_loss_and_gradient_equal_upstreams(upstream):
    a, b = mixtures(upstream)
    assert_close(compute_pairwise_costs(a, b), upstream["cost"], "cost")
    scale = torch.tensor(upstream["scale"].item(), dtype=torch.float32, requires_grad=True)
    larger = Mixture(a.means * scale, a.covariances * scale**2, a.weights)
    loss = compute_mixture_wasserstein(larger, b)
    (gradient,) = torch.autograd.grad(loss, scale)
    assert_close(loss, upstream["loss"], "loss")
    assert_close(gradient, upstream["grad_scale"], "grad_scale")


def test_the_root_squared_is_the_matrix():
    random = torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(0))
    positive = random @ random.transpose(-1, -2)
    root = compute_matrix_root(positive)
    assert torch.allclose(root @ root, positive, atol=1e-3)


def test_a_cluster_keeps_mean_and_covariance_of_its_members():
    gaussians = random_gaussians(50)
    mixture = cluster_gaussians(gaussians, camera_at(), 1000, seed=0)
    merged = reduce_mixture(mixture, torch.zeros(50, dtype=torch.long))
    mean = (mixture.weights[:, None] * mixture.means).sum(0)
    assert torch.allclose(merged.means[0], mean, atol=1e-5)
    offset = mixture.means - mean
    second = mixture.covariances + offset[:, :, None] * offset[:, None, :]
    expected = (mixture.weights[:, None, None] * second).sum(0)
    assert torch.allclose(merged.covariances[0], expected, atol=1e-4)


SMALL_TURN = torch.tensor([0.99, 0.05, -0.08, 0.03])


def test_a_scene_that_was_moved_is_moved_back():
    gaussians, camera = random_gaussians(40), camera_at(0.3, yaw=10)
    fit = Similarity(torch.tensor(1.0), SMALL_TURN, torch.tensor([0.2, -0.1, 0.3]))
    back = move_into_scene(move_scene(gaussians, fit), fit, camera)
    assert torch.allclose(back.means, gaussians.means, atol=1e-5)
    same = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    agreement = (torch.nn.functional.normalize(back.quats, dim=-1) * same).sum(-1).abs()
    assert torch.allclose(agreement, torch.ones(40), atol=1e-5)


def test_a_mixture_moves_as_its_gaussians_do():
    gaussians, camera = random_gaussians(40), camera_at(0.3, yaw=10)
    fit = Similarity(torch.tensor(1.0), SMALL_TURN, torch.tensor([0.2, -0.1, 0.3]))
    moved = cluster_gaussians(move_scene(gaussians, fit), camera, 1000, seed=0)
    mixture = move_mixture(cluster_gaussians(gaussians, camera, 1000, seed=0), fit, camera)
    assert torch.allclose(mixture.means, moved.means, atol=1e-4)
    assert torch.allclose(mixture.covariances, moved.covariances, atol=1e-4)


@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_a_lift_of_another_scale_is_brought_back(weight):
    view = view_of(Room(), camera_at(0.3, size=48))
    scene = gaussians_of(view_of(Room(), camera_at(0.0, size=48)))
    lifted = gaussians_of(view, 0.7 * view.depth)
    config = RegGSConfig(iterations=25, components=40, mixture_weight=weight)
    renderer = load_renderer("cpu")
    reference = View(view.image, view.camera)
    found = register_by_similarity(lifted, scene, reference, renderer, config=config)
    assert (found.scales / lifted.scales).median().item() == pytest.approx(1 / 0.7, rel=0.1)
    distance = (found.means - gaussians_of(view).means).norm(dim=-1)
    before = (lifted.means - gaussians_of(view).means).norm(dim=-1)
    assert distance.median() < 0.2 * before.median()
    again = register_by_similarity(lifted, scene, reference, renderer, config=config)
    assert torch.equal(again.means, found.means)
    assert torch.equal(found.sh, lifted.sh)


# Optimisation


def repaired_room() -> tuple[list[View], Gaussians, View]:
    """Two photographs, the scene they give, and the true image of a camera that sees a hole."""
    views = [view_of(Room(), camera_at(x, size=48)) for x in (-0.1, 0.1)]
    scene = merge([gaussians_of(view) for view in views])
    return views, scene, view_of(Room(), camera_at(0.6, size=48))


def psnr_of(scene: Gaussians, view: View) -> float:
    return psnr(load_renderer("cpu").render(scene, view.camera).image, view.image)


@pytest.mark.slow
@pytest.mark.parametrize("rounds", [0, 4])
def test_optimisation_fits_the_repaired_view(rounds):
    views, scene, target = repaired_room()
    config = OptimizationConfig(iterations=90, density_rounds=rounds)
    fitted = optimize(scene, [*views, target], load_renderer("cpu"), config=config)
    assert psnr_of(fitted, target) > psnr_of(scene, target) + 1
    if rounds == 0:
        assert len(fitted) == len(scene)
    else:
        assert len(fitted) > len(scene)
    few = replace(config, iterations=20)
    first, again = (
        optimize(scene, [*views, target], load_renderer("cpu"), config=few) for _ in "ab"
    )
    assert torch.equal(again.means, first.means)


def test_an_optimised_scene_has_no_gradient():
    """What measures it would keep the history of every render."""
    views, scene, target = repaired_room()
    config = OptimizationConfig(iterations=1, density_rounds=0)
    fitted = optimize(scene, [*views, target], load_renderer("cpu"), config=config)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert not getattr(fitted, name).requires_grad, name
    assert not torch.equal(fitted.means, scene.means)


def test_density_control_clones_splits_and_prunes():
    scene = random_gaussians(6)
    scales = torch.full((6, 3), 0.001)
    scales[1] = 0.5
    opacities = torch.full((6,), 0.5)
    opacities[2] = 0.001
    scene = replace(scene, scales=scales, opacities=opacities)
    crowded = torch.tensor([True, True, False, False, False, False])
    random = torch.Generator().manual_seed(0)
    dense = control_density(scene, crowded, 1.0, random)
    # Six, one of them twice, one as two halves, one gone.
    assert len(dense) == 7
    assert (dense.means == scene.means[0]).all(-1).sum() == 2
    assert not (dense.means == scene.means[1]).all(-1).any()
    assert torch.isclose(dense.scales.amax(-1), torch.tensor(0.5 / 1.6)).sum() == 2


def test_gradients_in_the_image_are_those_of_the_rendered_position():
    """Compare with moving the principal point, which moves all Gaussians in the image alike."""
    single = camera_at(size=48)
    camera = replace(single, K=single.K.double(), c2w=single.c2w.double())
    gaussian = gaussians_of(view_of(Room(), single))[48 * 20 + 20 : 48 * 20 + 21]
    renderer = load_renderer("reference")
    means = gaussian.means.double().clone().requires_grad_()
    weights = torch.linspace(0, 1, 48, dtype=torch.float64)[None, :, None]
    tensors = {
        name: getattr(gaussian, name).double() for name in ("quats", "scales", "opacities", "sh")
    }
    image = renderer.render(replace(gaussian, means=means, **tensors), camera).image
    (gradient,) = torch.autograd.grad((image * weights).sum(), means)
    length, seen = compute_image_gradients(means.detach(), gradient, camera)

    def at(shift: float) -> float:
        K = camera.K.clone()
        K[0, 2] += shift
        moved = replace(gaussian, means=means.detach(), **tensors)
        return (renderer.render(moved, replace(camera, K=K)).image * weights).sum().item()

    expected = abs(at(0.05) - at(-0.05)) / 0.1 * 24
    assert seen.item() == 1
    assert length.item() == pytest.approx(expected, rel=0.1)


def test_ssim_is_that_of_scikit_image():
    a = view_of(Room(), camera_at(0.0, size=48)).image
    b = view_of(Room(), camera_at(0.1, size=48)).image
    _, expected = structural_similarity(
        a.numpy(),
        b.numpy(),
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        win_size=11,
        full=True,
    )
    found = ssim_map(a, b)[0].permute(1, 2, 0).numpy()
    inner = slice(6, -6)
    assert np.allclose(found[inner, inner], expected[inner, inner], atol=1e-4)
