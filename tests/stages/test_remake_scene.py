"""A scene that Ψ made of two photographs is made anew of more."""

from __future__ import annotations

from dataclasses import replace

import torch

from gscompleter import GSCompleter, load_renderer
from gscompleter.config import CompleterConfig
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.parts import NOT_INVENTED, EarlierWork
from gscompleter.stages.remake_scene import find_overlying
from gscompleter.state import Completion
from gscompleter.types import (
    SH_C0,
    Gaussians,
    Reconstruction,
    View,
    make_observed,
    merge,
    sh_from_rgb,
)
from scenes import Room, camera_at, gaussians_of, reconstruction_of, view_of

RENDERER = load_renderer("cpu")
PLACES = (-0.6, -0.2, 0.2, 0.6)
PHOTOS = [view_of(Room(), camera_at(x, size=48), k) for k, x in enumerate(PLACES)]
WHOLE = merge([gaussians_of(view) for view in PHOTOS])
NUM_OWN = 2
"""Photographs that the given scene was made of."""


def reconstruct_exactly(views: list[View]) -> Reconstruction:
    """Reconstruct photographs as an ideal Ψ: the true surface of each pixel."""
    return reconstruction_of(views, [view.depth for view in views])


def make_shards() -> Gaussians:
    """Make what looks right from the first photographs alone: some of it at a wrong depth."""
    shards = []
    for view in PHOTOS[:NUM_OWN]:
        scene = gaussians_of(view)
        half = torch.arange(len(scene)) % 2 == 0
        center = view.camera.center
        means = torch.where(half[:, None], center + 0.6 * (scene.means - center), scene.means)
        scales = torch.where(half[:, None], 0.6 * scene.scales, scene.scales)
        shards.append(replace(scene, means=means, scales=scales))
    return merge(shards)


def make_invented(x: float) -> Gaussians:
    """Make a Gaussian that was invented for target 1."""
    colors = sh_from_rgb(torch.full((1, 3), 0.5))
    mean = torch.tensor([[x, 0.0, 3.0]])
    quat = torch.tensor([[1.0, 0, 0, 0]])
    made = make_observed(mean, quat, torch.full((1, 3), 0.02), torch.tensor([0.9]), colors)
    return replace(made, generated=torch.ones_like(made.generated))


SHARDS = make_shards()
ASIDE = make_invented(30.0)


def begin(scene: Gaussians, photos: list[View], is_remade: bool = True) -> Completion:
    completer = GSCompleter(reconstruct_exactly, config=CompleterConfig.splat())
    is_invented = scene.generated == 1
    earlier = EarlierWork(is_invented, remade=~is_invented if is_remade else None)
    return completer.begin(photos, scene, [], earlier=earlier)


def score(scene: Gaussians, photos: list[View] = PHOTOS) -> list[float]:
    return [psnr(RENDERER.render(scene, v.camera).image.clamp(0, 1), v.image) for v in photos]


def test_all_photographs_gain_and_what_nobody_sees_stays():
    given = merge([SHARDS, ASIDE])
    added = begin(given, PHOTOS, is_remade=False)
    made = begin(given, PHOTOS)
    # Around shards the new photographs stay wrong.
    for after, around in list(zip(score(made.scene), score(added.scene), strict=True))[NUM_OWN:]:
        assert after > around + 3
    for after, true in zip(score(made.scene), score(WHOLE), strict=True):
        assert abs(after - true) < 0.1

    # What went is known, so that strip puts it back.
    assert made.source.replaced_mask.tolist() == [True] * len(SHARDS) + [False]
    assert (made.scene.generated == 1).sum() == 1
    assert (made.scene.generated == NOT_INVENTED).sum() == len(made.scene) - 1
    assert made.num_observed == len(made.scene) - 1


def test_what_was_invented_gives_way_where_the_new_scene_shows_its_place():
    # Before the wall, behind it, and beside all photographs.
    before, behind = (
        make_invented(0.2),
        replace(make_invented(0.2), means=torch.tensor([[0, 0, 9.0]])),
    )
    # It hides another one until it goes.
    hidden = replace(before, means=1.02 * before.means)
    context = merge([before, hidden, behind, ASIDE, SHARDS])
    invented = context.generated == 1
    gone = ~invented

    def find(new: Gaussians) -> list[bool]:
        shown = [RENDERER.render(new, view.camera) for view in PHOTOS]
        return find_overlying(context, invented, gone, new, PHOTOS, shown, RENDERER)[:4].tolist()

    assert find(WHOLE) == [True, True, False, False]
    # Where the new scene is empty, they fill it.
    assert find(WHOLE[WHOLE.means[:, 0] < -1]) == [False, False, False, False]


def test_the_new_scene_keeps_the_exposure_of_what_stays():
    """All photographs of the second command are given darker than those of the first were."""
    darker = [replace(view, image=0.8 * view.image) for view in PHOTOS]
    made = begin(merge([SHARDS, ASIDE]), darker)
    assert made.exposure_gains is not None
    assert torch.allclose(made.exposure_gains, torch.tensor(0.8), atol=0.02)
    # The photographs are brought to the scene.
    for photos in (PHOTOS, list(made.views)):
        for after, true in zip(score(made.scene, photos), score(WHOLE), strict=True):
            assert abs(after - true) < 0.5

    # Nothing stays that was invented.
    alone = begin(SHARDS, darker)
    assert alone.exposure_gains is None
    for after, true in zip(score(alone.scene, darker), score(WHOLE), strict=True):
        assert after > true


def test_photographs_that_check_the_scene_get_the_depth_range_of_the_new_one():
    """The range of the given scene was measured in it, and the photographs have none."""
    bare = [replace(v, camera=replace(v.camera, near=None, far=None)) for v in PHOTOS]
    remade = torch.ones(len(SHARDS), dtype=torch.bool)
    ranges = []
    for earlier in (EarlierWork(remade=remade), EarlierWork()):
        completer = GSCompleter(reconstruct_exactly, config=CompleterConfig.splat())
        begun = completer.begin(bare[:3], SHARDS, bare[3:], earlier=earlier)
        assert begun.is_remade == (earlier.remade is not None)
        assert len(begun.photos) == len(PHOTOS)
        found = {(photo.view.camera.near, photo.view.camera.far) for photo in begun.photos}
        assert len(found) == 1
        ranges.append(found)
    assert ranges[0] != ranges[1]


def test_what_shows_where_photographs_are_ignored_stays():
    """Ψ makes nothing there: around what a person took out, the given scene is all that is left."""
    middle = torch.zeros(48, 48, dtype=torch.bool)
    middle[16:32, 16:32] = True
    masked = [replace(view, ignore_mask=middle) for view in PHOTOS]
    made = begin(merge([SHARDS, ASIDE]), masked)
    stays = ~made.source.replaced_mask[: len(SHARDS)]
    # A Gaussian of each pixel of the photographs that the given scene was made of.
    for own in stays.reshape(NUM_OWN, 48, 48):
        assert own[middle].float().mean() > 0.5
        assert own[:12].float().mean() < 0.1
        assert own[36:].float().mean() < 0.1
    for view in PHOTOS[:NUM_OWN]:
        assert RENDERER.render(made.scene, view.camera).alpha[middle].min() > 0.9
    # Without masks all of it is made anew.
    assert begin(merge([SHARDS, ASIDE]), PHOTOS).source.replaced_mask[: len(SHARDS)].all()


def test_a_scene_stays_if_its_photographs_are_nearer_to_it():
    """Ψ fails here: it makes everything grey."""

    def reconstruct_grey(views: list[View]) -> Reconstruction:
        made = reconstruct_exactly(views)
        grey = torch.zeros_like(made.gaussians.sh)
        grey[:, 0] = -0.3 / SH_C0
        return replace(made, gaussians=replace(made.gaussians, sh=grey))

    completer = GSCompleter(reconstruct_grey, config=CompleterConfig.splat())
    remade = torch.ones(len(WHOLE), dtype=torch.bool)
    begun = completer.begin(PHOTOS, WHOLE, [], earlier=EarlierWork(remade=remade))
    assert not begun.source.replaced_mask.any()
    assert torch.equal(begun.scene.means[: len(WHOLE)], WHOLE.means)
