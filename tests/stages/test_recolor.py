"""Stage 4, second form: covered but not trusted Gaussians get new colours by direction."""

from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize, pad

from copies import watch_copies
from gscompleter.config import CompleterConfig, RecolorConfig
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.cpu import CpuRenderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.spherical_harmonics import evaluate_sh_basis
from gscompleter.stages.recolor import fit_image_colors
from gscompleter.trust import HeldViews
from gscompleter.trust.photometric import load_trust, sum_weights
from gscompleter.types import ContextScene, View, merge
from scenes import Room, camera_at, gaussians_of, view_of
from target_views import begin_with

SIZE = 40
ROOM = Room()
RENDERER = load_renderer("cpu")
PHOTOS = [view_of(ROOM, camera_at(x, yaw=yaw, size=SIZE)) for x, yaw in ((0, 0), (0.3, -5))]
TARGET = camera_at(x=1.6, yaw=-25, size=SIZE)
NEXT = camera_at(x=-1.6, yaw=25, size=SIZE)
LEFT = torch.zeros(SIZE, SIZE)
LEFT[:, : SIZE // 2] = 1
CONFIG = RecolorConfig(min_change=1 / 255)


def splat(k: int = 16):
    """Return the room as its first photograph shows it, with k harmonics."""
    scene = gaussians_of(PHOTOS[0])
    return replace(scene, sh=pad(scene.sh, (0, 0, 0, k - 1)))


def hold(scene, config=CONFIG) -> HeldViews:
    settings = replace(CompleterConfig.splat(), recolor=config)
    return load_trust(settings, (scene,), PHOTOS, SceneRenderer(RENDERER)).held


def darker(scene, camera) -> View:
    """Synthesize the scene with half of its light."""
    return View(0.5 * RENDERER.render(scene, camera).image, camera)


def recolored(scene, camera=TARGET, weight=LEFT, held=None, config=CONFIG, renderer=RENDERER):
    held = hold(scene, config) if held is None else held
    frozen, wanted = renderer.freeze(scene, camera), darker(scene, camera)
    scenes = SceneRenderer(renderer)
    return fit_image_colors((scene,), frozen, wanted, weight, held, scenes, config)


def change(scene, **kwargs):
    """Recolour a scene."""
    rows, delta = recolored(scene, **kwargs)
    return replace(scene, sh=scene.sh.index_add(0, rows, delta))


def move(scene, after, camera) -> torch.Tensor:
    """Compute how far the image of a camera changes."""
    images = [RENDERER.render(state, camera).image for state in (scene, after)]
    return (images[1] - images[0]).abs().mean(dim=2)


def iterate_in_full(scene, camera, weight, config):
    """Solve all harmonics of all Gaussians at once in each iteration, view by view."""
    frozen, wanted = RENDERER.freeze(scene, camera), darker(scene, camera).image
    centers = [*(view.camera.center for view in PHOTOS), camera.center]
    bases = [evaluate_sh_basis(normalize(scene.means - c, dim=-1), 16).double() for c in centers]
    sums = [sum_weights(RENDERER.freeze(scene, view.camera)).double() for view in PHOTOS]
    sums.append(sum_weights(frozen).double())
    matrix = config.ridge * torch.eye(16).double() * sum(sums)[:, None, None].clamp_min(1e-9)
    sums = [*(config.hold_weight * each for each in sums[:-1]), sums[-1]]
    for basis, each in zip(bases, sums, strict=True):
        matrix += each[:, None, None] * basis[:, :, None] * basis[:, None, :]
    delta, render = torch.zeros_like(scene.sh).double(), frozen.render.image
    for _ in range(config.iterations):
        state = RENDERER.freeze(replace(scene, sh=scene.sh + delta.float()), camera)
        missing = weight[..., None] * (wanted - render) + render - state.render.image
        at_target = torch.einsum("nk,nkc->nc", bases[-1], delta)
        right = state.backproject(missing).double() + sums[-1][:, None] * at_target
        delta = torch.linalg.solve(matrix, bases[-1][:, :, None] * right[:, None])
    return delta


def test_the_image_follows_the_synthesized_one_where_its_weight_is_one():
    scene = splat()
    after = change(scene)
    wanted = darker(scene, TARGET).image
    image = RENDERER.render(after, TARGET).image
    before = RENDERER.render(scene, TARGET).image
    inner = LEFT.bool() & (RENDERER.render(scene, TARGET).alpha > 0.9)
    inner[:, SIZE // 2 - 3 :] = False
    assert (image - wanted)[inner].abs().mean() < 0.5 * (before - wanted)[inner].abs().mean()
    assert move(scene, after, TARGET)[:, SIZE // 2 + 3 :].max() < 2 * CONFIG.min_change


def test_the_photographs_keep_their_colours():
    scene = splat()
    free = HeldViews(torch.zeros(0, 3), torch.zeros(0, len(scene)), torch.zeros(0))
    for view in PHOTOS:
        held = move(scene, change(scene), view.camera).mean()
        loose = move(scene, change(scene, held=free), view.camera).mean()
        assert held < 0.004
        assert loose > 10 * held


def test_it_equals_the_iteration_over_all_harmonics():
    scene, everywhere = splat(), torch.ones(SIZE, SIZE)
    rows, found = recolored(scene, weight=everywhere)
    delta = iterate_in_full(scene, TARGET, everywhere, CONFIG)
    assert len(rows) > 500
    assert (found - delta[rows]).abs().max() < 1e-3
    basis = evaluate_sh_basis(normalize(scene.means - TARGET.center, dim=-1), 16).double()
    others = torch.ones(len(scene), dtype=torch.bool)
    others[rows] = False
    seen = torch.einsum("nk,nkc->nc", basis, delta)[others]
    assert seen.abs().max() < 1.02 * CONFIG.min_change


def test_only_colours_of_covering_gaussians_change():
    scene = splat()
    rows, _ = recolored(scene)
    after = change(scene)
    covers = RENDERER.freeze(scene, TARGET).backproject(LEFT[..., None].expand(-1, -1, 3))[:, 0] > 0
    assert covers[rows].all()
    others = torch.ones(len(scene), dtype=torch.bool)
    others[rows] = False
    assert torch.equal(after.sh[others], scene.sh[others])
    assert (after.sh != scene.sh).any(dim=(1, 2)).sum() == len(rows) > 0


@pytest.mark.parametrize(
    ("weight", "config"), [(0 * LEFT, CONFIG), (LEFT, replace(CONFIG, iterations=0))]
)
def test_full_trust_or_no_iteration_changes_nothing(weight, config):
    scene = splat()
    rows, delta = recolored(scene, weight=weight, config=config)
    assert len(rows) == len(delta) == 0


@pytest.mark.parametrize("k", [1, 4, 9])
def test_the_degree_of_the_scene_is_kept(k):
    """A colour without direction moves only as far as the photographs let it."""
    scene = splat(k)
    after = change(scene)
    assert after.sh.shape[1] == k
    full = move(splat(), change(splat()), TARGET).mean()
    seen = move(scene, after, TARGET).mean()
    assert 0 < seen <= 1.01 * full
    assert k > 1 or seen < 0.5 * full


def test_the_next_target_keeps_what_the_last_one_changed():
    scene = splat()
    held = hold(scene)
    after = change(scene, held=held)
    both = held.add(TARGET, sum_weights(RENDERER.freeze(after, TARGET)))
    assert len(both.centers) == len(both.sums) == len(PHOTOS) + 1
    kept, lost = (
        move(after, change(after, camera=NEXT, held=views), TARGET).mean() for views in (both, held)
    )
    assert kept < 0.9 * lost


def test_a_smaller_change_than_the_least_is_not_made():
    scene = splat()
    coarse = replace(CONFIG, min_change=0.1)
    many, few = (set(recolored(scene, config=c)[0].tolist()) for c in (CONFIG, coarse))
    assert 0 < len(few) < len(many)
    assert few < many


def test_photographs_are_held_by_their_summed_weights():
    scene = splat()
    held = hold(scene, RecolorConfig(hold_weight=7.0))
    assert (held.weights == 7).all()
    for view, sums in zip(PHOTOS, held.sums, strict=True):
        expected = sum_weights(RENDERER.freeze(scene, view.camera))
        assert torch.allclose(sums, expected, rtol=1e-4, atol=1e-4)


def test_what_stays_is_drawn_and_not_copied(monkeypatch):
    """A scene without the Gaussians that change was as large as the scene itself."""
    scene = splat()
    held = hold(scene)
    copied = watch_copies(monkeypatch)
    rows, _ = recolored(scene, held=held)
    # What may change alone; here that is less than a half.
    assert len(rows) > 0
    assert 0 < sum(copied) < 0.5 * len(scene)


class Merging(SceneRenderer):
    """Draws a scene as one, of which all are copies."""

    def freeze(self, parts, camera):
        return self.renderer.freeze(merge(parts), camera)


def test_additions_are_drawn_beside_the_scene_with_the_same_result():
    scene = splat()
    added = replace(scene[::7], means=scene.means[::7] + 0.05)
    parts = (scene, added)
    frozen, wanted = RENDERER.freeze(merge(parts), TARGET), darker(merge(parts), TARGET)
    held = hold(scene)
    apart, merged = (
        fit_image_colors(parts, frozen, wanted, LEFT, held, kind(RENDERER), CONFIG)
        for kind in (SceneRenderer, Merging)
    )
    assert len(apart[0]) > 0
    assert apart[0].max() < len(scene)
    assert torch.equal(apart[0], merged[0])
    assert torch.equal(apart[1], merged[1])
    # They hide a part of the scene.
    assert not torch.equal(apart[0], recolored(scene, held=held)[0])


def test_the_number_of_threads_does_not_matter():
    scene = splat()
    one, two = (recolored(scene, renderer=CpuRenderer(threads)) for threads in (1, 2))
    threads = torch.get_num_threads()
    torch.set_num_threads(3 - min(threads, 2))
    try:
        other = recolored(scene)
    finally:
        torch.set_num_threads(threads)
    for found in (two, other):
        assert torch.equal(one[0], found[0])
        assert torch.equal(one[1], found[1])


def test_gaussians_follow_their_proxy():
    scene = splat()
    rows, recolored_scene = recolored(scene)[0], change(scene)
    index = torch.arange(len(scene)).repeat_interleave(2)
    source = ContextScene.build(scene[index], scene, index)
    ids = scene.generated.index_fill(0, rows, 3)
    state = replace(
        begin_with(scene[index], PHOTOS),
        source=source,
        rendered_context=replace(recolored_scene, generated=ids),
    )
    after = state.recolored_context
    assert torch.allclose(after.sh, recolored_scene.sh[index], atol=1e-6)
    assert torch.equal(after.generated, ids[index])
    assert torch.equal(after.sh[~state.recolored_mask], scene[index].sh[~state.recolored_mask])


@pytest.mark.slow
def test_the_reference_renderer_recolours_alike():
    scene = splat()
    found = change(scene), change(scene, renderer=load_renderer("reference"))
    images = [RENDERER.render(each, TARGET).image for each in found]
    assert (images[0] - images[1]).abs().max() < 0.01
