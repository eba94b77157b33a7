"""What was invented gives way to what photographs show."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gscompleter import GSCompleter, load_renderer
from gscompleter.config import CompleterConfig
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.parts import OBSERVED, EarlierWork, PartOrigin, make_part
from gscompleter.render.cache import SceneRenderer
from gscompleter.stages.replace_contested import (
    Contested,
    fade_before_returned,
    find_contested,
    let_step_aside,
    return_needed,
)
from gscompleter.stages.superfluous import limit_errors
from gscompleter.state import Completion
from gscompleter.system.errors import InputError
from gscompleter.types import Gaussians, Reconstruction, View, make_observed, merge, sh_from_rgb
from scenes import Room, camera_at, gaussians_of, reconstruction_of, view_of

SCENES = SceneRenderer(load_renderer("cpu"))
SIZE = 48
RENDERER = load_renderer("cpu")
ROOM = Room()
PLACES = (-0.6, -0.3, 0.0, 0.3, 0.6)
PHOTOS = [view_of(ROOM, camera_at(x, size=SIZE), k) for k, x in enumerate(PLACES)]
WHOLE = merge([gaussians_of(PHOTOS[index]) for index in (0, 2, 4)])
PHOTOS = [replace(v, image=RENDERER.render(WHOLE, v.camera).image.clamp(0, 1)) for v in PHOTOS]
"""Photographs that the whole scene reproduces exactly."""
SPLAT = CompleterConfig.splat()


def find_crate(scene: Gaussians) -> torch.Tensor:
    low, high = (torch.tensor(corner) for corner in ROOM.boxes[1])
    return ((scene.means > low - 0.05) & (scene.means < high + 0.05)).all(dim=1)


CUT = WHOLE[~find_crate(WHOLE)]
"""The scene without the front box: a hole that all photographs show."""


def make_board(z: float, x: float = -0.1, color: float = 0.9, width: float = 0.5) -> Gaussians:
    """Make an opaque grey board that was invented for target 1, across the view of the box."""
    steps = torch.linspace(-width, width, 25)
    places = torch.cartesian_prod(steps + x, steps + 0.8)
    means = torch.cat([places, torch.full((len(places), 1), z)], dim=1)
    board = make_observed(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        torch.full((len(means), 3), 0.03),
        torch.full((len(means),), 0.95),
        sh_from_rgb(torch.full((len(means), 3), color)),
    )
    return replace(board, generated=torch.ones_like(board.generated))


def make_observed_again(board: Gaussians) -> Gaussians:
    """Take the label of what was invented off."""
    return replace(board, generated=torch.zeros_like(board.generated))


def reconstruct_exactly(views: list[View]) -> Reconstruction:
    """Reconstruct photographs as an ideal Ψ: the true surface of each pixel."""
    return reconstruction_of(views, [view.depth for view in views])


def begin(
    scene: Gaussians, marks: bool = True, config: CompleterConfig = SPLAT, photos=PHOTOS
) -> Completion:
    """Begin with a scene, in which what has a label was invented, or nothing without `marks`."""
    completer = GSCompleter(reconstruct_exactly, config=config)
    invented = scene.generated != OBSERVED if marks else None
    return completer.begin(photos[:2], scene, photos[2:], earlier=EarlierWork(invented))


def score(scene: Gaussians) -> list[float]:
    return [psnr(RENDERER.render(scene, v.camera).image.clamp(0, 1), v.image) for v in PHOTOS]


@pytest.mark.parametrize(
    "z",
    [
        pytest.param(1.6, id="before the box", marks=pytest.mark.slow),
        pytest.param(2.6, id="within it"),
    ],
)
def test_what_stands_before_a_photographed_surface_gives_way(z):
    scene = merge([CUT, make_board(z)])
    kept, replaced = begin(scene, marks=False), begin(scene)
    assert kept.source.replaced_mask.sum() == 0
    gone = replaced.source.replaced_mask
    is_board = scene.generated != OBSERVED
    assert gone.any()
    for view in PHOTOS:
        left = replaced.scene
        shown = RENDERER.freeze(left, view.camera).splat((left.generated == 1).float())
        assert (shown > 0.5).float().mean() < 0.002
    # What was given stays, bit for bit.
    assert not gone[~is_board].any()
    assert torch.equal(replaced.scene.means[: len(CUT)], CUT.means)
    for before, without, after in zip(
        score(scene), score(kept.scene), score(replaced.scene), strict=True
    ):
        assert after > before + 8
        assert after > without + 3


def test_what_photographs_do_not_show_stays():
    """One board is beside all photographs, the other within the box, which hides it."""
    beside = make_board(3.0, x=9.0)
    inside = make_board(2.6, width=0.15)
    scene = merge([WHOLE, beside, inside])
    begun = begin(scene, marks=False)
    assert find_contested(begun, EarlierWork(scene.generated != OBSERVED), SCENES) is None


def test_what_only_one_place_shows_stays_where_nothing_else_is_known():
    """Photographs from one place have no stereo: without the board there would be a hole."""
    one = [replace(PHOTOS[2], frame=k) for k in range(3)]
    scene = merge([CUT, make_board(2.6, color=0.4)])
    state = begin(scene, photos=one)
    assert state.num_observed == 0
    # Its edge stood before what the scene shows.
    assert state.source.replaced_mask[len(CUT) :].float().mean() < 0.5
    assert score(state.scene)[2] > score(scene)[2] - 0.02


def begin_lifted(scene: Gaussians, lifted: torch.Tensor | None) -> Completion:
    completer = GSCompleter(reconstruct_exactly, config=SPLAT)
    return completer.begin(PHOTOS[:2], scene, PHOTOS[2:], earlier=EarlierWork(lifted=lifted))


def test_what_was_lifted_to_a_wrong_place_gives_way():
    """Ψ had one photograph of the box, and lifted it as a board before it."""
    board = make_observed_again(make_board(1.6))
    scene = merge([CUT, board])
    is_board = torch.arange(len(scene)) >= len(CUT)
    kept, replaced = begin_lifted(scene, None), begin_lifted(scene, is_board)
    assert kept.source.replaced_mask.sum() == 0
    assert replaced.source.replaced_mask[is_board].float().mean() > 0.5
    assert not replaced.source.replaced_mask[~is_board].any()
    for before, after in zip(score(kept.scene), score(replaced.scene), strict=True):
        assert after > before + 3


def test_what_was_lifted_stays_where_photographs_agree():
    everything = torch.ones(len(WHOLE), dtype=torch.bool)
    assert not begin_lifted(WHOLE, everything).source.replaced_mask.any()


def test_additions_before_what_returned_fade():
    begun = begin_lifted(WHOLE, None)
    board = make_part(PartOrigin("photographs"), make_observed_again(make_board(1.6)))
    views = [photo.view for photo in begun.photos]
    images = [RENDERER.render(WHOLE, view.camera).image for view in views]
    limits = limit_errors(images, views, 0.01)
    covered = replace(begun, added_parts=(board,))
    assert score(covered.scene)[2] < score(WHOLE)[2] - 3
    faded = fade_before_returned(covered, views, limits, SCENES)
    renders = [RENDERER.render(faded.scene, view.camera).image for view in views]
    # Renders are exact, so that no error at all is allowed.
    for error, limit in zip(limit_errors(renders, views, 0.0), limits, strict=True):
        assert error <= limit + 1e-7


def hide_columns(view: View, columns: slice) -> View:
    hidden = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    hidden[:, columns] = True
    return replace(view, ignore_mask=hidden)


def test_what_gave_way_returns_where_all_that_photographs_added_fades():
    """Additions are right at the front box, and mostly wrong boards before the one beside it.

    One photograph shows the first alone, which gave way; the other shows the boards alone, by
    which all additions go.
    """
    low, high = (torch.tensor(corner) for corner in ROOM.boxes[2])
    is_beside = ((WHOLE.means > low - 0.05) & (WHOLE.means < high + 0.05)).all(dim=1)
    is_crate = find_crate(WHOLE)
    # A little before its true place, in front of the additions.
    crate = replace(WHOLE[is_crate], means=0.97 * WHOLE.means[is_crate])
    rest = WHOLE[~is_crate & ~is_beside]
    scene = merge([rest, crate, WHOLE[is_beside]])
    photos = [hide_columns(PHOTOS[2], slice(0, 28)), hide_columns(PHOTOS[3], slice(22, None))]
    given = begin(scene, marks=False, config=replace(SPLAT, add_observed=False), photos=photos)
    contested = Contested(given, torch.arange(len(scene)) >= len(rest))
    boards = [make_observed_again(make_board(2.3 + 0.04 * step, x=0.9)) for step in range(10)]
    added = make_part(PartOrigin("photographs"), merge([WHOLE[is_crate], *boards]))
    state = replace(let_step_aside(given, contested), added_parts=(added,))

    returned = return_needed(state, contested, SCENES)
    assert returned.added_parts == ()
    for view in photos:
        before, after = (
            psnr(view.fill_ignored(RENDERER.render(s, view.camera).image.clamp(0, 1)), view.image)
            for s in (scene, returned.scene)
        )
        assert after > before - 0.02


def test_what_photographs_confirm_is_still_there():
    """The box was invented as it is: photographs show it, whoever made it."""
    box = WHOLE[find_crate(WHOLE)]
    box = replace(box, generated=torch.ones_like(box.generated))
    scene = merge([CUT, box])
    state = begin(scene)
    for before, after in zip(score(scene), score(state.scene), strict=True):
        # As good as photographs are reconstructed, of which nobody sees a difference.
        assert after > min(before, 35)


@pytest.mark.parametrize("config", [replace(SPLAT, add_observed=False), CompleterConfig.paper()])
def test_nothing_gives_way_where_photographs_add_nothing(config):
    scene = merge([CUT, make_board(1.6)])
    assert not begin(scene, config=config).source.replaced_mask.any()


def test_a_wrong_mask_is_refused():
    completer = GSCompleter(reconstruct_exactly)
    with pytest.raises(InputError, match="needs a truth value for each of"):
        completer.begin(PHOTOS, WHOLE, earlier=EarlierWork(torch.zeros(3, dtype=torch.bool)))
    with pytest.raises(InputError, match="needs a truth value for each of"):
        completer.begin(PHOTOS, WHOLE, earlier=EarlierWork(lifted=torch.zeros(3, dtype=torch.bool)))
    with pytest.raises(InputError, match="marks Gaussians of a scene"):
        completer.begin(PHOTOS, earlier=EarlierWork(torch.zeros(3, dtype=torch.bool)))
