"""The whole method: properties that hold for all models."""

from dataclasses import dataclass, field, replace
from functools import cache

import pytest
import torch

from gscompleter import (
    CompleterConfig,
    GSCompleter,
    InputError,
    load_generator,
    load_ply,
    load_renderer,
)
from gscompleter.apps.inputs.task import Target
from gscompleter.apps.report.completion import write_report
from gscompleter.config import GapConfig
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.generators import GeneratorOutput
from gscompleter.guards.free_space import respect_free_space
from gscompleter.numerics.geometry import adapt_to_mode, pad_camera, project, rotations_to_quats
from gscompleter.render.cpu import CpuRenderer
from gscompleter.stages.hole_masks import compute_hole_mask
from gscompleter.stages.lift import lift_pair
from gscompleter.stages.register import apply_affine
from gscompleter.stages.result import make_unchanged_result
from gscompleter.stages.select_anchor import choose_anchor
from gscompleter.state import Completion
from gscompleter.system.timing import STAGES
from gscompleter.types import Camera, Gaussians, View, make_observed, merge
from knowing_models import KnowingGenerator, KnowingReconstructor, knowing
from parity import assert_close
from scenes import Room, camera_at, gaussians_of, reconstruction_of, scaled, view_of

SIZE = 64


def cameras(unit: float = 1.0):
    """Return two context cameras side by side, and a target to the right that sees a hole."""
    context = [camera_at(x, size=SIZE, unit=unit) for x in (-0.3, 0.1)]
    return context, camera_at(0.7, yaw=12, size=SIZE, unit=unit)


def photographs(unit: float = 1.0) -> list[View]:
    return [view_of(Room(unit=unit), c, i) for i, c in enumerate(cameras(unit)[0])]


class KnowingTogether(KnowingGenerator):
    """The same generator, for two targets at a time."""

    max_batch_size = 2
    supports_padding = True

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[list] = []

    def synthesize(self, requests):
        self.calls.append(list(requests))
        notes = (f"One of {len(requests)}.",)
        return [GeneratorOutput(self(r.nearest, r.target, r.context), notes) for r in requests]


@cache
def completed(config: CompleterConfig) -> Completion:
    """Complete the target by models that know the room."""
    return knowing(config)(photographs(), cameras()[1])


@cache
def completed_by_embedded_models(unit: float) -> Completion:
    """Complete the target by the models that need no weights."""
    return GSCompleter(seed=3)(photographs(unit), cameras(unit)[1])


def tensors(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    names = ("means", "quats", "scales", "opacities", "sh", "generated")
    return {name: getattr(gaussians, name) for name in names}


@pytest.mark.parametrize("config", [CompleterConfig(), CompleterConfig.paper()])
def test_the_hole_closes_and_the_picture_gets_better(config):
    _, target = cameras()
    (result,) = completed(config).targets
    truth = view_of(Room(), target).image
    assert result.hole_fraction > 0.1
    assert compute_hole_mask(result.after.alpha).float().mean() < 0.2 * result.hole_fraction
    assert psnr(result.after.image, truth) > psnr(result.before.image, truth) + 3


@pytest.mark.parametrize("config", [CompleterConfig(), CompleterConfig.paper()])
def test_the_context_is_bit_for_bit_what_it_was(config):
    views, (_, target) = photographs(), cameras()
    scene = KnowingReconstructor()(views).gaussians
    before = {name: tensor.clone() for name, tensor in tensors(scene).items()}
    completion = knowing(config)(views, target, scene)
    assert completion.context is scene
    for name, tensor in tensors(completion.scene).items():
        assert torch.equal(tensor[: len(scene)], before[name]), name
        assert torch.equal(getattr(scene, name), before[name]), name


def test_only_what_was_added_is_marked_as_generated():
    completion = completed(CompleterConfig())
    assert (completion.context.generated == 0).all()
    assert len(completion.added) > 0
    assert (completion.added.generated == 1).all()


def test_the_depth_error_of_the_completed_region_shrinks_through_each_stage():
    """Lifted depths are 20 % short and bumpy: the affine corrects the scale, the rays the bumps."""
    views, (_, target) = photographs(), cameras()
    completion = knowing(replace(CompleterConfig(), margin=0.0))(views, target)
    (result,) = completion.targets
    truth = view_of(Room(), target).depth
    lifted = lift_pair(KnowingReconstructor(), result.reference, views[result.anchor])
    in_hole = result.hole_mask.flatten()[lifted.pixel_index]

    def error(gaussians: Gaussians) -> float:
        pixels, z = project(gaussians.means, target)
        x, y = pixels.long().clamp(0, SIZE - 1).unbind(-1)
        return ((z - truth[y, x]).abs() / truth[y, x]).median().item()

    after_lift = error(lifted.gaussians[in_hole])
    coarse = apply_affine(lifted.gaussians, result.affine, target)
    after_affine = error(coarse[in_hole])
    after_all = error(completion.added)
    assert after_lift > 0.15
    assert after_affine < 0.6 * after_lift
    assert after_all < 0.8 * after_affine


def test_no_photograph_is_matched_worse_than_before():
    completion = completed(CompleterConfig())
    renderer = load_renderer("cpu")
    for view in photographs():
        before = psnr(renderer.render(completion.context, view.camera).image, view.image)
        after = psnr(renderer.render(completion.scene, view.camera).image, view.image)
        assert after >= before - 0.05


def test_several_targets_are_completed_one_after_the_other_into_one_scene():
    views, (_, right) = photographs(), cameras()
    left = camera_at(-0.9, yaw=-12, size=SIZE)
    completion = knowing()(views, [right, left, right])
    assert [set(t.added.generated.tolist()) for t in completion.targets[:2]] == [{1}, {2}]
    assert set(completion.added.generated.tolist()) >= {1, 2}
    again = completion.targets[2]
    assert again.hole_fraction < 0.3 * completion.targets[0].hole_fraction
    assert len(completion.scene) == len(completion.context) + len(completion.added)


def test_a_target_is_widened_only_where_a_hole_reaches_its_edge():
    """A hole that is enclosed by the image needs no padding."""
    # The photographs show what is missing, and would fill it.
    completer = knowing(replace(CompleterConfig(), add_observed=False))
    _, target = cameras()
    wide = completer.pad_target(completer.begin(photographs()), target).padded
    whole = gaussians_of(view_of(Room(), wide))
    x, y = project(whole.means, target)[0].unbind(-1)
    nothing_there = {"middle": ((x - 32).abs() < 8) & ((y - 32).abs() < 8), "edge": x < 8}
    for where, side in {"middle": SIZE, "edge": wide.width}.items():
        completion = completer.begin(photographs(), whole[~nothing_there[where]])
        assert completer.observe(completion, target).camera.padded.width == side
        given = completer.observe(completion, target, view_of(Room(), wide))
        assert given.camera.padded.width == wide.width
        assert completer.advance(completion, target).targets[0].after.image.shape[0] == SIZE


def test_a_hole_is_what_the_target_shows_whatever_its_padding():
    """Beside the image stand Gaussians that are long in depth; a wider image draws them wider."""
    completer = knowing(replace(CompleterConfig(), add_observed=False))
    _, target = cameras()
    whole = gaussians_of(view_of(Room(), pad_camera(target, 0.25).padded))
    left_out = project(whole.means, target)[0][:, 0] < 8
    # 20 % of the width outside of the image, in a column
    y = torch.linspace(-0.6, 0.6, 7)
    points = 2.0 * torch.stack([torch.full_like(y, -0.8), y, torch.ones_like(y)], dim=-1)
    axes = target.c2w[:3, :3]
    long = make_observed(
        target.center + points @ axes.T,
        rotations_to_quats(axes[None]).expand(7, 4),
        torch.tensor([0.1, 0.3, 0.5]).expand(7, 3),
        torch.full((7,), 0.9),
        torch.zeros(7, 1, 3),
    )
    scene = merge([whole[~left_out], long])
    shown = load_renderer("cpu").render(scene, target)

    view = completer.observe(completer.begin(photographs(), scene), target)
    assert view.camera.padded.width > SIZE
    result = make_unchanged_result(view, choose_anchor(view))
    assert_close(result.before.alpha, shown.alpha, "alpha", 1e-5)
    assert_close(result.before.image, shown.image, "image", 1e-5)
    assert torch.equal(result.hole_mask, compute_hole_mask(shown.alpha))
    assert 0.05 < result.hole_fraction < 0.08


@pytest.mark.slow
def test_targets_are_synthesized_together_where_the_generator_can():
    """Each target has a hole at its border, whether or not the ones before are completed.

    So it has the same padding as alone.
    """
    views, (_, target) = photographs(), cameras()
    others = [camera_at(x, yaw=12, size=SIZE) for x in (1.5, 2.3, 2.8)]
    targets = [target, views[0].camera, *others]
    generator = KnowingTogether()
    together = GSCompleter(KnowingReconstructor(), generator)(views, targets)
    assert [len(calls) for calls in generator.calls] == [1, 2, 1]
    assert generator.calls[0][0].target.width > SIZE  # with padding
    renderer, added_to = load_renderer("cpu"), [together.context]
    added_to.append(merge([together.context, together.targets[0].added]))
    added_to.append(merge([added_to[1], *(t.added for t in together.targets[2:4])]))
    for calls, scene in zip(generator.calls, added_to, strict=True):
        for request in calls:
            nearest, wide, context = request.nearest, request.target, request.context
            assert nearest is context.views[1]
            assert_close(context.target_render.alpha, renderer.render(scene, wide).alpha, "alpha")
            for view, seen in zip(context.views, context.view_renders, strict=True):
                assert_close(seen.alpha, renderer.render(scene, view.camera).alpha, "alpha")
    assert [result.notes[:1] for result in together.targets] == [
        ("One of 1.",),
        ("The scene is known at this camera already: nothing to complete.",),
        ("One of 2.",),
        ("One of 2.",),
        ("One of 1.",),
    ]
    one_by_one = knowing()(views, targets)
    assert torch.equal(together.scene.means, one_by_one.scene.means)
    assert torch.equal(together.scene.opacities, one_by_one.scene.opacities)


def test_the_time_of_a_target_that_is_skipped_counts():
    completer = knowing()
    begun = completer.begin(photographs())
    done = completer.advance(begun, photographs()[0].camera)
    assert done.targets[0].skip_reason
    assert done.seconds["total"] > begun.seconds["total"]


def test_numbers_of_targets_go_on_where_the_given_scene_ends():
    first = completed(CompleterConfig())
    second = knowing()(photographs(), camera_at(-0.9, yaw=-12, size=SIZE), first.scene)
    assert set(second.added.generated.tolist()) == {2}
    assert torch.equal(second.scene.generated[: len(first.scene)], first.scene.generated)


def test_a_target_that_is_a_context_view_has_nothing_to_complete():
    views = photographs()
    completion = knowing()(views, views[1].camera)
    assert len(completion.added) == 0
    assert completion.scene is completion.context
    assert "nothing to complete" in completion.targets[0].notes[0]


# `test_results_in_python.py` has the same bytes as a command.
@pytest.mark.slow
def test_with_the_embedded_models_the_same_seed_gives_the_same_bytes():
    views, (_, target) = photographs(), cameras()
    a, b = completed_by_embedded_models(1.0), GSCompleter(seed=3)(views, target)
    for name, tensor in tensors(a.scene).items():
        assert torch.equal(tensor, tensors(b.scene)[name]), name


# `tests/reconstructors/test_plane_sweep.py` scales the unit.
@pytest.mark.slow
@pytest.mark.parametrize("unit", [0.001, 1000.0])
def test_with_the_embedded_models_the_unit_scales_the_result_and_changes_no_image(unit):
    ours, theirs = completed_by_embedded_models(1.0), completed_by_embedded_models(unit)
    (a,), (b,) = ours.targets, theirs.targets
    # Rounding flips a few decisions (1/255 of alpha, the best of near-equal patches); no more.
    assert (a.before.image - b.before.image).abs().mean() < 2e-3
    assert (a.after.image - b.after.image).abs().mean() < 5e-3
    assert abs(a.affine.scale - b.affine.scale) < 1e-2
    depth = (b.after.depth / unit - a.after.depth).abs() / a.after.depth.clamp_min(1e-6)
    assert depth.median() < 1e-3


def test_depth_range_is_found_where_it_is_not_given():
    views = [replace(v, camera=replace(v.camera, near=None, far=None)) for v in photographs()]
    target = replace(cameras()[1], near=None, far=None)
    completion = knowing()(views, target)
    seen = completion.targets[0].target
    assert 0 < seen.near < 2.0
    assert seen.far > 5.0
    brought = KnowingReconstructor()(photographs()).gaussians
    completion = knowing()(views, target, scaled(brought, 1.0))
    assert 0 < completion.targets[0].target.near < 2.0 < 5.0 < completion.targets[0].target.far


def test_bad_input_is_refused_with_a_sentence():
    views, (_, target) = photographs(), cameras()
    with pytest.raises(InputError, match="at least 2"):
        knowing()(views[:1], target)
    with pytest.raises(InputError, match="No target"):
        knowing()(views, [])
    # One target is left, and two are named.
    whole = gaussians_of(views[0])
    numbered = replace(whole, generated=torch.full_like(whole.generated, 253))
    knowing()(views, views[0].camera, numbered)
    with pytest.raises(InputError, match="254"):
        knowing()(views, [views[0].camera] * 2, numbered)
    far_away = gaussians_of(view_of(Room(), camera_at(size=8)))
    behind = replace(far_away, means=far_away.means - torch.tensor([0.0, 0.0, 100.0]))
    views = [replace(v, camera=replace(v.camera, near=None)) for v in views]
    with pytest.raises(InputError, match="No context camera sees the scene"):
        knowing()(views, target, behind)


def test_a_call_is_a_beginning_and_a_step_for_each_target():
    views, (_, target) = photographs(), cameras()
    targets = [target, camera_at(-0.9, yaw=-12, size=SIZE)]
    begun = knowing().begin(views)
    assert begun.scene is begun.context
    assert begun.targets == ()
    stepwise = begun
    for camera in targets:
        stepwise = knowing().advance(stepwise, camera)
    at_once = knowing()(views, targets)
    for name, tensor in tensors(at_once.scene).items():
        assert torch.equal(tensor, getattr(stepwise.scene, name)), name
    assert set(stepwise.seconds) == {*STAGES, "total"}


def test_undo_is_to_go_on_from_the_former_state():
    views, (_, target) = photographs(), cameras()
    begun = knowing().begin(views)
    before = {name: tensor.clone() for name, tensor in tensors(begun.scene).items()}
    first = knowing().advance(begun, target)
    assert len(first.scene) > len(begun.scene)
    for name, tensor in tensors(begun.scene).items():
        assert torch.equal(tensor, before[name]), name
    again = knowing().advance(begun, target)
    for name, tensor in tensors(first.scene).items():
        assert torch.equal(tensor, getattr(again.scene, name)), name


@dataclass(frozen=True)
class Counting(CpuRenderer):
    """A renderer that remembers the cameras at which a scene was frozen."""

    frozen: list[Camera] = field(default_factory=list)

    def freeze(self, context, camera):
        self.frozen.append(camera)
        return super().freeze(context, camera)


def test_photographs_are_frozen_once_however_many_targets_there_are():
    """Additions extend the frozen scenes; such small photographs are not shrunk further."""
    views, (_, target) = photographs(), cameras()
    targets = [target, camera_at(-0.9, yaw=-12, size=SIZE)]
    renderer = Counting()
    completer = replace(knowing(), renderer=renderer)
    begun = completer.begin(views)
    first = completer.advance(begun, targets[0])
    second = completer.advance(first, targets[1])
    assert len(second.scene) > len(first.scene) > len(begun.scene)
    for view in begun.views:
        assert sum(torch.equal(c.c2w, view.camera.c2w) for c in renderer.frozen) == 1


@pytest.mark.slow
def test_a_completer_that_kept_views_of_another_state_gives_the_same_bytes():
    views, (_, target) = photographs(), cameras()
    other = camera_at(-0.9, yaw=-12, size=SIZE)
    completer = knowing()
    begun = completer.begin(views)
    first = completer.advance(begun, target)  # without any view that was kept
    second = completer.advance(first, other)
    for ours, truth in (
        (second, knowing().advance(first, other)),
        (completer.advance(begun, target), first),
        (completer.advance(begun, other), knowing().advance(begun, other)),
    ):
        for name, tensor in tensors(truth.scene).items():
            assert torch.equal(tensor, getattr(ours.scene, name)), name


def test_a_generator_that_takes_no_margin_is_asked_for_the_target_itself():
    views, (_, target) = photographs(), cameras()
    truth = view_of(Room(), target)
    oracle = load_generator("oracle", photographs=[truth])
    completion = GSCompleter(KnowingReconstructor(), oracle)(views, target)
    assert torch.equal(completion.targets[0].reference.image, truth.image)
    assert len(completion.added) > 0


class Mistaken(KnowingTogether):
    """Φ whose image is inconsistent with the photographs, and that reports it."""

    def synthesize(self, requests):
        said = "It is another room."
        return [
            GeneratorOutput(1 - answer.image, (said,), is_inconsistent=True)
            for answer in super().synthesize(requests)
        ]


def test_what_the_photographs_contradict_is_reported_and_not_added():
    context, target = photographs(), cameras()[1]
    completer = GSCompleter(KnowingReconstructor(), Mistaken())
    refused = completer(context, target)
    (result,) = refused.targets
    assert len(refused.added) == len(result.added) == 0
    assert result.notes[:2] == ("It is another room.", "Nothing of it was added.")
    assert "stay" in result.notes[2]  # the hole, and the step that left it open
    assert result.reference is not None
    assert torch.equal(result.after.image, result.before.image)


class Confused(KnowingReconstructor):
    """Ψ whose depths of a synthesized image have nothing to do with the room."""

    def __call__(self, views):
        random = torch.Generator().manual_seed(1)
        depths = []
        for view in views:
            depth = view_of(Room(), view.camera).depth
            unlike = 0.5 * 40 ** torch.rand(depth.shape, generator=random)
            depths.append(unlike if view.frame is None else depth)
        return reconstruction_of(views, depths)


def test_depths_that_the_scene_contradicts_are_reported_and_not_added(tmp_path):
    context, target = photographs(), cameras()[1]
    completer = GSCompleter(Confused(), KnowingGenerator())
    refused = completer(context, target)
    (result,) = refused.targets
    assert len(refused.added) == len(result.added) == 0
    assert result.rejection.guard == "depth-agreement"
    assert torch.equal(result.after.image, result.before.image)
    summary = write_report(tmp_path, refused, [Target(target)], completer.renderer, {})
    (said,) = summary["targets"]
    assert said["added"] == 0
    assert said["affine"]["agreement"] < 0.1
    assert "of the scene that the target sees agrees with the depths of the" in said["notes"][0]
    assert "Nothing of it was added." in said["notes"]


# The configuration of the paper has no guards: `test_dynamic_masks.py`.
@pytest.mark.slow
@pytest.mark.parametrize(
    "models", [(KnowingReconstructor(), Mistaken()), (Confused(), KnowingGenerator())]
)
def test_the_paper_adds_what_is_contradicted(models):
    completer = GSCompleter(*models, config=CompleterConfig.paper())
    assert len(completer(photographs(), cameras()[1]).added) > 0


def test_a_splat_is_not_compared_in_depth():
    """Right depths differ from it in wrong places."""
    context, target = photographs(), cameras()[1]
    completer = GSCompleter(Confused(), KnowingGenerator())
    scene = completer.begin(context).context
    # The test before has a scene that is not the user's.
    (result,) = completer(context, target, scene, []).targets
    assert result.rejection.guard != "depth-agreement"
    assert result.affine.agreement < 0.1


def test_depths_that_are_a_little_wrong_are_mended_and_added():
    (result,) = completed(CompleterConfig()).targets
    assert not result.rejection.guard
    assert result.affine.agreement > 0.5
    assert len(result.added) > 0


def test_nothing_is_added_before_what_an_earlier_target_sees(monkeypatch):
    asked = []

    def told(candidates, target, cameras, *rest):
        asked.append([camera.center for camera in cameras])
        return respect_free_space(candidates, target, cameras, *rest)

    monkeypatch.setattr("gscompleter.guards.free_space.respect_free_space", told)
    first, second = cameras()[1], camera_at(-0.9, yaw=-12, size=SIZE)
    without_gaps = replace(CompleterConfig(), gaps=GapConfig(displacement=0.0))
    knowing(without_gaps)(photographs(), [first, second])
    assert [len(centers) for centers in asked] == [2, 3]
    assert torch.equal(asked[1][2], first.center)


@cache
def antialiased_room() -> Gaussians:
    """Reconstruct the photographs as Gaussians for antialiased rendering."""
    mode = replace(gaussians_of(photographs()[0])[:0], is_antialiased=True)
    return merge([adapt_to_mode(mode, gaussians_of(v), v.camera) for v in photographs()])


def test_what_was_made_for_classic_rendering_covers_as_much_antialiased():
    """Compare the image sums of single Gaussians, small ones and large ones."""
    view, renderer = photographs()[0], load_renderer("cpu")
    made = gaussians_of(view)[SIZE * SIZE // 2 + SIZE // 2 :][:1]
    for factor, most in ((0.1, 0.2), (1.0, 0.7), (5.0, 0.98)):
        sized = replace(made, scales=factor * made.scales)
        marked = replace(sized, is_antialiased=True)
        same = adapt_to_mode(marked[:0], sized, view.camera)
        truth, ours, less = (
            renderer.render(gaussians, view.camera).alpha.sum()
            for gaussians in (sized, same, marked)
        )
        assert less < most * truth
        assert ours == pytest.approx(truth.item(), rel=0.05)
        assert adapt_to_mode(sized[:0], sized, view.camera) is sized
        assert adapt_to_mode(marked[:0], marked, view.camera) is marked


# `test_what_was_made_for_classic_rendering_covers_as_much_antialiased` has such a scene.
@pytest.mark.slow
@pytest.mark.parametrize("doubted", [False, True])
def test_an_antialiased_scene_is_completed_as_one(tmp_path, doubted):
    """It scores like the classic one of the same room, up to its wider low-pass filter."""
    views, target = photographs(), cameras()[1]
    witnesses = [view_of(Room(), camera_at(-0.1, size=SIZE))] if doubted else None
    scene, truth = antialiased_room(), view_of(Room(), target).image
    done = knowing()(views, target, scene, witnesses)
    (result,) = done.targets
    holes = result.hole_mask
    assert 0.1 < holes.float().mean() < 0.7
    assert result.after.alpha[holes].mean() > 0.9
    before, after = (
        psnr(r.image[holes][None], truth[holes][None]) for r in (result.before, result.after)
    )
    assert after > before + 5
    assert after > 17
    assert done.scene.is_antialiased
    drawn = load_renderer("cpu").render(done.scene, target)
    assert_close(drawn.image, result.after.image, "image", 1e-5)
    write_report(tmp_path, done, [Target(target)], knowing().renderer, {})
    for name in ("context.ply", "completed.ply", "generated.ply"):
        assert load_ply(tmp_path / name).is_antialiased, name


BEHIND = camera_at(0.0, yaw=180, size=SIZE)
FAR_AWAY = camera_at(0.0, z=-1000.0, size=SIZE)


@pytest.mark.parametrize(
    "config", [CompleterConfig(), pytest.param(CompleterConfig.paper(), marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("target", [BEHIND, FAR_AWAY], ids=["turned away", "far away"])
def test_a_target_that_sees_nothing_of_the_scene_is_refused(target, config):
    views, (_, beside) = photographs(), cameras()
    completer = knowing(config)
    with pytest.raises(InputError, match=r"sees surfaces of the scene in 0\.\d%"):
        completer(views, target)
    done = completer(views, [target, beside])
    refused, completed = done.targets
    assert refused.notes == (refused.refusal,)
    assert "at least 2% are needed" in refused.refusal
    assert len(refused.added) == 0
    assert completed.refusal is None
    assert len(completed.added) > 0


def test_photographs_without_texture_are_refused():
    blank = torch.full((SIZE, SIZE, 3), 0.6)
    ramp = blank * torch.linspace(0.8, 1.0, SIZE)[:, None]
    noise = 0.004 * torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    for image in (blank, ramp, blank + noise):
        views = [View(image, camera_at(x, size=SIZE)) for x in (0.0, 0.3)]
        with pytest.raises(InputError, match="2 of the 2 context photographs show no texture"):
            GSCompleter()(views, camera_at(0.6, size=SIZE))


def test_texture_that_is_ignored_is_none():
    """Features are looked for outside of ignored pixels alone."""
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in (0.0, 0.3)]
    rows = torch.arange(SIZE)[:, None].expand(-1, SIZE)
    shown = [
        replace(
            view,
            image=view.image.where(rows[..., None] > SIZE // 2, 0.6),
            ignore_mask=rows > SIZE // 3,
        )
        for view in views
    ]
    with pytest.raises(InputError, match="2 of the 2 context photographs show no texture"):
        GSCompleter()(shown, camera_at(0.6, size=SIZE))


def test_no_photograph_is_refused_with_a_scene_and_without():
    for scene in (None, gaussians_of(view_of(Room(), camera_at(size=SIZE)))):
        with pytest.raises(InputError, match="No context view was given; name at least one"):
            GSCompleter()([], camera_at(0.6, size=SIZE), scene)
