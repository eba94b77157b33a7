"""Input splats, opaque everywhere: regions that no photograph confirms are holes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.apps.report.scenes import find_file_order
from gscompleter.completer import GSCompleter
from gscompleter.config import (
    AlignmentConfig,
    CompleterConfig,
    RegistrationConfig,
    TrustConfig,
)
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.geometry import is_inside, project
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import MIN_PROXY_GAUSSIANS
from gscompleter.splats.morton import argsort_nearby
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.stages.error_budgets import compute_squared_error
from gscompleter.system.files.mapping import is_mapped, move_to_file
from gscompleter.system.memory import estimate_bytes
from gscompleter.trust import Trust
from gscompleter.trust.photometric import (
    compute_trust,
    gather_observations,
    load_trust,
    sum_weights,
)
from gscompleter.types import merge, sh_from_rgb
from scenes import (
    Room,
    camera_at,
    gaussians_of,
    labelled,
    photographed,
    reconstruction_of,
    view_of,
)
from target_views import begin_with

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


def knowing(config=None):
    paint = lambda nearest, target, context: view_of(Room(), target).image  # noqa: E731
    return GSCompleter(KnowingReconstructor(), paint, config=config)


def test_surfaces_are_supported_and_shreds_are_not():
    evidence = gather_observations(SCENE, VIEWS, frozen_at(VIEWS), TrustConfig())
    sums = sum_weights(AT_TARGET)
    found, drawn = compute_trust(evidence, sums, TARGET), sums > 0.1
    assert found[drawn & ~ARE_SHREDS].median() > 0.8
    # A few overlap the border of a photograph.
    assert found[drawn & ARE_SHREDS].quantile(0.9) < 0.1


@pytest.mark.linux
def test_trust_in_a_scene_in_a_file_lies_in_files(tmp_path):
    """It has three numbers for each Gaussian in each photograph."""
    mapped = replace(SCENE, sh=move_to_file(SCENE.sh, tmp_path))
    scenes = SceneRenderer(RENDERER)
    config = CompleterConfig.splat()
    plain, filed = (load_trust(config, (scene,), VIEWS, scenes) for scene in (SCENE, mapped))
    rows = torch.arange(0, len(SCENE), 2)
    growth = torch.full((len(rows),), 1.5)
    further = [trust.accept(AT_TARGET, TARGET, rows) for trust in (plain, filed)]
    for ours, truth in (
        (filed, plain),
        (filed.thin(rows, growth), plain.thin(rows, growth)),
        (further[1], further[0]),
    ):
        assert is_mapped(ours.held.sums)
        assert torch.equal(ours.held.sums, truth.held.sums)
        for name in ("areas", "agreement"):
            values = getattr(ours.observations, name)
            assert is_mapped(values), name
            assert torch.equal(values, getattr(truth.observations, name)), name
    assert torch.equal(
        filed.compute_alpha(AT_TARGET, TARGET), plain.compute_alpha(AT_TARGET, TARGET)
    )


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


def test_a_photograph_that_masks_hide_altogether_says_nothing():
    """As one that shows nothing but what an earlier command removed."""
    hidden = replace(VIEWS[1], ignore_mask=torch.ones(SIZE, SIZE, dtype=torch.bool))
    sums = sum_weights(AT_TARGET)
    found, expected = (
        compute_trust(
            gather_observations(SCENE, views, frozen_at(views), TrustConfig()), sums, TARGET
        )
        for views in ([VIEWS[0], hidden, VIEWS[2]], [VIEWS[0], VIEWS[2]])
    )
    assert torch.equal(found, expected)


def test_sums_of_weights_make_up_the_alpha():
    sums = sum_weights(AT_TARGET)
    alpha = RENDERER.render(SCENE, TARGET).alpha.sum()
    assert torch.isclose(sums.sum(), alpha, rtol=1e-3)


def test_shreds_give_way_to_what_belongs_there():
    completion = knowing()(VIEWS[::2], TARGET, SCENE, check_views=VIEWS[1:2])
    (result,) = completion.targets
    truth = view_of(Room(), TARGET).image
    assert result.hole_fraction > 0.1
    assert psnr(result.after.image, truth) > psnr(result.before.image, truth) + 3
    changed = completion.recolored_mask
    assert changed[ARE_SHREDS].float().mean() > 0.5
    assert (completion.scene.generated[: len(SCENE)][changed] == 1).all()
    same = completion.recolored_context
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(same, name), getattr(SCENE, name)), name
    assert torch.equal(same.sh[~changed], SCENE.sh[~changed])
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
    config = replace(CompleterConfig.splat(), alignment=unmended[0], registration=unmended[1])
    config = replace(config, add_observed=False)
    completer = GSCompleter(NearReconstructor(), paint, config=config)
    completion = completer(VIEWS[::2], TARGET, half, check_views=VIEWS[1:2])
    assert len(completion.targets[0].added) > 0
    gained = []
    for photo in completion.photos:
        view, (seen, *_) = photo.view, photo.budgets
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
    assert not completion.recolored_mask.any()
    assert completion.trust == Trust()
    assert completion.targets[0].hole_fraction < 0.05


def test_the_paper_doubts_nothing():
    completion = knowing(CompleterConfig.paper())(VIEWS[::2], TARGET, SCENE, check_views=())
    assert completion.trust == Trust()


def complete(scene, splat, out, *more):
    asked = ["--context", "0", "2", "--target", "3", "--near", "0.5", "--far", "20"]
    asked += ["--resolution", "48"]
    return ["complete", scene, "--scene", splat, *asked, "--out", out, "--quiet", *more]


@pytest.mark.parametrize(
    "worth",
    [
        pytest.param(0, id="sorted"),
        pytest.param(MIN_PROXY_GAUSSIANS, id="as-given", marks=pytest.mark.slow),
    ],
)
def test_the_command_recolours_and_strip_puts_back(tmp_path, monkeypatch, worth):
    """Restored to the byte, with further columns and whether or not the scene was sorted before."""
    monkeypatch.setattr("gscompleter.apps.inputs.splat.MIN_PROXY_GAUSSIANS", worth)
    scene = photographed(tmp_path / "scene", [*PHOTOGRAPHS, TARGET])
    splat, out = labelled(tmp_path / "splat.ply", SCENE), tmp_path / "out"
    assert run(monkeypatch, *complete(scene, splat, out)) == 0
    removed = load_ply(out / "removed.ply")
    assert len(removed) > 0
    assert torch.equal(load_ply(out / "context.ply").means, SCENE.means)
    assert (out / "images" / "target1_support.png").is_file()
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", tmp_path / "back.ply") == 0
    assert (tmp_path / "back.ply").read_bytes() == splat.read_bytes()


@pytest.mark.linux
def test_colours_of_a_large_scene_lie_in_a_file_and_nothing_else_changes(tmp_path, monkeypatch):
    monkeypatch.setattr("gscompleter.apps.inputs.splat.MIN_PROXY_GAUSSIANS", 0)
    scene = photographed(tmp_path / "scene", [*PHOTOGRAPHS, TARGET])
    splat = labelled(tmp_path / "splat.ply", SCENE)
    files = []
    for name, begins in (("in-memory", lambda values, _: values), ("in-file", move_to_file)):
        mapped = []

        def move(values, beside, begins=begins, mapped=mapped):
            moved = begins(values, beside)
            mapped.append(is_mapped(moved))
            return moved

        monkeypatch.setattr("gscompleter.apps.inputs.splat.move_to_file", move)
        out = tmp_path / name
        assert run(monkeypatch, *complete(scene, splat, out)) == 0
        assert set(mapped) == {name == "in-file"}
        files.append([(out / file).read_bytes() for file in ("completed.ply", "removed.ply")])
    assert files[0] == files[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("in-file", "in-memory", "scene", "splat.ply")
    ]


def test_a_sorted_scene_is_the_same_in_the_order_of_its_file():
    order = argsort_nearby(SCENE)
    sides = SCENE.means[order].diff(dim=0).norm(dim=1)
    assert sorted(order.tolist()) == list(range(len(SCENE)))
    assert (
        sides.median()
        < 0.2 * SCENE.means[torch.randperm(len(SCENE))].diff(dim=0).norm(dim=1).median()
    )
    given = InputSplatFile(Path("splat.ply"), file_order=order)
    state = begin_with(SCENE[order], VIEWS)
    is_changed = torch.arange(len(SCENE)) % 3 == 0
    ids = is_changed[order].to(torch.uint8)
    dyed = state.rendered_context
    dyed = replace(dyed, sh=dyed.sh + 0.1 * ids[:, None, None], generated=ids)
    state = replace(state, rendered_context=dyed)
    in_file = find_file_order(state.context, given)
    assert torch.equal(state.context.means[in_file], SCENE.means)
    assert torch.equal(state.recolored_mask[in_file], is_changed)


def test_the_command_refuses_a_scene_that_does_not_fit(tmp_path, monkeypatch, capsys):
    scene = photographed(tmp_path / "scene", [*PHOTOGRAPHS, TARGET])
    save_ply(tmp_path / "splat.ply", SCENE)
    there = estimate_bytes(48 * 48, 3)
    monkeypatch.setattr("gscompleter.system.memory.read_memory_bytes", lambda: there)
    assert run(monkeypatch, *complete(scene, tmp_path / "splat.ply", tmp_path / "out")) == 2
    assert f"The {len(SCENE):,} Gaussians of the scene and 3 photographs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
