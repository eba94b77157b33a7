"""Removal of Gaussians from a begun completion."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from copies import watch_copies
from gscompleter import GSCompleter
from gscompleter.config import CompleterConfig
from gscompleter.editing import removal
from gscompleter.editing.cutting import cut
from gscompleter.editing.removal import (
    MAX_LAYERS,
    MIN_REVEALED,
    MIN_SHOWN_BEFORE,
    find_outside,
    find_revealed,
    remove_gaussians,
    restore_surroundings,
)
from gscompleter.evaluation.verdict.held_out import render_before_after
from gscompleter.guards import load_guards
from gscompleter.guards.free_space import Observed, ignore_removed, is_before_surface
from gscompleter.numerics.image_ops import dilate
from gscompleter.parts import NOT_INVENTED
from gscompleter.planning.remove import contain_nothing
from gscompleter.render.fit_colors import fit_colors
from gscompleter.render.loading import load_renderer
from gscompleter.render.removed import find_removed
from gscompleter.state import Completion
from gscompleter.system.errors import InputError
from gscompleter.system.files.mapping import is_mapped, move_to_file
from gscompleter.trust.photometric import PhotoObservations, gather_observations, load_trust
from gscompleter.types import Gaussians, make_observed, merge, sh_from_rgb
from scenes import Room, camera_at, gaussians_of, view_of

ROOM = Room()
EMPTY = Room((ROOM.boxes[0], ROOM.boxes[2]))
CAMERAS = [camera_at(x, yaw=yaw, size=48) for x, yaw in ((-0.4, 4), (0.0, 0), (0.4, -4))]
COMPLETER = GSCompleter(config=CompleterConfig.splat().for_removal())


def is_crate(points: torch.Tensor) -> torch.Tensor:
    """Find points on the box in the middle of the room."""
    low, high = (torch.tensor(corner) for corner in ROOM.boxes[1])
    return ((points > low - 0.05) & (points < high + 0.05)).all(-1) & (points[:, 1] < 1.45)


def make_junk() -> Gaussians:
    """Make an opaque blob inside of the box, which no photograph shows."""
    points = torch.tensor([[-0.1, 0.9, 2.6], [-0.1, 0.7, 2.6], [-0.1, 1.1, 2.6]])
    scales, opacities = torch.full((3, 3), 0.1), torch.full((3,), 0.95)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1)
    return make_observed(points, quats, scales, opacities, sh_from_rgb(torch.ones(3, 3)))


@pytest.fixture(scope="module")
def begun() -> Completion:
    views = [view_of(ROOM, camera) for camera in CAMERAS]
    scene = merge([*map(gaussians_of, views), make_junk()])
    return COMPLETER.begin(views, scene, [])


def choose_surface(begun: Completion) -> torch.Tensor:
    """Choose the box without the junk inside of it."""
    chosen = is_crate(begun.context.means)
    chosen[-3:] = False
    return chosen


@pytest.fixture(scope="module")
def removed(begun) -> Completion:
    return remove_gaussians(begun, choose_surface(begun), is_crate, COMPLETER.scenes)


def test_the_chosen_are_gone_and_so_is_what_only_they_hid(begun, removed):
    source, chosen = removed.source, choose_surface(begun)
    assert torch.equal(source.chosen_mask, chosen)
    assert source.revealed_mask[-3:].all()
    assert not (source.chosen_mask & source.revealed_mask).any()
    assert source.proxy_index.min() >= 0
    assert source.gone_mask.sum() < chosen.sum() + 0.05 * len(chosen)
    assert removed.context is begun.context
    left = begun.context[~source.gone_mask]
    assert torch.equal(removed.scene.means[: len(left)], left.means)
    assert (removed.scene.generated[len(left) :] == NOT_INVENTED).all()
    assert torch.equal(source.rendered.means, left.means)
    assert torch.equal(source.expand(source.rendered.opacities)[chosen], torch.zeros(chosen.sum()))
    assert not removed.recolored_mask.any()


def test_photographs_are_ignored_where_they_show_the_chosen(begun, removed):
    for camera, photo, before in zip(CAMERAS, removed.photos, begun.photos, strict=True):
        shown = view_of(ROOM, camera).depth < view_of(EMPTY, camera).depth - 0.01
        ignored = photo.view.ignore_mask
        assert ignored[shown].float().mean() > 0.97
        assert ignored.float().mean() < shown.float().mean() + 0.15
        same = (photo.view.image == before.view.image).all(-1)
        assert torch.equal(same | ignored, torch.ones_like(same))
        assert (~same)[shown].float().mean() > 0.9
        assert photo.budgets[0].limit < before.budgets[-2].limit


def test_nothing_is_added_outside_of_the_hole(removed):
    view = COMPLETER.observe(removed, camera_at(0.1, size=48))
    everywhere = gaussians_of(view_of(EMPTY, view.camera.padded))
    (guard,) = [guard for guard in load_guards(removed.config) if guard.name == "removal"]
    placed = guard.place(everywhere, view)
    shown = view_of(ROOM, view.camera.padded).depth < view_of(EMPTY, view.camera.padded).depth
    assert 0 < len(placed) < 0.35 * len(everywhere)
    assert len(placed) >= 0.95 * shown.sum()


def test_a_masked_photograph_can_be_a_target(begun, removed):
    before, after = (COMPLETER.advance(state, CAMERAS[1]) for state in (begun, removed))
    assert (
        before.targets[0].skip_reason
        == "The scene is known at this camera already: nothing to complete."
    )
    assert len(after.targets[0].added) > 0
    assert after.targets[0].hole_fraction > 0.02


def test_what_photographs_need_elsewhere_returns(begun):
    """A large Gaussian behind the wall shines through it and fills the hole as well."""
    glow = make_observed(
        torch.tensor([[0.0, 0.8, 5.6]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[3.0, 3.0, 0.1]]),
        torch.tensor([0.99]),
        sh_from_rgb(torch.tensor([[1.0, 0.2, 0.2]])),
    )
    thin = replace(begun.context, opacities=0.4 * begun.context.opacities)
    scene = merge([thin, glow])
    views = [
        replace(view, image=COMPLETER.renderer.render(scene, view.camera).image.clamp(0, 1))
        for view in begun.views
    ]
    state = COMPLETER.begin(views, scene, [])
    chosen = is_crate(scene.means)
    state = remove_gaussians(state, chosen, is_crate, COMPLETER.scenes)
    hidden = replace(
        state.source,
        rendered=state.rendered_context[:-1],
        proxy_index=state.source.proxy_index.clamp_max(len(state.rendered_context) - 2),
        revealed_mask=state.source.revealed_mask | (torch.arange(len(scene)) == len(scene) - 1),
    )
    # The trust of a splat has values for the rows that are there before any returns.
    views = [photo.view for photo in state.photos]
    trust = load_trust(CompleterConfig.splat(), (hidden.rendered,), views, COMPLETER.scenes)
    state = replace(
        state,
        source=hidden,
        rendered_context=hidden.rendered,
        added_parts=(),
        trust_elsewhere=trust,
    )
    restored = restore_surroundings(state, COMPLETER.scenes)
    assert restored.source.stand_ins[-1] == len(restored.rendered_context) - 1
    assert torch.equal(restored.scene.means[-1], glow.means[0])
    assert not restored.source.gone_mask[-1]
    assert torch.equal(restored.source.chosen_mask, chosen)
    assert restore_surroundings(begun, COMPLETER.scenes) is begun
    # Once more, colours would change again; after a further target or removal, they have to.
    assert restore_surroundings(restored, COMPLETER.scenes) is restored
    further = COMPLETER.advance(restored, CAMERAS[1])
    again = remove_gaussians(restored, chosen, is_crate, COMPLETER.scenes)
    assert restored.is_restored
    assert not further.is_restored
    assert not again.is_restored
    assert len(again.trust_elsewhere.observations.means) == len(trust.observations.means)


@pytest.mark.linux
def test_what_is_as_large_as_a_scene_in_a_file_lies_in_files(begun, tmp_path, monkeypatch):
    """Frozen views, and what is left: three gigabytes of four million Gaussians."""
    seen = []

    def watch(added, context, images, gains):
        seen.extend(context)
        return fit_colors(added, context, images, gains)

    monkeypatch.setattr(removal, "fit_colors", watch)
    plain = begun.context
    results = []
    for scene in (plain, replace(plain, sh=move_to_file(plain.sh, tmp_path))):
        completer = GSCompleter(config=CompleterConfig.splat().for_removal())
        state = completer.begin([photo.view for photo in begun.photos], scene, [])
        state = remove_gaussians(state, choose_surface(begun), is_crate, completer.scenes)
        results.append((state, restore_surroundings(state, completer.scenes)))
    (kept, expected), (state, restored) = results
    assert all(is_mapped(view.layer.splats.base) for view in seen[len(seen) // 2 :])
    assert not any(isinstance(view.layer.splats.base, torch.Tensor) for view in seen[:1])
    for each, other in ((state, kept), (restored, expected)):
        assert is_mapped(each.rendered_context.sh)
        assert torch.equal(each.scene.sh, other.scene.sh)
        assert torch.equal(each.scene.opacities, other.scene.opacities)


def test_what_shows_in_the_hole_alone_does_not_return(removed):
    views = [photo.view for photo in removed.photos]
    wall = removed.context[~removed.source.gone_mask][::50]
    scene = removed.scene
    frozen = [COMPLETER.renderer.freeze(scene, view.camera) for view in views]
    found = find_outside(merge([make_junk(), wall]), frozen, views)
    assert not found[:3].any()
    assert found[3:].float().mean() > 0.5


def find_revealed_plainly(
    state: Completion, unused: torch.Tensor, inner: Gaussians, outer: Gaussians
) -> torch.Tensor:
    """Draw all that is left at all photographs after each layer; return what is gone."""
    whole = merge([state.rendered_context.hide(unused), inner, outer])
    gone = torch.cat([unused, torch.ones(len(inner)).bool(), torch.zeros(len(outer)).bool()])
    views = [photo.view for photo in state.photos]

    def observe(left: torch.Tensor) -> PhotoObservations:
        scene = whole[left]
        frozen = [COMPLETER.renderer.freeze(scene, view.camera) for view in views]
        return gather_observations(scene, views, frozen, state.config.trust_settings)

    before = observe(torch.ones_like(gone))
    confirmed = (before.areas * before.agreement).amax(dim=0)
    for _ in range(MAX_LAYERS):
        areas = torch.zeros_like(before.areas)
        areas[:, ~gone] = observe(~gone).areas
        revealed = (areas - before.areas).amax(dim=0) > MIN_REVEALED * areas.amax(dim=0)
        gone = gone | (revealed & (confirmed < MIN_SHOWN_BEFORE * areas.amax(dim=0)))
    return gone


def test_what_is_revealed_is_what_is_seen_anew_with_everything_drawn_again(begun):
    """Walls behind walls: each layer comes to light after the one in front of it."""
    room = begun.context
    layers = [
        replace(room, means=factor * room.means, scales=factor * room.scales)
        for factor in (1.0, 1.1, 1.2)
    ]
    state = COMPLETER.begin([photo.view for photo in begun.photos], merge(layers), [])
    scene = state.rendered_context
    unused = is_crate(scene.means)
    inner, outer = cut(scene[unused], is_crate)
    gone, is_outer_revealed = find_revealed(state, unused, inner, outer, COMPLETER.scenes)
    expected = find_revealed_plainly(state, unused, inner, outer)
    assert torch.equal(gone, expected[: len(scene)])
    assert torch.equal(is_outer_revealed, expected[len(expected) - len(outer) :])
    assert len(outer) > 0
    assert (gone & ~unused)[len(begun.context) :].sum() > 10


# The slow renderer draws few pixels.
@pytest.mark.parametrize(("name", "size"), [("cpu", 48), ("reference", 12)])
def test_what_is_left_is_drawn_without_copying_it(removed, monkeypatch, name, size):
    camera = camera_at(-0.4, yaw=4, size=size)
    renderer = load_renderer(name)
    first = removed.rendered_context
    is_dyed = first.means[:, 0] < 0
    dyed = replace(first, sh=first.sh + 0.3 * is_dyed[:, None, None])
    state = replace(removed, rendered_context=dyed)
    expected = renderer.render(state.scene, camera)
    num_recolored = len(state.recolored)
    assert 0 < num_recolored < len(first)
    copied = watch_copies(monkeypatch)
    pair = render_before_after(state, camera, renderer)
    # The slow renderer joins what it freezes.
    assert name == "reference" or sum(copied) == 0
    assert torch.equal(pair.before.image, renderer.render(state.context, camera).image)
    # The slow renderer may sum in another order.
    largest = float(expected.image.max())
    bound = 0.0 if name == "cpu" else 1e-6 * largest
    assert float((pair.after.image - expected.image).abs().max()) <= bound
    assert not torch.equal(pair.after.image, pair.before.image)


def test_space_in_which_something_was_removed_is_not_free(removed, begun):
    camera = CAMERAS[0]
    behind = COMPLETER.renderer.render(gaussians_of(view_of(EMPTY, camera)), camera)
    points = removed.source.removed.means
    for state, expected in (begun, 1.0), (removed, 0.0):
        seen = ignore_removed(behind, camera, COMPLETER.observe(state, camera))
        share = is_before_surface(points, Observed.from_render(seen, camera, camera)).float().mean()
        assert share == pytest.approx(expected, abs=0.05)
    beside = find_removed(removed.source, camera, COMPLETER.renderer).logical_not()
    assert torch.equal(seen.alpha[beside], behind.alpha[beside])


def measure_errors(state: Completion, scene: Gaussians) -> list[float]:
    """Return the mean difference of each photograph to a render around the crate."""
    errors = []
    for camera, photo in zip(CAMERAS, state.photos, strict=True):
        around = ~dilate(view_of(ROOM, camera).depth < view_of(EMPTY, camera).depth - 0.01, 3)
        image = COMPLETER.renderer.render(scene, camera).image
        errors.append((image - photo.view.image)[around].abs().mean().item())
    return errors


def test_what_reaches_out_of_the_place_stays_and_additions_match_photographs(begun):
    """A large disc in front of the crate is a stain on the walls beside it, too."""
    stain = make_observed(
        torch.tensor([[-0.1, 0.8, 2.17]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[0.5, 0.5, 0.01]]),
        torch.tensor([0.5]),
        sh_from_rgb(torch.tensor([[1.0, 0.2, 0.2]])),
    )
    scene = merge([begun.context, stain])
    views = [
        replace(view, image=COMPLETER.renderer.render(scene, view.camera).image.clamp(0, 1))
        for view in begun.views
    ]
    state = COMPLETER.begin(views, scene, [])
    cut, uncut = (
        remove_gaussians(state, is_crate(scene.means), region, COMPLETER.scenes)
        for region in (is_crate, lambda points: torch.zeros(len(points), dtype=torch.bool))
    )
    pairs = zip(*(measure_errors(state, each.scene) for each in (cut, uncut)), strict=True)
    assert all(less < 0.5 * more for less, more in pairs)
    assert set(cut.added.generated.tolist()) == {NOT_INVENTED}
    assert [part.origin.kind for part in cut.added_parts] == ["piece"]
    dyed = replace(cut.added, sh=cut.added.sh - 0.5)
    dyed = replace(cut, added_parts=(replace(cut.added_parts[0], gaussians=dyed),))
    restored = restore_surroundings(dyed, COMPLETER.scenes)
    before, after = measure_errors(state, dyed.scene), measure_errors(state, restored.scene)
    assert max(after) < 0.7 * max(before)


def test_something_has_to_be_left(begun):
    everything = torch.ones(len(begun.context), dtype=torch.bool)
    with pytest.raises(InputError, match="Nothing would be left"):
        remove_gaussians(begun, everything, is_crate, COMPLETER.scenes)


@pytest.mark.parametrize("has_photographs", [False, True])
def test_photographs_decide_whether_what_stands_behind_a_mark_is_a_hole(has_photographs):
    """The wall behind the box is in the splat, as the photographs beside it show it."""
    views = [view_of(ROOM, camera_at(x, size=48)) for x in (-0.8, 0.0, 0.8)]
    config = CompleterConfig.splat()
    config = (config.for_photographs() if has_photographs else config).for_marks()
    completer = GSCompleter(config=config)
    begun = completer.begin(views, merge([gaussians_of(view) for view in views]), [])
    chosen = is_crate(begun.context.means)
    marked = remove_gaussians(begun, chosen, contain_nothing, completer.scenes)

    target = camera_at(0.0, size=48)
    view = completer.observe(marked, target)
    shown = view_of(ROOM, target).depth < view_of(EMPTY, target).depth - 0.01
    known = view.render.alpha > 0.95
    depth = view_of(EMPTY, view.camera.padded).depth
    wall = view.camera.crop(known & ((view.render.depth - depth).abs() < 0.1 * depth)) & shown
    assert wall.float().sum() > 0.2 * shown.sum()
    is_hole = view.camera.crop(view.holes)[wall].float().mean()
    assert is_hole < 0.3 if has_photographs else is_hole > 0.9
    # What no photograph sees behind the box is a hole in any case.
    assert view.camera.crop(view.holes & ~known)[shown].any()
