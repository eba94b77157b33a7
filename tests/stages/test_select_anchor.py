"""Stage 2: the anchor rule of the paper, and lifting."""

import pytest
import torch

from gscompleter.config import AnchorConfig, CompleterConfig
from gscompleter.stages.lift import lift_pair
from gscompleter.stages.select_anchor import find_nearest_view, select_anchor
from gscompleter.stages.synthesize import synthesize
from gscompleter.types import Camera, DepthMap, GeneratorInput, Reconstruction, Render, View, merge
from scenes import Room, camera_at, gaussians_of, view_of

TARGET = camera_at()


def view(x: float, yaw: float) -> View:
    camera = camera_at(x=x, yaw=yaw)
    return View(torch.zeros(camera.height, camera.width, 3), camera)


def test_the_widest_baseline_wins():
    choice = select_anchor(TARGET, [view(x=1, yaw=10), view(x=3, yaw=30)])
    assert (choice.index, choice.is_fallback) == (1, False)


def test_a_view_turned_too_far_loses_however_wide_its_baseline():
    choice = select_anchor(TARGET, [view(x=1, yaw=10), view(x=9, yaw=46)])
    assert (choice.index, choice.is_fallback) == (0, False)


def test_when_every_view_is_turned_too_far_the_least_turned_wins_and_says_so():
    choice = select_anchor(TARGET, [view(x=9, yaw=80), view(x=1, yaw=-50)])
    assert (choice.index, choice.is_fallback) == (1, True)


def test_a_view_from_where_the_target_stands_tells_no_depth():
    views = [view(x=0, yaw=20), view(x=1, yaw=60), view(x=2, yaw=30)]
    assert select_anchor(TARGET, views, overlaps=[0.5, 0.1, 0.1]).index == 2
    assert select_anchor(TARGET, views[:2]).index == 1
    assert select_anchor(TARGET, views[:1]).index == 0


def test_the_paper_excludes_no_view_for_a_small_baseline():
    """The smallest rotation wins if all exceed the limit, at any distance."""
    views, target = [view(0.001, 50), view(1.0, 60)], camera_at(0.0)
    assert select_anchor(target, views).index == 1
    assert select_anchor(target, views, CompleterConfig.paper().anchor).index == 0


def test_the_largest_rotation_is_a_setting():
    views = [view(x=1, yaw=10), view(x=3, yaw=40)]
    assert select_anchor(TARGET, views, AnchorConfig(max_rotation=30.0)).index == 0
    assert select_anchor(TARGET, views, AnchorConfig(max_rotation=45.0)).index == 1


def test_without_anchor_selection_the_nearest_view_is_taken():
    views = [view(x=3, yaw=30), view(x=1, yaw=10)]
    assert select_anchor(TARGET, views, AnchorConfig(selection="nearest")).index == 1


def test_of_equally_near_views_the_least_turned_is_the_nearest():
    assert find_nearest_view(TARGET, [view(x=1, yaw=20), view(x=-1, yaw=5)]) == 1


def test_without_views_there_is_no_anchor():
    with pytest.raises(ValueError, match="at least one"):
        select_anchor(TARGET, [])


def context_of(*views: View) -> GeneratorInput:
    nothing = Render(torch.zeros(96, 96, 3), torch.zeros(96, 96), torch.zeros(96, 96))
    return GeneratorInput(tuple(views), tuple(nothing for _ in views), nothing)


def test_the_generator_is_asked_with_the_nearest_view():
    near, far = view(x=1, yaw=0), view(x=2, yaw=0)
    asked = []

    def generator(nearest: View, target: Camera, context: GeneratorInput):
        asked.append(nearest)
        return torch.full((target.height, target.width, 3), 0.25)

    (reference,) = synthesize(generator, [(TARGET, context_of(far, near))])
    assert asked[0] is near
    assert reference.camera is TARGET
    assert (reference.image == 0.25).all()


def test_a_generator_that_returns_another_size_or_nan_is_refused():
    inputs = [(TARGET, context_of(view(1, 0)))]
    with pytest.raises(ValueError, match="shape"):
        synthesize(lambda *_: torch.zeros(8, 8, 3), inputs)
    with pytest.raises(ValueError, match="nan"):
        synthesize(lambda *_: torch.full((96, 96, 3), torch.nan), inputs)


def two_views_reconstructed(aligned: bool):
    """Make a reconstructor that knows the true depth of a room."""

    def reconstruct(views):
        truths = [view_of(Room(), v.camera) for v in views]
        n = 96 * 96
        maps = tuple(DepthMap(t.depth, torch.ones(96, 96, dtype=torch.bool)) for t in truths)
        return Reconstruction(
            merge([gaussians_of(t) for t in truths]),
            maps,
            torch.arange(2).repeat_interleave(n) if aligned else None,
            torch.arange(n).repeat(2) if aligned else None,
        )

    return reconstruct


def test_of_a_pixel_aligned_pair_only_the_references_gaussians_are_lifted():
    reference, anchor = view(0, 0), view(0.4, 0)
    lifted = lift_pair(two_views_reconstructed(aligned=True), reference, anchor)
    assert len(lifted.gaussians) == 96 * 96
    assert torch.equal(lifted.pixel_index, torch.arange(96 * 96))
    truth = gaussians_of(view_of(Room(), reference.camera))
    assert torch.equal(lifted.gaussians.means, truth.means)


def test_of_another_reconstructor_all_that_the_target_sees_is_lifted():
    reference, anchor = view(0, 0), view(0.4, 0)
    lifted = lift_pair(two_views_reconstructed(aligned=False), reference, anchor)
    assert lifted.pixel_index is None
    assert 96 * 96 < len(lifted.gaussians) < 2 * 96 * 96


def test_a_view_that_shows_something_else_loses_however_wide_its_baseline():
    target = camera_at()
    views = [view_of(Room(), camera_at(x)) for x in (0.2, 0.6, 2.0)]
    assert select_anchor(target, views).index == 2
    assert select_anchor(target, views, overlaps=[0.9, 0.5, 0.1]).index == 1
    assert select_anchor(target, views, overlaps=[0.1, 0.05, 0.0]).index == 0
    literal = AnchorConfig(min_overlap=0.0)
    assert select_anchor(target, views, literal, [0.9, 0.5, 0.0]).index == 2


@pytest.mark.parametrize("order", [(0.2, 0.6, 2.0), (2.0, 0.2, 0.6), (0.6, 2.0, 0.2)])
def test_of_views_that_share_nothing_with_the_target_the_widest_baseline_wins(order):
    """A target that shows only what was generated for others, whatever order photographs have."""
    views = [view(x=x, yaw=0) for x in order]
    assert select_anchor(TARGET, views, overlaps=[0.0] * 3).index == order.index(2.0)
