"""The part of a hole that stays empty is measured, and the step that lost it is named."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from gscompleter import GSCompleter
from gscompleter.apps.report.plain_words import describe_empty_part
from gscompleter.apps.report.schema import UnfilledRow
from gscompleter.completer import check_any_completed
from gscompleter.config import CompleterConfig
from gscompleter.guards.psnr import PsnrGuard
from gscompleter.numerics.image_ops import find_largest_regions
from gscompleter.stages.additions import Step
from gscompleter.stages.find_unfilled import find_unfilled
from gscompleter.state import Completion
from gscompleter.target_result import NOTHING_ADDED, Rejection, Unfilled
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
    (details,) = describe_empty_part(UnfilledRow(left.share, left.lost_by, left.regions))
    assert f"x {left.regions[0][0]} to {left.regions[0][2]}" in details
    assert "psnr " in details


GUARD = """
import gscompleter as gsc


class Curfew(gsc.Guard):
    name = "curfew"
{loss}

    def place(self, candidates, view):
        return candidates[:0]
"""


@pytest.mark.parametrize(
    ("loss", "reason"),
    [("    loss = 'it is night'", "it is night"), ("", "the step curfew left it out")],
)
def test_a_guard_of_a_user_explains_its_losses(tmp_path, loss, reason):
    (tmp_path / "curfew.py").write_text(GUARD.format(loss=loss))
    config = replace(CompleterConfig(), guards=(f"{tmp_path / 'curfew.py'}:Curfew",))
    views = [photo.view for photo in begun().photos]
    (result,) = GSCompleter(config=config)(views, camera_at(0.6, size=SIZE)).targets
    assert set(result.unfilled.lost_by) == {"curfew"}
    assert result.unfilled.describe().endswith(f"of the hole stays empty, because {reason}.")


def test_steps_of_the_paper_are_explained_and_the_worst_is_said():
    """What the filter of Eq. 12 drops lies beside the hole; a later guard loses less."""
    (result,) = complete().targets
    nothing = result.added[:0]
    state = begun()
    view = GSCompleter().observe(state, camera_at(0.6, size=SIZE))
    before = view.frozen.composite(nothing)
    steps = [Step("lift", result.added), Step("filter", nothing), Step("curfew", nothing, "x")]
    left = find_unfilled(before, steps, view)
    assert set(left.lost_by) <= {"lift", "filter"}
    assert left.lost_by["filter"] > 0.5
    assert left.reason == "what was made for it lies beside the hole"


def test_what_stays_empty_is_a_sentence_for_people_and_a_warning_only_if_it_is_much():
    lost = {"psnr": 0.019, "removal": 0.001}
    few = Unfilled(0.021, lost, ((67, 39, 71, 45),), PsnrGuard.loss)
    assert few.describe() == (
        "2 % of the hole stays empty, mostly because a filling would make given photographs worse."
    )
    (done,) = complete().targets
    assert few.describe() in replace(done, unfilled=few).notes
    assert replace(done, unfilled=few).warnings == ()
    many = replace(few, share=0.3)
    assert replace(done, unfilled=many).warnings == (many.describe(),)


def test_warnings_are_some_of_the_notes():
    """The page lists the others beside them, so that each is there once."""
    (done,) = complete().targets
    said = ("Photographs contradict the image.", "Their exposures differ.")
    agreement = Rejection("image-agreement")
    rejected = replace(done, synthesis_notes=said, rejection=agreement, unfilled=Unfilled())
    assert rejected.warnings == (*said, NOTHING_ADDED)
    assert set(rejected.warnings) <= set(rejected.notes)
    why = replace(rejected, rejection=Rejection("mine", "It is upside down."))
    assert why.warnings == ("It is upside down.", NOTHING_ADDED)


def test_regions_are_the_largest_first_and_count_from_the_corner_of_the_target():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[2:4, 3:5] = True
    mask[10:16, 20:30] = True
    assert find_largest_regions(mask, -5, -2) == ((15, 8, 25, 14), (-2, 0, 0, 2))
    assert find_largest_regions(mask[:1], 0, 0) == ()
