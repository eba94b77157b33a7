"""Input splats, opaque everywhere: regions that no photograph confirms are holes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter.apps.report.completion import InputSplatFile, restore_file_order
from gscompleter.completer import GSCompleter
from gscompleter.config import (
    AlignmentConfig,
    CompleterConfig,
    RegistrationConfig,
    TrustConfig,
)
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.geometry import is_inside, project
from gscompleter.guards.mvs_hint import apply_stereo, render_stereo
from gscompleter.guards.prune_occluders import find_unneeded
from gscompleter.guards.psnr import compute_squared_error
from gscompleter.memory import estimate_bytes
from gscompleter.render import load_renderer
from gscompleter.render.lod import MIN_PROXY_GAUSSIANS
from gscompleter.splats.morton import argsort_nearby
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.state import Completion
from gscompleter.trust.photometric import (
    compute_trust,
    compute_trusted_alpha,
    gather_observations,
    sum_weights,
)
from gscompleter.types import GeneratorInput, merge, sh_from_rgb
from scenes import (
    Room,
    camera_at,
    gaussians_of,
    labelled,
    photographed,
    reconstruction_of,
    view_of,
)

RENDERER = load_renderer("cpu")
SIZE = 64
PHOTOGRAPHS = [camera_at(x, size=SIZE) for x in (-0.3, 0.0, 0.3)]
TARGET = camera_at(0.5, yaw=25, size=SIZE)
VIEWS = [view_of(Room(), camera) for camera in PHOTOGRAPHS]
SURFACES = merge([gaussians_of(view) for view in (VIEWS[0], VIEWS[2])])


def shreds():
    """Make floaters in arbitrary colours in front of the target, unseen by photographs."""
    view = view_of(Room(), TARGET)
    found = gaussians_of(view, 0.8 * view.depth)
    seen = [is_inside(*project(found.means, camera), camera) for camera in PHOTOGRAPHS]
    found = found[~torch.stack(seen).any(0)]
    colours = torch.rand(len(found), 3, generator=torch.Generator().manual_seed(0))
    return replace(found, sh=sh_from_rgb(colours))


SHREDS = shreds()
SCENE = merge([SURFACES, SHREDS])
ARE_SHREDS = torch.arange(len(SCENE)) >= len(SURFACES)
AT_TARGET = RENDERER.freeze(SCENE, TARGET)


def frozen_at(views, scene=SCENE):
    return [RENDERER.freeze(scene, view.camera) for view in views]


class KnowingReconstructor:
    def __call__(self, views):
        return reconstruction_of(views, [view_of(Room(), view.camera).depth for view in views])


def error_of(scene, view):
    return compute_squared_error(RENDERER.render(scene, view.camera).image, view.image).item()


def knowing(config=CompleterConfig()):
    paint = lambda nearest, target, context: view_of(Room(), target).image  # noqa: E731
    return GSCompleter(KnowingReconstructor(), paint, config=config)


def test_surfaces_are_supported_and_shreds_are_not():
    evidence = gather_observations(SCENE, VIEWS, frozen_at(VIEWS), TrustConfig())
    sums = sum_weights(AT_TARGET)
    found, drawn = compute_trust(evidence, sums, TARGET), sums > 0.1
    assert found[drawn & ~ARE_SHREDS].median() > 0.8
    # A few overlap the border of a photograph.
    assert found[drawn & ARE_SHREDS].quantile(0.9) < 0.1


@pytest.mark.parametrize("exposure", [0.8, 1.25])
def test_another_exposure_is_no_contradiction(exposure):
    views = [replace(VIEWS[0], image=(exposure * VIEWS[0].image).clamp(0, 1)), VIEWS[1], VIEWS[2]]
    evidence = gather_observations(SCENE, views, frozen_at(views), TrustConfig())
    assert evidence.agreement[0, evidence.areas[0] > 0].median() > 0.8


def test_a_photograph_of_something_else_contradicts():
    image = VIEWS[1].image.clone()
    image[:, : SIZE // 4] = 0.0
    views = [VIEWS[0], replace(VIEWS[1], image=image), VIEWS[2]]
    evidence = gather_observations(SCENE, views, frozen_at(views), TrustConfig())
    pixels, z = project(SCENE.means, PHOTOGRAPHS[1])
    shown = (evidence.areas[1] > 0) & is_inside(pixels, z, PHOTOGRAPHS[1])
    left = pixels[:, 0] < SIZE // 4 - 4
    right = pixels[:, 0] > SIZE // 4 + 4
    assert evidence.agreement[1, shown & left].mean() < 0.2
    assert evidence.agreement[1, shown & right].mean() > 0.6


def test_sums_of_weights_make_up_the_alpha():
    sums = sum_weights(AT_TARGET)
    alpha = RENDERER.render(SCENE, TARGET).alpha.sum()
    assert torch.isclose(sums.sum(), alpha, rtol=1e-3)


def test_only_what_no_photograph_needs_is_set_aside():
    doubtful = ARE_SHREDS.clone()
    doubtful[1000:1100] = True
    gone = find_unneeded(SCENE[doubtful], frozen_at(VIEWS, SCENE[~doubtful]), VIEWS)
    taken = doubtful.masked_scatter(doubtful, gone)
    assert taken[ARE_SHREDS].float().mean() > 0.8
    assert not (taken & ~doubtful).any()
    for view in VIEWS:
        assert error_of(SCENE[~taken], view) <= error_of(SCENE, view) * (1 + 1e-6)


def test_shreds_give_way_to_what_belongs_there():
    completion = knowing()(VIEWS[::2], TARGET, SCENE, check_views=VIEWS[1:2])
    (result,) = completion.targets
    truth = view_of(Room(), TARGET).image
    assert result.hole_fraction > 0.1
    assert psnr(result.after.image, truth) > psnr(result.before.image, truth) + 3
    assert completion.pruned is not None
    assert completion.pruned[ARE_SHREDS].float().mean() > 0.8
    kept = completion.scene[: completion.num_kept]
    assert torch.equal(kept.means, SCENE.means[~completion.pruned])
    for view in VIEWS:
        before = psnr(RENDERER.render(SCENE, view.camera).image, view.image)
        after = psnr(RENDERER.render(completion.scene, view.camera).image, view.image)
        assert after > before - 0.05


class NearReconstructor:
    """Ψ whose Gaussians are a fifth too near."""

    def __call__(self, views):
        depths = [0.8 * view_of(Room(), view.camera).depth for view in views]
        return reconstruction_of(views, depths)


def test_closing_a_hole_makes_up_for_nothing_that_was_good():
    """Half of the room is missing in every photograph, too, so additions improve them all."""
    half = SURFACES[SURFACES.means[:, 0] < 0.3]
    paint = lambda nearest, target, context: view_of(Room(), target).image  # noqa: E731
    unmended = AlignmentConfig(align_at="none"), RegistrationConfig(iterations=0)
    config = CompleterConfig(alignment=unmended[0], registration=unmended[1])
    completer = GSCompleter(NearReconstructor(), paint, config=config)
    completion = completer(VIEWS[::2], TARGET, half, check_views=VIEWS[1:2])
    assert len(completion.targets[0].added) > 0
    gained = []
    for view, (seen, *_) in zip(completion.photos, completion.budgets, strict=True):
        before, after = (RENDERER.render(g, view.camera) for g in (half, completion.scene))
        holes = before.alpha < 0.5
        assert holes.float().mean() > 0.05
        assert torch.equal(seen.view.ignore_mask, holes)
        errors = [
            (render.image.clamp(0, 1) - view.image).square().mean(dim=-1)
            for render in (before, after)
        ]
        assert errors[1][~holes].sum() <= errors[0][~holes].sum() * 1.001
        gained.append((errors[0] - errors[1])[holes].sum().item())
    assert max(gained) > 0


def test_without_its_photographs_a_scene_is_taken_as_it_is():
    completion = knowing()(VIEWS[::2], TARGET, SCENE)
    assert completion.pruned is None
    assert completion.observations is None
    assert completion.targets[0].hole_fraction < 0.05


def test_unsupported_gaussians_may_be_kept():
    config = CompleterConfig(trust_settings=TrustConfig(prune=False))
    completion = knowing(config)(VIEWS[::2], TARGET, SCENE, check_views=())
    assert completion.pruned is None
    assert torch.equal(completion.scene.means[: len(SCENE)], SCENE.means)


def test_the_paper_doubts_nothing():
    completion = knowing(CompleterConfig.paper())(VIEWS[::2], TARGET, SCENE, check_views=())
    assert completion.observations is None


def test_what_photographs_show_by_themselves_takes_the_place_of_what_is_doubted():
    camera = camera_at(0.15, size=SIZE)
    truth = view_of(Room(), camera)
    in_the_way = gaussians_of(truth, 0.8 * truth.depth)[: SIZE * SIZE // 4]
    black = sh_from_rgb(torch.zeros(len(in_the_way), 3))
    scene = merge([SURFACES, replace(in_the_way, sh=black)])
    frozen, config = RENDERER.freeze(scene, camera), TrustConfig(color_sigma=0.03)
    evidence, drawn = (
        gather_observations(scene, VIEWS, frozen_at(VIEWS, scene), config),
        frozen.render,
    )
    found = compute_trust(evidence, sum_weights(frozen), camera)
    believed = compute_trusted_alpha(frozen, found)
    stereo = render_stereo(VIEWS, camera, drawn, KnowingReconstructor(), RENDERER, config)
    context = GeneratorInput(tuple(VIEWS), (), drawn, trusted_alpha=believed)
    told = apply_stereo(context, stereo)
    assert context.holes.float().mean() > 0.15
    assert told.holes.float().mean() < 0.75 * context.holes.float().mean()
    taken = context.holes & ~told.holes
    error = (told.target_render.image - truth.image)[taken].abs().mean()
    assert error < 0.5 * (drawn.image - truth.image)[taken].abs().mean()
    assert torch.equal(told.target_render.image[~context.holes], drawn.image[~context.holes])


def test_one_photograph_makes_no_stereo():
    drawn = RENDERER.render(SCENE, TARGET)
    config = TrustConfig()
    assert render_stereo(VIEWS[:1], TARGET, drawn, KnowingReconstructor(), RENDERER, config) is None


def complete(scene, splat, out, *more):
    asked = ["--context", "0", "2", "--target", "3", "--near", "0.5", "--far", "20"]
    asked += ["--resolution", "48", "--config.reconcile.iterations", "10"]
    return ["complete", scene, "--scene", splat, *asked, "--out", out, "--quiet", *more]


@pytest.mark.parametrize("worth", [0, MIN_PROXY_GAUSSIANS], ids=["sorted", "as-given"])
def test_the_command_sets_aside_and_strip_puts_back(tmp_path, monkeypatch, worth):
    """Restored to the byte, whether or not the scene was sorted in between."""
    monkeypatch.setattr("gscompleter.apps.commands.complete.MIN_PROXY_GAUSSIANS", worth)
    scene = photographed(tmp_path / "scene", [*PHOTOGRAPHS, TARGET])
    splat, out = tmp_path / "splat.ply", tmp_path / "out"
    save_ply(splat, SCENE)
    assert run(monkeypatch, *complete(scene, splat, out)) == 0
    removed = load_ply(out / "removed.ply")
    assert len(removed) > 0
    assert torch.equal(load_ply(out / "context.ply").means, SCENE.means)
    assert (out / "images" / "target1_support.png").is_file()
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", tmp_path / "back.ply") == 0
    assert (tmp_path / "back.ply").read_bytes() == splat.read_bytes()


def test_a_sorted_scene_is_the_same_in_the_order_of_its_file():
    order = argsort_nearby(SCENE)
    sides = SCENE.means[order].diff(dim=0).norm(dim=1)
    assert sorted(order.tolist()) == list(range(len(SCENE)))
    assert (
        sides.median()
        < 0.2 * SCENE.means[torch.randperm(len(SCENE))].diff(dim=0).norm(dim=1).median()
    )
    added, brought = SCENE[:3], InputSplatFile(Path("splat.ply"), file_order=order)
    for aside in (None, torch.arange(len(SCENE)) % 3 == 0):
        sorted_aside = None if aside is None else aside[order]
        context = SCENE[order]
        left = context if aside is None else context[~aside[order]]
        drawn = merge([left, added])
        completion = Completion(drawn, context, (), (), (), {}, pruned=sorted_aside)
        context, left_out = restore_file_order(completion, brought)
        assert torch.equal(context.means, SCENE.means)
        assert (left_out is None) if aside is None else torch.equal(left_out, aside)


def test_the_command_keeps_what_it_is_told_to(tmp_path, monkeypatch):
    scene = photographed(tmp_path / "scene", [*PHOTOGRAPHS, TARGET])
    splat, out = tmp_path / "splat.ply", tmp_path / "out"
    save_ply(splat, SCENE)
    assert run(monkeypatch, *complete(scene, splat, out, "--no-prune")) == 0
    assert not (out / "removed.ply").exists()
    assert torch.equal(load_ply(out / "completed.ply").means[: len(SCENE)], SCENE.means)


def test_the_command_refuses_a_scene_that_does_not_fit(tmp_path, monkeypatch, capsys):
    scene = photographed(tmp_path / "scene", [*PHOTOGRAPHS, TARGET])
    save_ply(tmp_path / "splat.ply", SCENE)
    there = estimate_bytes(48 * 48, 3)
    monkeypatch.setattr("gscompleter.memory.read_memory_bytes", lambda: there)
    assert run(monkeypatch, *complete(scene, tmp_path / "splat.ply", tmp_path / "out")) == 2
    assert f"The {len(SCENE):,} Gaussians of the scene and 3 photographs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("worth", [0, MIN_PROXY_GAUSSIANS], ids=["sorted", "as-given"])
def test_rows_of_another_program_come_back_whole(tmp_path, monkeypatch, worth):
    monkeypatch.setattr("gscompleter.apps.commands.complete.MIN_PROXY_GAUSSIANS", worth)
    scene = photographed(tmp_path / "scene", [*PHOTOGRAPHS, TARGET])
    splat, out = labelled(tmp_path / "splat.ply", SCENE), tmp_path / "out"
    assert run(monkeypatch, *complete(scene, splat, out)) == 0
    assert len(load_ply(out / "removed.ply")) > 0
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", tmp_path / "back.ply") == 0
    assert (tmp_path / "back.ply").read_bytes() == splat.read_bytes()
