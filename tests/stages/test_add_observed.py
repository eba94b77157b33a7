"""Photographs add what a given scene lacks, before any target."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from gscompleter import GSCompleter, load_renderer
from gscompleter.config import CompleterConfig
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.geometry import project
from gscompleter.parts import NOT_INVENTED
from gscompleter.stages import add_observed
from gscompleter.stages.add_observed import (
    Lack,
    choose_photographs,
    keep_large_regions,
    limit_stereo_photos,
    select_pixels,
)
from gscompleter.types import ChooseMasks, DepthMap, Gaussians, Reconstruction, View, merge
from scenes import Room, camera_at, gaussians_of, reconstruction_of, view_of

SIZE = 64
RENDERER = load_renderer("cpu")
ROOM = Room()
EMPTY_ROOM = Room(boxes=ROOM.boxes[:1])
PLACES = (-0.6, -0.3, 0.0, 0.3, 0.6)
PHOTOS = [view_of(ROOM, camera_at(x, size=SIZE), k) for k, x in enumerate(PLACES)]
SPLAT = CompleterConfig.splat()


def make_scene() -> Gaussians:
    """Make the room as three of the photographs show it."""
    return merge([gaussians_of(PHOTOS[index]) for index in (0, 2, 4)])


def is_in_front_box(scene: Gaussians) -> torch.Tensor:
    low, high = ROOM.boxes[1]
    margin = 0.05
    above = (scene.means > torch.tensor(low) - margin).all(dim=1)
    return above & (scene.means < torch.tensor(high) + margin).all(dim=1)


WHOLE = make_scene()
PHOTOS = [replace(v, image=RENDERER.render(WHOLE, v.camera).image.clamp(0, 1)) for v in PHOTOS]
"""Photographs that the whole scene reproduces exactly."""
CUT = WHOLE[~is_in_front_box(WHOLE)]
"""The scene without the front box: a hole that all photographs show."""


def reconstruct_exactly(views: list[View]) -> Reconstruction:
    """Reconstruct photographs as an ideal Ψ: the true surface of each pixel."""
    return reconstruction_of(views, [view.depth for view in views])


def begin(scene: Gaussians, config: CompleterConfig = SPLAT, photos=PHOTOS):
    return GSCompleter(reconstruct_exactly, config=config).begin(photos[:2], scene, photos[2:])


def score(scene: Gaussians) -> list[float]:
    return [psnr(RENDERER.render(scene, v.camera).image.clamp(0, 1), v.image) for v in PHOTOS]


def test_a_hole_that_photographs_show_is_filled_from_them():
    state = begin(CUT)
    assert state.num_observed == len(state.added) > 100
    assert (state.added.generated == NOT_INVENTED).all()
    for before, after in zip(score(CUT), score(state.scene), strict=True):
        assert after > before + 8
    # What was given stays, bit for bit.
    assert torch.equal(state.scene.means[: len(CUT)], CUT.means)


def measure_misplacement(scene: Gaussians) -> float:
    """Compute the median error of the z-depth of Gaussians, relative to the depth.

    Each counts at the photograph where it is least: others may not see it.
    """
    errors = []
    for photo in PHOTOS:
        pixels, z = project(scene.means, photo.camera)
        column, row = pixels.long().clamp(0, SIZE - 1).unbind(dim=1)
        errors.append((z / photo.depth[row, column] - 1).abs())
    return torch.stack(errors).amin(dim=0).median().item()


@pytest.mark.parametrize("scale", [0.85, 1.0, 1.2])
def test_depths_of_another_scale_are_registered(scale):
    def reconstruct_in_another_scale(views: list[View]) -> Reconstruction:
        return reconstruction_of(views, [scale * view.depth for view in views])

    state = GSCompleter(reconstruct_in_another_scale, config=SPLAT).begin(
        PHOTOS[:2], CUT, PHOTOS[2:]
    )
    assert state.num_observed > 100
    assert measure_misplacement(state.added) < 0.01
    for before, after in zip(score(CUT), score(state.scene), strict=True):
        assert after > before + 8


def test_a_far_wall_that_is_a_little_off_moves_nothing_near():
    """A far wall of Ψ is 1 % off; an affine at each photograph brought the box nearer."""

    def reconstruct_with_a_far_wall(views: list[View]) -> Reconstruction:
        depths = [view.depth for view in views]
        return reconstruction_of(views, [torch.where(d > 4.5, 1.01 * d, d) for d in depths])

    completer = GSCompleter(reconstruct_with_a_far_wall, config=SPLAT)
    state = completer.begin(PHOTOS[:2], CUT, PHOTOS[2:])
    assert state.num_observed > 100
    near = state.added[project(state.added.means, PHOTOS[2].camera)[1] < 4.0]
    assert len(near) > 100
    assert measure_misplacement(near) < 0.01


def test_a_reconstructor_of_parts_is_asked_for_what_is_lacking():
    class Exact:
        """An ideal Ψ, which returns the Gaussians of the pixels that are asked for."""

        shares: tuple[float, ...] = ()

        def __call__(self, views: list[View]) -> Reconstruction:
            raise AssertionError("the whole is not needed")

        def reconstruct_part(self, views: list[View], choose_masks: ChooseMasks) -> Reconstruction:
            whole = reconstruct_exactly(views)
            masks = choose_masks(whole.depths)
            self.shares = tuple(mask.float().mean().item() for mask in masks)
            rows = torch.cat([mask.flatten() for mask in masks])
            return replace(
                whole,
                gaussians=whole.gaussians[rows],
                view_index=whole.view_index[rows],
                pixel_index=whole.pixel_index[rows],
            )

    psi = Exact()
    state = GSCompleter(psi, config=SPLAT).begin(PHOTOS[:2], CUT, PHOTOS[2:])
    assert len(psi.shares) == len(PHOTOS)
    assert 0 < max(psi.shares) < 0.3
    for before, after in zip(score(CUT), score(state.scene), strict=True):
        assert after > before + 8


def test_additions_in_one_place_are_dropped(monkeypatch):
    """Each of five photographs has a Gaussian for each of its pixels of the same box."""
    few = begin(CUT)
    monkeypatch.setattr(add_observed, "drop_doubled", lambda added, *_: added)
    all_pixels = begin(CUT)
    assert 100 < few.num_observed < 0.7 * all_pixels.num_observed
    for before, after in zip(score(all_pixels.scene), score(few.scene), strict=True):
        assert after > before - 0.05


# `test_additions_in_one_place_are_dropped` thins out.
@pytest.mark.slow
def test_a_surface_that_is_thinned_out_has_no_holes_from_elsewhere():
    elsewhere = camera_at(0.45, size=SIZE)
    covered = RENDERER.render(WHOLE, elsewhere).alpha
    thinned = RENDERER.render(begin(CUT).scene, elsewhere).alpha
    assert (thinned > covered - 0.05).float().mean() > 0.99


def test_what_stands_before_a_wall_that_the_scene_shows_is_added():
    # The front box is gone, and one sees the wall that stood behind it.
    wall = gaussians_of(view_of(EMPTY_ROOM, PHOTOS[2].camera))
    pixels = gaussians_of(view_of(ROOM, PHOTOS[2].camera))
    behind = merge([CUT, wall[is_in_front_box(pixels)]])
    state = begin(behind)
    assert state.num_observed > 100
    for before, after in zip(score(behind), score(state.scene), strict=True):
        assert after > before + 2
    # The additions are the boxes, not the walls behind them.
    _, z = project(state.added.means, PHOTOS[2].camera)
    assert z.quantile(0.9) < 4.0


def test_a_scene_that_lacks_nothing_is_left_alone():
    state = begin(WHOLE)
    assert state.num_observed == 0
    assert len(state.parts) == 1


@pytest.mark.parametrize(
    "config", [replace(SPLAT, add_observed=False), CompleterConfig.paper(), SPLAT.for_removal()]
)
def test_the_paper_and_a_removal_add_nothing_from_photographs(config):
    assert begin(CUT, config).num_observed == 0


def test_a_context_without_a_given_scene_is_what_its_photographs_show():
    state = GSCompleter(reconstruct_exactly).begin(PHOTOS[:2])
    assert state.num_observed == 0


def test_ignored_pixels_show_nothing():
    everywhere = torch.ones(SIZE, SIZE, dtype=torch.bool)
    everywhere[:8] = False  # the ceiling, which the scene has
    hidden = [replace(photo, ignore_mask=everywhere) for photo in PHOTOS]
    assert begin(CUT, photos=hidden).num_observed == 0


def test_no_photograph_gets_worse_by_a_wrong_reconstruction():
    def reconstruct_wrongly(views: list[View]) -> Reconstruction:
        exact = reconstruct_exactly(views)
        # Twice as far as they are; the depths that are compared with the scene stay right.
        far = replace(exact.gaussians, means=2 * exact.gaussians.means)
        return replace(exact, gaussians=far)

    state = GSCompleter(reconstruct_wrongly, config=SPLAT).begin(PHOTOS[:2], CUT, PHOTOS[2:])
    for before, after in zip(score(CUT), score(state.scene), strict=True):
        assert after > before - 0.02


def make_lack(empty: float, contradicted: float = 0.0) -> Lack:
    """Make a lack with shares of the image, in rows from the top and from the bottom."""
    rows = torch.arange(100)[:, None].expand(100, 100)
    return Lack(rows < 100 * empty, rows >= 100 * (1 - contradicted))


def test_photographs_that_show_nothing_new_are_not_reconstructed():
    views = [PHOTOS[index] for index in range(3)]
    assert choose_photographs(views, [make_lack(0.0)] * 3, 8) == []
    # A single one gets the nearest as its stereo partner.
    assert choose_photographs(views, [make_lack(0.1), make_lack(0.0), make_lack(0.0)], 8) == [0, 1]
    assert choose_photographs(views[:1], [make_lack(0.1)], 8) == []
    # Nor are those from one place, unless there is another.
    same = [views[0], replace(views[0], frame=7)]
    assert choose_photographs(same, [make_lack(0.1)] * 2, 8) == []
    lacks = [make_lack(0.1), make_lack(0.1), make_lack(0.0)]
    assert choose_photographs([*same, views[1]], lacks, 8) == [0, 1, 2]
    # What photographs still show that were reconstructed before could not be added.
    assert choose_photographs(views, [make_lack(0.1)] * 3, 8, {0, 1}) == [1, 2]
    assert choose_photographs(views, [make_lack(0.1)] * 3, 8, {0, 1, 2}) == []
    small = view_of(ROOM, camera_at(0.1, size=32))
    assert choose_photographs([*views, small], [make_lack(0.1)] * 4, 8) == [0, 1, 2]


def test_small_photographs_are_reconstructed_together():
    class BuildsParts:
        def __call__(self, views: Sequence[View]) -> Reconstruction:
            raise AssertionError

        def reconstruct_part(self, views: Sequence[View], choose_masks: ChooseMasks):
            raise AssertionError

    def of_size(height: int, width: int) -> View:
        camera = replace(PHOTOS[0].camera, width=width, height=height)
        return View(torch.zeros(height, width, 3), camera)

    builds_parts = BuildsParts()
    assert limit_stereo_photos(builds_parts, [of_size(352, 628)]) == 24
    assert limit_stereo_photos(builds_parts, [of_size(540, 960), of_size(10, 10)]) == 10
    assert limit_stereo_photos(builds_parts, [of_size(1080, 1920)]) == 8
    # A network that makes whole scenes gets few photographs of any size.
    assert limit_stereo_photos(reconstruct_exactly, [of_size(10, 10)]) == 8


def test_small_regions_are_no_contradiction():
    mask = torch.zeros(100, 100, dtype=torch.bool)
    mask[10:12, 10:12] = True
    mask[50:60, 50:60] = True
    kept = keep_large_regions(mask)
    assert int(kept.sum()) == 100
    assert kept[50, 50]


def test_only_what_is_nearer_than_the_scene_can_be_added():
    lack = make_lack(0.0, contradicted=0.2)
    everywhere = torch.ones(100, 100, dtype=torch.bool)
    scene = DepthMap(torch.full((100, 100), 4.0), everywhere, torch.ones(100, 100))
    nearer = replace(scene, depth=torch.full((100, 100), 3.0))
    farther = replace(scene, depth=torch.full((100, 100), 5.0))
    assert int(select_pixels(lack, nearer, scene, 3).sum()) == 2000
    assert int(select_pixels(lack, farther, scene, 3).sum()) == 0
    # Most of a region decides, and of that region the nearer pixels are taken.
    mixed = replace(nearer, depth=nearer.depth.clone())
    mixed.depth[80:85] = 5.0
    assert int(select_pixels(lack, mixed, scene, 3).sum()) == 1500
    mixed.depth[80:92] = 5.0
    assert int(select_pixels(lack, mixed, scene, 3).sum()) == 0


def test_an_empty_region_is_widened_over_its_seam():
    lack = make_lack(0.1)
    everywhere = torch.ones(100, 100, dtype=torch.bool)
    scene = DepthMap(torch.full((100, 100), 4.0), everywhere, torch.ones(100, 100))
    assert int(select_pixels(lack, scene, scene, 3).sum()) == 1300
