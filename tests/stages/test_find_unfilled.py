"""The part of a hole that stays empty is measured, and the step that lost it is named."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from gscompleter import GSCompleter
from gscompleter.apps.report.plain_words import describe_losses
from gscompleter.apps.report.schema import UnfilledRow
from gscompleter.completer import check_any_completed
from gscompleter.guards.psnr import PsnrGuard
from gscompleter.numerics.image_ops import find_largest_regions
from gscompleter.state import Completion
from gscompleter.target_result import Unfilled
from scenes import Room, camera_at, view_of

SIZE = 48


@cache
def begun() -> Completion:
    """Begin with two photographs of the room."""
    return GSCompleter().begin([view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, 0.0)])


def complete() -> Completion:
    """Complete the room at a camera beside the photographs."""
    done = GSCompleter().advance(begun(), camera_at(0.6, size=SIZE))
    check_any_completed(done)
    return done


def test_a_filled_hole_leaves_nothing_to_say():
    (result,) = complete().targets
    assert result.hole_fraction > 0.05
    assert result.unfilled.share <= Unfilled.MAX_SHARE
    assert result.unfilled.describe() == ""


def test_the_guard_that_empties_a_part_is_named_with_its_place(monkeypatch):
    kept = []

    def drop_right_half(self, added, attempt):
        kept.append(added.means[:, 0] < added.means[:, 0].median())
        return added[kept[-1]]

    monkeypatch.setattr(PsnrGuard, "verify", drop_right_half)
    (result,) = complete().targets
    left = result.unfilled
    assert left.share > 0.2
    assert set(left.lost_by) == {"psnr"}
    assert left.lost_by["psnr"] == pytest.approx(left.share, abs=0.01)
    (note,) = [note for note in result.notes if "of the hole" in note]
    share = round(100 * left.share)
    reason = "a filling would make given photographs worse"
    assert note == f"{share} % of the hole stays empty, because {reason}."
    assert note in result.warnings
    (details,) = describe_losses(UnfilledRow(**vars(left)))
    assert f"x {left.regions[0][0]} to {left.regions[0][2]}" in details
    assert "psnr " in details


def test_what_stays_empty_is_a_sentence_for_people_and_a_warning_only_if_it_is_much():
    few = Unfilled(0.021, {"psnr": 0.019, "removal": 0.001}, ((67, 39, 71, 45),))
    assert few.describe() == (
        "2 % of the hole stays empty, mostly because a filling would make given photographs worse."
    )
    (done,) = complete().targets
    assert few.describe() in replace(done, unfilled=few).notes
    assert replace(done, unfilled=few).warnings == ()
    many = replace(few, share=0.3)
    assert replace(done, unfilled=many).warnings == (many.describe(),)


def test_regions_are_the_largest_first_and_count_from_the_corner_of_the_target():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[2:4, 3:5] = True
    mask[10:16, 20:30] = True
    assert find_largest_regions(mask, -5, -2) == ((15, 8, 25, 14), (-2, 0, 0, 2))
    assert find_largest_regions(mask[:1], 0, 0) == ()
