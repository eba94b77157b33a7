"""Targets chosen by the planner, in a room whose right part was never observed."""

from dataclasses import replace

import pytest
import torch

from gscompleter import CompleterConfig, GSCompleter
from gscompleter.config import AlignmentConfig, NextBestViewConfig, RegistrationConfig
from gscompleter.config.settings import COVERED
from gscompleter.evaluation.metrics.coverage import (
    compute_coverage,
    compute_covered_share,
    render_pairs,
    sample_held_out_cameras,
)
from gscompleter.planning.candidates import Candidate
from gscompleter.planning.planner import (
    Choice,
    ViewPlanner,
    add_free_space_cameras,
    choose_best,
    compute_gain,
    compute_remoteness,
    make_placeholders,
    simplify_completion,
)
from gscompleter.render.loading import load_renderer
from gscompleter.stages.select_anchor import compute_overlap
from gscompleter.state import Completion
from gscompleter.types import Camera, Gaussians, Render, View, merge
from knowing_models import KnowingGenerator, KnowingReconstructor, knowing
from scenes import Room, camera_at, cast, gaussians_of, view_of

SIZE = 64
PLACES = (-0.3, 0.1)


def photographs() -> list[View]:
    return [view_of(Room(), camera_at(x, size=SIZE), i) for i, x in enumerate(PLACES)]


def explorer(**changes: float) -> ViewPlanner:
    config = replace(CompleterConfig(), next_best_view=NextBestViewConfig(image_size=48, **changes))
    return ViewPlanner(GSCompleter(KnowingReconstructor(), KnowingGenerator(), config=config))


@pytest.fixture(scope="module")
def begun() -> Completion:
    return explorer().completer.begin(photographs())


@pytest.fixture(scope="module")
def opaque() -> Completion:
    """Begin with a splat that is opaque where the photographs see nothing."""
    unseen = view_of(Room(), camera_at(0.7, yaw=25, size=SIZE))
    scene = gaussians_of(photographs()[0])
    for view in (photographs()[1], replace(unseen, image=1 - unseen.image)):
        holes = load_renderer("cpu").render(scene, view.camera).alpha < COVERED
        scene = merge([scene, gaussians_of(view)[holes.flatten()]])
    splat = replace(CompleterConfig.splat(), next_best_view=NextBestViewConfig(image_size=48))
    completer = GSCompleter(KnowingReconstructor(), KnowingGenerator(), config=splat)
    return completer.begin(photographs(), scene, [])


def cameras():
    return [view.camera for view in photographs()]


def test_holes_count_where_they_border_on_what_was_observed():
    holes = torch.zeros(40, 40, dtype=torch.bool)
    holes[:, 20:] = True
    near, none = NextBestViewConfig(border_radius=0.1), torch.zeros(40, 40)
    wide = NextBestViewConfig(border_radius=1.0)
    assert compute_gain(holes, none, 1.0, near) == pytest.approx(4 / 40)
    assert compute_gain(holes, none, 0.5, near) == pytest.approx(2 / 40)
    assert compute_gain(holes, none, 1.0, wide) == pytest.approx(0.5)
    assert compute_gain(torch.ones_like(holes), none, 1.0) == 0.0
    assert compute_gain(torch.zeros_like(holes), none, 1.0) == 0.0


def test_what_is_covered_without_trust_counts_outside_of_holes():
    holes, distrust = torch.zeros(40, 40, dtype=torch.bool), torch.full((40, 40), 0.2)
    assert compute_gain(holes, distrust, 0.5) == pytest.approx(0.5 * 0.2**2)
    holes[:, 20:] = True
    near = NextBestViewConfig(border_radius=0.1)
    assert compute_gain(holes, distrust, 1.0, near) == pytest.approx(0.5 * 0.2**2 + 4 / 40)


def test_overlap_is_what_the_anchor_sees_too():
    def seen(camera):
        image, depth = cast(Room(), camera)
        return camera, Render(image, depth, torch.ones_like(depth))

    here = seen(camera_at())
    assert compute_overlap(*here, *here) > 0.97
    assert compute_overlap(*here, *seen(camera_at(yaw=180))) == 0.0
    aside = compute_overlap(*here, *seen(camera_at(yaw=25)))
    assert 0.2 < aside < 0.8
    covered_by_a_wall = replace(here[1], depth=torch.full_like(here[1].depth, 0.5))
    assert compute_overlap(*here, here[0], covered_by_a_wall) < 0.02


def test_steps_ahead_come_before_turns_up_and_down():
    """A ceiling gains most, and nobody walks there."""
    here = camera_at()
    turned = Choice(Candidate(here, 0, 1.0, looks_up_or_down=True), 0.4, gain=0.3)
    aside = Choice(Candidate(here, 0, 1.0), 0.2, gain=0.1)
    little = Choice(Candidate(here, 0, 1.0), 0.1, gain=0.05)
    assert choose_best([turned, little, aside], [here], 1.0) is aside
    assert choose_best([turned, little], [here], 1.0) is turned
    assert choose_best([replace(turned, gain=0.005)], [here], 1.0) is None
    assert aside.describe() == "Chosen because 20% of its image is empty, beside what is known."
    assert "up or down" in turned.describe()
    unconfirmed = replace(aside, opaque_fraction=0.1).describe()
    assert "20% of its image is empty or confirmed by no photograph, beside" in unconfirmed


def test_cameras_are_found_until_little_is_left_and_the_scene_covers_more(begun):
    completion, choices = explorer().explore(begun, cameras(), 3)
    assert 1 <= len(choices) <= 3
    assert len(completion.targets) == len(choices)
    assert all(choice.gain >= 0.01 for choice in choices)
    aside = sample_held_out_cameras(cameras(), seed=0)
    found = compute_coverage(render_pairs(completion, aside, load_renderer("cpu")))
    assert found.before < 0.95
    assert found.after - found.before > 0.4 * (1 - found.before)


def test_the_second_camera_is_chosen_in_the_scene_that_the_first_left(begun):
    searching = explorer()
    completion, (first,) = searching.explore(begun, cameras(), 1)
    (before,), (after,) = (
        searching.score_candidates(c, [first.candidate]) for c in (begun, completion)
    )
    assert before.gain == first.gain
    assert after.gain < 0.5 * before.gain


def test_a_splat_is_completed_where_it_is_opaque_and_not_trusted(opaque):
    _, (choice,) = explorer().explore(opaque, cameras(), 1)
    alpha = load_renderer("cpu").render(opaque.rendered_context, choice.camera).alpha
    assert choice.gain > 0.05 > 1.5 * (alpha < COVERED).float().mean()
    assert choice.camera.center[0] > 0.1


def test_no_place_of_a_splat_is_tried_twice(opaque):
    def refuse(completion: Completion, camera: Camera) -> Completion:
        tried.append(camera)
        return completion

    tried: list[Camera] = []
    searching = explorer()
    _, step = searching.find_candidates(opaque, cameras())
    searching.complete_greedily(opaque, cameras(), 10, refuse)
    assert 2 <= len(tried) < 10
    for number, camera in enumerate(tried[1:], start=1):
        assert compute_remoteness(camera, tried[:number], step) > 1


def test_coverage_of_a_splat_is_what_is_trusted_and_includes_what_was_recoloured(opaque):
    renderer = load_renderer("cpu")
    aside = [camera_at(0.7, yaw=yaw, size=SIZE) for yaw in (15, 25)]
    found = compute_coverage(render_pairs(opaque, aside, renderer))
    seen = [renderer.render(opaque.rendered_context, camera) for camera in aside]
    assert found.before == found.after < compute_covered_share(seen) - 0.1
    frozen, rows = (
        renderer.freeze(opaque.rendered_context, aside[0]),
        torch.arange(len(opaque.rendered_context)),
    )
    trusted = replace(opaque, trust=opaque.trust.accept(frozen, aside[0], rows))
    then = compute_coverage(render_pairs(trusted, aside, renderer))
    assert then.before == found.before
    assert then.after == pytest.approx(compute_covered_share(seen), abs=0.01)


def test_nothing_is_found_where_nothing_is_left(begun):
    greedy = replace(begun.config, next_best_view=NextBestViewConfig(min_gain=1.0))
    begun = replace(begun, config=greedy)
    completion, choices = explorer().explore(begun, cameras(), 3)
    assert choices == ()
    assert completion.scene is begun.scene
    assert completion.targets == ()


def test_a_plan_takes_the_first_camera_that_is_completed_and_then_another(begun):
    searching = explorer()
    plan = searching.plan(begun, cameras(), 2)
    _, (first,) = searching.explore(begun, cameras(), 1)
    assert torch.equal(plan[0].camera.c2w, first.camera.c2w)
    assert all(choice.camera is not plan[0].camera for choice in plan[1:])
    assert (
        searching.compute_hole_fractions(begun, [first.camera] * 2)[1] < 0.1 * first.hole_fraction
    )


def test_a_camera_before_a_surface_gains_nothing(begun):
    searching = explorer()
    (found,) = searching.plan(begun, cameras(), 1)
    (far,) = searching.score_candidates(begun, [replace(found.candidate, nearest=1e-3)])
    (near,) = searching.score_candidates(begun, [replace(found.candidate, nearest=1e3)])
    assert far.gain > 0
    assert near.gain == 0


def test_stand_ins_close_the_hole_and_hide_nothing():
    target = camera_at(0.7, yaw=12, size=SIZE)
    renderer, scene = load_renderer("cpu"), gaussians_of(photographs()[0])
    render = renderer.render(scene, target)
    holes = render.alpha < 0.5
    added = make_placeholders(render, holes, target)
    assert len(added) == int(holes.sum()) > 0
    assert (renderer.render(added, target).alpha[holes] > 0.5).float().mean() > 0.98
    depth = renderer.render(added, target).depth[holes]
    assert render.depth[~holes].min() * 0.9 < depth.min()
    assert depth.max() < render.depth[~holes].max() * 1.1


def test_a_miniature_covers_what_the_scene_covers(begun):
    small = simplify_completion(begun, 3000)
    assert len(small.rendered_context) <= 3000 < len(begun.rendered_context)
    renderer = load_renderer("cpu")
    aside = sample_held_out_cameras(cameras(), seed=3, count=8)
    shares = [
        compute_covered_share(
            [renderer.render(completion.rendered_context, camera) for camera in aside]
        )
        for completion in (begun, small)
    ]
    assert shares[1] == pytest.approx(shares[0], abs=0.02)


def test_cameras_that_judge_coverage_are_the_same_for_the_same_seed():
    given = [camera_at(x, yaw=30 * x) for x in (0.0, 0.4, 0.8, 1.2)]
    one, same, other = (sample_held_out_cameras(given, seed, 5) for seed in (0, 0, 1))
    for first, second in zip(one, same, strict=True):
        assert torch.equal(first.c2w, second.c2w)
    assert not torch.equal(one[0].c2w, other[0].c2w)
    centers = torch.stack([camera.center for camera in sample_held_out_cameras(given, 0, 64)])
    assert centers[:, 0].min() < 0.2
    assert centers[:, 0].max() > 1.0
    assert centers[:, 1:].abs().max() < 1.5


def test_nothing_is_added_before_what_a_bystander_sees(begun):
    """Lifted depths are a fifth too short, which only further cameras can detect."""
    config = CompleterConfig(
        alignment=AlignmentConfig(align_at="none"), registration=RegistrationConfig(iterations=0)
    )
    completer, begun = knowing(), replace(begun, config=config)
    target = camera_at(0.7, yaw=12, size=SIZE)
    aside = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((0.5, 4), (-0.6, -4))]
    watched = add_free_space_cameras(begun, [*cameras(), *aside])
    assert len(watched.free_space_cameras) == 2
    hidden = []
    for state in (begun, watched):
        scene = completer.advance(state, target).scene
        hidden.append(sum(nearer(scene, begun.scene, camera) for camera in aside))
    assert hidden[1] < 0.9 * hidden[0]


def nearer(scene: Gaussians, before: Gaussians, camera: Camera) -> float:
    """Compute the fraction of a camera's view that new Gaussians occlude."""
    renderer = load_renderer("cpu")
    seen, now = renderer.render(before, camera).depth_map(), renderer.render(scene, camera)
    return (seen.valid & (now.depth < 0.9 * seen.depth)).float().mean().item()
