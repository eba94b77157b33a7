"""Proxies of large scenes: fewer Gaussians, with the same photographs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from completions.cases import multiply_gaussians
from gscompleter.completer import GSCompleter
from gscompleter.config import CompleterConfig, TrustConfig
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.kernels.lod import RUN_BLOCK
from gscompleter.render import lod as proxies
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import (
    MAX_REACH,
    MAX_RUN_DEVIATION,
    build_proxy,
    merge_nearby,
    simplify_scene,
    thin_gaussians,
)
from gscompleter.splats.morton import argsort_nearby
from gscompleter.system.memory import BYTES_PER_SPLAT
from gscompleter.trust import Trust
from gscompleter.trust.photometric import (
    PhotoObservations,
    gather_observations,
    load_trust,
)
from gscompleter.types import Gaussians, merge
from scenes import Room, camera_at, gaussians_of, random_gaussians, reconstruction_of, view_of

RENDERER = load_renderer("cpu")
SIZE, COPIES = 64, 10
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.3, 0.0, 0.3)]
TARGET = camera_at(0.5, yaw=25, size=SIZE)
VIEWS = [view_of(Room(), camera) for camera in CAMERAS]
ROOM = merge([gaussians_of(view) for view in (VIEWS[0], VIEWS[2])])


def in_order(scene: Gaussians) -> Gaussians:
    return scene[argsort_nearby(scene)]


CROWD = in_order(multiply_gaussians(ROOM, COPIES * len(ROOM)))
PROXY = simplify_scene(CROWD, CAMERAS)


def pixel_at(scene: Gaussians) -> torch.Tensor:
    """Compute the smallest pixel of the cameras at each Gaussian."""
    apart = [(scene.means - camera.center).norm(dim=1) / camera.K[0, 0] for camera in CAMERAS]
    return torch.stack(apart).amin(0)


def test_a_small_scene_is_its_own_proxy():
    assert build_proxy(ROOM, CAMERAS).rendered is ROOM
    completion = GSCompleter(KnowingReconstructor()).begin(VIEWS[::2], ROOM, VIEWS[1:2])
    assert completion.rendered_context is completion.scene is completion.context is ROOM


def test_a_crowd_is_drawn_with_few_and_looks_alike():
    assert len(PROXY.rendered) < 2 * len(CROWD) / COPIES
    for camera in (*CAMERAS, TARGET):
        drawn = (thin_gaussians(CROWD, len(PROXY.rendered)), PROXY.rendered, CROWD)
        thin, ours, truth = (RENDERER.render(scene, camera) for scene in drawn)
        assert psnr(ours.image, truth.image) > psnr(thin.image, truth.image) + 3
        assert (ours.alpha - truth.alpha).abs().mean() < 0.01


def test_an_antialiased_crowd_is_drawn_as_one():
    crowd = replace(CROWD, is_antialiased=True)
    scene = simplify_scene(crowd, CAMERAS).rendered
    assert scene.is_antialiased
    assert thin_gaussians(crowd, 1000).is_antialiased
    ours, truth = (RENDERER.render(drawn, TARGET) for drawn in (scene, crowd))
    assert (ours.alpha - truth.alpha).abs().mean() < 0.01


def test_runs_lie_within_half_a_pixel():
    assert (PROXY.proxy_index.diff() >= 0).all()
    first = torch.cat([torch.tensor([0]), 1 + PROXY.proxy_index.diff().nonzero()[:, 0]])
    apart = (CROWD.means - CROWD.means[first][PROXY.proxy_index]).norm(dim=1)
    pixel = pixel_at(CROWD[first])[PROXY.proxy_index]
    assert (apart <= 1.001 * MAX_REACH * pixel).all()
    shared = torch.bincount(PROXY.proxy_index)[PROXY.proxy_index] > 1
    assert (CROWD.scales.amax(dim=1) <= 1.001 * MAX_RUN_DEVIATION * pixel)[shared].all()


def test_runs_are_as_short_where_pixels_are_no_squares():
    tall, wide = torch.ones(3, 3), torch.ones(3, 3)
    tall[1], wide[0] = 4, 4
    for factor in (tall, wide):
        cameras = [replace(camera, K=camera.K * factor) for camera in CAMERAS]
        both = [replace(camera, K=camera.K * tall * wide) for camera in CAMERAS]
        scene, expected = (simplify_scene(CROWD, some).rendered for some in (cameras, both))
        assert len(scene) == len(expected) > len(PROXY.rendered)


def test_what_is_large_or_alone_stays_to_the_bit():
    scene = in_order(random_gaussians(500, sh_degree=1))
    huge = replace(scene, scales=scene.scales + 100 * MAX_RUN_DEVIATION * pixel_at(scene)[:, None])
    for given in (huge, scene[::25]):
        proxy = simplify_scene(given, CAMERAS)
        assert len(proxy.rendered) == len(given)
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert torch.equal(getattr(proxy.rendered, name), getattr(given, name)), name


def test_a_run_is_of_one_provenance():
    mixed = replace(CROWD, generated=(torch.arange(len(CROWD)) % 2).to(torch.uint8))
    found = simplify_scene(mixed, CAMERAS)
    assert torch.equal(found.rendered.generated[found.proxy_index], mixed.generated)
    halves = replace(CROWD, generated=(torch.arange(len(CROWD)) > 2000).to(torch.uint8))
    found = simplify_scene(halves, CAMERAS)
    assert torch.equal(found.rendered.generated[found.proxy_index], halves.generated)
    assert len(found.rendered) <= len(PROXY.rendered) + 1


def test_of_what_lies_at_one_place_the_mean_is_drawn_as_opaque_as_all():
    one = gaussians_of(VIEWS[0])[:1]
    pair = replace(merge([one, one]), opacities=torch.tensor([0.3, 0.6]))
    pair = replace(pair, sh=torch.tensor([[[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]]))
    (found,) = (simplify_scene(pair, CAMERAS).rendered,)
    assert len(found) == 1
    assert torch.allclose(found.means, one.means)
    assert found.opacities.item() == pytest.approx(1 - 0.7 * 0.4, abs=1e-4)
    assert 0.5 < found.sh[0, 0, 0] < 1.0
    assert (found.scales >= one.scales).all()


def test_what_lies_aside_widens_it():
    one = gaussians_of(VIEWS[0])[:1]
    step = 0.4 * pixel_at(one)
    other = replace(one, means=one.means + torch.tensor([1.0, 0.0, 0.0]) * step)
    found = simplify_scene(merge([one, other]), CAMERAS).rendered
    assert len(found) == 1
    assert torch.allclose(found.means, (one.means + other.means) / 2)
    width, height, depth = (found.scales / one.scales)[0].tolist()
    assert width > 1.02 * height
    assert height == pytest.approx(depth, rel=1e-4)


def test_where_there_is_little_room_fewer_are_drawn(monkeypatch):
    room = len(CAMERAS) * BYTES_PER_SPLAT * len(PROXY.rendered) // 2
    monkeypatch.setattr("gscompleter.system.memory.MAX_FROZEN_BYTES", room)
    assert len(simplify_scene(CROWD, CAMERAS).rendered) <= len(PROXY.rendered) // 2


def test_the_same_runs_on_any_number_of_threads(monkeypatch):
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", 1)
    again = simplify_scene(CROWD, CAMERAS)
    assert torch.equal(again.proxy_index, PROXY.proxy_index)
    assert torch.equal(again.rendered.scales, PROXY.rendered.scales)


def evidence_of(scene: Gaussians) -> PhotoObservations:
    frozen = [RENDERER.freeze(scene, camera) for camera in CAMERAS]
    return gather_observations(scene, VIEWS, frozen, TrustConfig())


def trust_in(scene: Gaussians) -> Trust:
    return load_trust(CompleterConfig.splat(), (scene,), VIEWS, SceneRenderer(RENDERER))


def trusted_alpha(scene: Gaussians) -> torch.Tensor:
    return trust_in(scene).compute_alpha(RENDERER.freeze(scene, TARGET), TARGET)


def test_of_a_proxy_as_much_is_believed_as_of_the_scene():
    ours, truth = trusted_alpha(PROXY.rendered), trusted_alpha(CROWD)
    assert truth.std() > 0.2
    assert (ours - truth).abs().mean() < 0.05


def test_flat_gaussians_are_kept_as_often_as_thick_ones():
    """A scale of exactly 0 is allowed, and such a Gaussian covers as much as another."""
    scene = random_gaussians(1000)
    scales = torch.full((1000, 3), 0.1)
    scales[:500, 1] = 0
    scene = replace(scene, scales=scales, opacities=torch.full((1000,), 0.5))
    kept = thin_gaussians(scene, 100)
    assert len(kept) == pytest.approx(100, abs=1)
    assert (kept.scales.amin(dim=1) == 0).float().mean() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("count", [2, 20, 100])
def test_a_scene_of_several_blocks_is_merged_to_as_few_as_are_wanted(count):
    scene = in_order(random_gaussians(2 * RUN_BLOCK + 10))
    assert 0.7 * count <= len(merge_nearby(scene, count)) <= count
    # Of two provenances that alternate nothing is merged.
    mixed = replace(scene, generated=(torch.arange(len(scene)) % 2).to(torch.uint8))
    assert len(merge_nearby(mixed, count)) == len(scene)


@pytest.mark.parametrize("away", [1e1, 1e6, 1e9])
def test_a_floater_far_away_does_not_merge_the_others(away):
    scene = random_gaussians(2000)
    means = scene.means.clone()
    means[0] = away
    scene = in_order(replace(scene, means=means))
    assert 0.95 * 1800 <= len(merge_nearby(scene, 1800)) <= 1800


def test_evidence_of_the_scene_and_of_its_proxy_is_the_same():
    ours, truth = evidence_of(PROXY.rendered).areas.sum(), evidence_of(CROWD).areas.sum()
    assert ours.item() == pytest.approx(truth.item(), rel=0.02)


def test_evidence_is_thinned_with_the_scene():
    rows = torch.arange(0, len(CROWD), COPIES)
    growth = torch.full((len(rows),), COPIES**0.5)
    whole = evidence_of(CROWD)
    thin = trust_in(CROWD).thin(rows, growth).observations
    assert thin.areas.shape == (len(VIEWS), len(rows))
    assert thin.areas.sum().item() == pytest.approx(whole.areas.sum().item(), rel=0.1)


def test_a_scene_of_which_a_proxy_would_keep_most_is_its_own_proxy(monkeypatch):
    """Unless it is too large for frozen views at so many cameras."""
    monkeypatch.setattr(proxies, "MIN_PROXY_GAUSSIANS", 0)
    kept = len(PROXY.rendered) / len(CROWD)
    for share, is_whole in ((0.9 * kept, True), (1.1 * kept, False)):
        monkeypatch.setattr(proxies, "MAX_PROXY_SHARE", share)
        assert (build_proxy(CROWD, CAMERAS).rendered is CROWD) == is_whole
    monkeypatch.setattr(proxies, "MAX_PROXY_SHARE", 0.9 * kept)
    monkeypatch.setattr(proxies, "count_fitting_gaussians", lambda number: len(CROWD) - 1)
    assert len(build_proxy(CROWD, CAMERAS).rendered) == len(PROXY.rendered)


class KnowingReconstructor:
    def __call__(self, views):
        return reconstruction_of(views, [view_of(Room(), view.camera).depth for view in views])


# `tests/trust/test_photometric.py` completes a scene with a proxy.
@pytest.mark.slow
def test_a_scene_is_completed_alike_whether_or_not_it_has_a_proxy(monkeypatch):
    paint = lambda nearest, target, context: view_of(Room(), target).image  # noqa: E731
    asked = (VIEWS[::2], TARGET, CROWD, VIEWS[1:2])
    whole = GSCompleter(KnowingReconstructor(), paint)(*asked)
    monkeypatch.setattr(proxies, "MIN_PROXY_GAUSSIANS", 0)
    found = GSCompleter(KnowingReconstructor(), paint)(*asked)
    assert len(found.source.rendered) < 0.5 * len(CROWD)
    assert torch.equal(found.scene.means, torch.cat([CROWD.means, found.added.means]))
    truth = view_of(Room(), TARGET).image
    ours, theirs = (psnr(RENDERER.render(c.scene, TARGET).image, truth) for c in (found, whole))
    assert ours > psnr(RENDERER.render(CROWD, TARGET).image, truth) + 3
    assert abs(ours - theirs) < 0.6
    for view in VIEWS:
        before = psnr(RENDERER.render(CROWD, view.camera).image, view.image)
        assert psnr(RENDERER.render(found.scene, view.camera).image, view.image) > before - 0.05


def test_a_scene_is_drawn_as_finely_as_the_targets_that_are_known(monkeypatch):
    monkeypatch.setattr(proxies, "MIN_PROXY_GAUSSIANS", 0)
    completer = GSCompleter(KnowingReconstructor())
    near = replace(TARGET, K=TARGET.K * torch.tensor([[4.0], [4.0], [1.0]]))
    coarse = completer.begin(VIEWS[::2], CROWD)
    fine = completer.begin(VIEWS[::2], CROWD, targets=[near])
    assert len(coarse.rendered_context) < len(fine.rendered_context) <= len(CROWD)
