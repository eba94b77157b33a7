"""Dynamic masks cover regions that moved between photographs; completion does not use them."""

from functools import cache

import pytest
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter import GSCompleter
from gscompleter.config import CompleterConfig
from gscompleter.guards.dynamic_masks import (
    compare_photographs,
    find_dynamic_masks,
    shrink_photo,
)
from gscompleter.numerics.geometry import project, sample, unproject
from gscompleter.state import Completion
from gscompleter.target_result import TargetResult
from gscompleter.types import Camera, Render, View
from moving_object import (
    CAMERAS,
    PLACES,
    ROOM,
    SIZE,
    photographed,
    with_something_red,
)
from scenes import Room, camera_at, cast, view_of


@cache
def beginning(is_checked: bool) -> Completion:
    """Return the scene of these photographs without targets."""
    config = CompleterConfig()
    config = config if is_checked else config.without_guard("dynamic-masks")
    return GSCompleter(config=config).begin(photographed()[0])


def carried(mask: Bool[Tensor, "h w"], at: Camera, view: View) -> Bool[Tensor, "h w"]:
    """Reproject a mask of another camera into a view of the room."""
    assert view.depth is not None
    pixels, _ = project(unproject(view.depth, view.camera), at)
    return sample(mask[..., None].float(), pixels)[..., 0] > 0.5


def as_seen(views: list[View]) -> list[Render]:
    """Return the best result of Ψ: the room without moving objects."""
    return [Render(v.image, v.depth, torch.ones_like(v.depth)) for v in views]


def is_red(colours: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
    return colours[..., 0] > 2.2 * colours[..., 1:].amax(dim=-1) + 0.05


def test_what_moved_is_found_in_both_photographs():
    views, reds = photographed()
    begun = beginning(True)
    for k, (view, red) in enumerate(zip(begun.views, reds, strict=True)):
        assert view.dynamic_mask is not None
        found, other = view.dynamic_mask, 1 - k
        here = red | carried(reds[other], CAMERAS[other], views[k])
        assert (found & red).sum() >= 0.8 * red.sum()
        assert (found & here).sum() >= 0.8 * here.sum()
        assert (found & here).sum() >= 0.7 * found.sum()


def test_a_room_in_which_nothing_moved_is_trusted():
    cameras = (camera_at(-0.1, size=SIZE), camera_at(0.2, size=SIZE))
    begun = GSCompleter().begin([view_of(Room(), camera) for camera in cameras])
    assert all((~view.static_mask).float().mean() <= 0.005 for view in begun.views)


def test_every_pixel_without_a_mask_that_two_photographs_show_is_compared():
    views = [view_of(Room(), camera_at(x, yaw=yaw)) for x, yaw in ((-0.1, 0), (0.1, 5))]
    one, other = map(shrink_photo, views, as_seen(views))
    compared = compare_photographs(one, other, min_difference=0.1)
    assert torch.equal(compared.valid_mask, compared.in_frame_mask & one.valid_mask)


def test_exposure_is_no_contradiction():
    views = [view_of(ROOM, camera) for camera in CAMERAS]
    darker = View(0.6 * views[1].image, CAMERAS[1], depth=views[1].depth)
    pair = [views[0], darker]
    assert not any(mask.any() for mask in find_dynamic_masks(pair, as_seen(pair)))


def test_of_three_photographs_most_decide():
    """Two photographs show the wall behind the red object of the first."""
    third = camera_at(-0.3, -0.15, size=SIZE)
    red_view, red = with_something_red(CAMERAS[0], PLACES[0])
    views = [red_view, view_of(ROOM, CAMERAS[1]), view_of(ROOM, third)]
    first, second, last = find_dynamic_masks(views, as_seen(views))
    assert (first & red).sum() >= 0.8 * red.sum()
    for mask, view in zip((second, last), views[1:], strict=True):
        behind = carried(red, CAMERAS[0], view)
        assert (mask & behind).sum() <= 0.2 * behind.sum()
    both = find_dynamic_masks(views[:2], as_seen(views[:2]))
    behind = carried(red, CAMERAS[0], views[1])
    assert (both[1] & behind).sum() >= 0.8 * behind.sum()


def completed(is_checked: bool) -> TargetResult:
    """Complete a hole behind an occluder, next to something red, from farther to the left."""
    target, begun = camera_at(-0.4, -0.1, size=SIZE), beginning(is_checked)
    return GSCompleter().advance(begun, target).targets[0]


def measure_reds(result: TargetResult, image: Float[Tensor, "h w 3"]) -> float:
    """Measure the share of the hole that is red, but not in the room."""
    truth = is_red(cast(ROOM, result.target)[0])
    return (is_red(image) & ~truth)[result.hole_mask].float().mean().item()


def test_holes_are_not_painted_with_what_moved():
    wary = completed(True)
    assert wary.reference is not None
    # About a third of what is painted without the guard.
    assert measure_reds(wary, wary.reference.image) < 0.08
    assert measure_reds(wary, wary.after.image) < 0.08


# The test before completes with the guard.
@pytest.mark.slow
def test_without_the_guard_holes_are_painted_with_what_moved():
    wary, credulous = completed(True), completed(False)
    assert wary.reference is not None
    assert credulous.reference is not None
    for painted, known in (
        (credulous.reference.image, wary.reference.image),
        (credulous.after.image, wary.after.image),
    ):
        assert measure_reds(credulous, painted) > 0.1
        assert measure_reds(wary, known) < measure_reds(credulous, painted) / 2.5


def test_the_context_stays_as_it_is():
    with_check, without = beginning(True), beginning(False)
    assert torch.equal(with_check.context.means, without.context.means)
    assert torch.equal(with_check.context.sh, without.context.sh)
    limits = [[b.limit for b in state.photos[0].budgets] for state in (with_check, without)]
    assert limits[0] == limits[1]
    assert all(view.dynamic_mask is None for view in without.views)
    assert CompleterConfig.paper().guards == ()
