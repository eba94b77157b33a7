"""A depth range that was given is widened to what photographs show beyond it, and this is said."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter import View
from gscompleter.reconstructors.features import given_range
from gscompleter.reconstructors.features.given_range import DepthRange, find_depth_range
from gscompleter.reconstructors.features.neighbours import Neighbours, find_neighbours
from scenes import Room, camera_at, view_of

SIZE = 96
CUT = 2.6
"""A near plane that cuts the front off the nearer box, which stands at 2.2."""


def see_room(near: float | None, far: float | None, unit: float = 1.0) -> list[View]:
    """Take two photographs of the room, whose wall is at 5; lengths are in `unit`."""
    views = [view_of(Room(unit=unit), camera_at(x, size=SIZE, unit=unit)) for x in (-0.3, 0.1)]
    planes = {"near": near and near * unit, "far": far and far * unit}
    return [replace(view, camera=replace(view.camera, **planes)) for view in views]


@pytest.mark.parametrize("unit", [0.001, 1.0, 1000.0])
def test_a_near_plane_behind_what_features_show_is_brought_forward(unit):
    found = find_depth_range(see_room(CUT, 20.0, unit))
    assert 0.5 * unit < found.near < 2.0 * unit
    assert found.far == 20.0 * unit
    (note,) = found.notes
    assert note.startswith(f"Matched features stand at {2.2 * unit:g}, ")
    assert f"nearer than the near plane at {CUT * unit:g}: the depth range was widened" in note
    # What was found is contradicted by nothing.
    again = find_depth_range(see_room(found.near / unit, 20.0, unit))
    assert again == replace(found, notes=())


def test_a_far_plane_before_what_features_show_is_taken_back():
    found = find_depth_range(see_room(0.5, 3.5))
    assert found.near == 0.5
    assert found.far > 5.0
    (note,) = found.notes
    assert "farther than the far plane at 3.5: the depth range was widened to 0.5 to" in note
    both = find_depth_range(see_room(CUT, 3.5))
    assert both == DepthRange(both.near, found.far, both.notes)
    assert both.near < 2.0
    assert " and at " in both.notes[0]


def test_a_range_that_holds_what_features_show_stays():
    assert find_depth_range(see_room(0.5, 20.0)) == DepthRange(0.5, 20.0)
    assert find_depth_range(see_room(2.0, 5.5)) == DepthRange(2.0, 5.5)
    # With one plane given, the other is measured as without any.
    alone = find_depth_range(see_room(None, 20.0))
    assert (alone.far, alone.notes) == (20.0, ())
    assert alone.near == find_depth_range(see_room(None, None)).near


def test_wrong_matches_widen_nothing(monkeypatch):
    """One match in twelve is wrong: its point stands anywhere from 0.3 to 1.2."""

    def find_with_wrong_ones(images) -> Neighbours:
        neighbours = find_neighbours(images)
        in_left, in_right = neighbours.matches[0, 1]
        moved = in_right.copy()
        generator = np.random.default_rng(3)
        wrong = generator.permutation(len(moved))[::12]
        assert len(wrong) >= 3
        # The cameras stand side by side: parallax in pixels is focal length x baseline / depth.
        depths = generator.uniform(0.3, 1.2, len(wrong))
        moved[wrong, 0] = in_left[wrong, 0] - 0.9 * SIZE * 0.4 / depths
        return replace(neighbours, matches={(0, 1): (in_left, moved)})

    monkeypatch.setattr(given_range, "find_neighbours", find_with_wrong_ones)
    assert find_depth_range(see_room(1.5, 20.0)) == DepthRange(1.5, 20.0)
    # Beside them, true matches are still believed.
    assert find_depth_range(see_room(CUT, 20.0)).notes


def test_where_few_features_are_matched_the_range_is_believed():
    flat = [replace(v, image=torch.full_like(v.image, 0.5)) for v in see_room(CUT, 20.0)]
    assert find_depth_range(flat) == DepthRange(CUT, 20.0)
    # So it is without a baseline: a Ψ that needs none may have such photographs.
    view, _ = see_room(CUT, 20.0)
    assert find_depth_range([view, view]) == DepthRange(CUT, 20.0)


def test_given_depths_outside_of_the_range_widen_it():
    view, _ = see_room(CUT, 20.0)
    (given,) = [replace(view, depth=None, given_depth=view.depth)]
    found = find_depth_range([given])
    assert found.near < 2.0
    assert found.notes[0].startswith("Given depths stand at 2.2, nearer than the near plane")


def test_given_depths_that_nothing_confirms_move_no_plane_far():
    """A damaged file of depth has any values: the sweep would not hold such a plane."""
    views = see_room(0.5, 20.0)
    damaged = torch.full((SIZE, SIZE), 1e-20)
    found = find_depth_range([replace(view, depth=None, given_depth=damaged) for view in views])
    assert (found.near, found.far) == (0.5, 20.0)
    assert "times outside of the depth range from 0.5 to 20, which is kept" in found.notes[0]


def test_a_trained_network_keeps_its_range_and_the_user_is_told():
    trained = (1.0, 100.0)
    # The range of its authors, as their evaluation gives it
    assert find_depth_range(see_room(*trained), trained, keeps=True) == DepthRange(*trained)
    cut = find_depth_range(see_room(CUT, 100.0), trained, keeps=True)
    assert (cut.near, cut.far) == (CUT, 100.0)
    assert cut.notes[0].endswith(": this model gets the range as it was given.")
    # Without a range the unit of the scene matters.
    assert find_depth_range(see_room(None, None), trained, keeps=True) == DepthRange(*trained)
    small = find_depth_range(see_room(None, None, 0.01), trained, keeps=True)
    assert (small.near, small.far) == trained
    (note,) = small.notes
    assert "this model was trained on 1 to 100: multiply the positions of the cameras by" in note
