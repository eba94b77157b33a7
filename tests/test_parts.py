"""Parts of a completion: labels and counts follow from their origins."""

from dataclasses import replace

import pytest
import torch

from gscompleter.evaluation.verdict.outcome import judge_completion
from gscompleter.parts import (
    NOT_INVENTED,
    PartOrigin,
    find_last_target_id,
    make_part,
    split_into_parts,
)
from gscompleter.state import Completion
from gscompleter.types import ContextScene, merge
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of
from target_views import begin_with

VIEWS = [view_of(Room(), camera_at(x, size=16)) for x in (-0.2, 0.2)]
SCENE = merge([gaussians_of(view) for view in VIEWS])
PIECES = make_part(PartOrigin("piece"), random_gaussians(3))
SHOWN = make_part(PartOrigin("photographs"), random_gaussians(5))
FILLED = make_part(PartOrigin("target", 7), random_gaussians(11))
CLOSED = make_part(PartOrigin("gap", 7), random_gaussians(2))


@pytest.mark.parametrize(
    ("part", "label", "is_invented"),
    [(PIECES, 255, False), (SHOWN, 255, False), (FILLED, 7, True), (CLOSED, 7, True)],
)
def test_what_was_invented_has_the_number_of_its_target_and_all_else_255(part, label, is_invented):
    assert (part.gaussians.generated == label).all()
    assert part.origin.is_invented is is_invented


@pytest.mark.parametrize(("kind", "number"), [("target", 0), ("gap", 0), ("piece", 2)])
def test_what_was_invented_and_nothing_else_has_the_number_of_a_target(kind, number):
    with pytest.raises(ValueError, match=f"the kind {kind} has no target with the number {number}"):
        PartOrigin(kind, number)


def test_the_last_target_is_found_among_all_labels():
    assert find_last_target_id(merge([SCENE, SHOWN.gaussians])) == 0
    assert find_last_target_id(merge([SHOWN.gaussians, FILLED.gaussians])) == 7


def test_changed_gaussians_keep_their_origins():
    parts = [PIECES, FILLED, CLOSED]
    changed = merge([replace(part.gaussians, encoded=None) for part in parts])
    again = list(split_into_parts(changed, parts))
    assert [part.origin for part in again] == [part.origin for part in parts]
    assert torch.equal(again[1].gaussians.means, FILLED.gaussians.means)


def add(*parts) -> Completion:
    return replace(begin_with(SCENE, VIEWS), added_parts=parts, is_given=True)


def remove_row(state: Completion) -> Completion:
    """Remove the first Gaussian of the context."""
    first = torch.arange(len(SCENE)) == 0
    index = (torch.arange(len(SCENE)) - 1).clamp_min(0)
    source = replace(ContextScene.build(SCENE, SCENE[1:], index), chosen_mask=first)
    return replace(state, source=source, rendered_context=source.rendered)


def test_counts_are_those_of_the_scene():
    state = add(PIECES, SHOWN, FILLED, CLOSED)
    assert (state.num_observed, state.num_invented) == (5, 13)
    assert len(state.added) == 21
    # What a removal takes out is counted no more.
    left = replace(state, added_parts=(PIECES, replace(SHOWN, gaussians=SHOWN.gaussians[:2])))
    assert (left.num_observed, left.num_invented) == (2, 0)


def test_a_removal_whose_place_is_empty_is_not_called_filled():
    headline = judge_completion(remove_row(add(SHOWN, PIECES)), []).headline
    assert headline == (
        "The selection is removed, and its place is not filled; 5 Gaussians from photographs, "
        "none invented."
    )
    headline = judge_completion(remove_row(add(SHOWN, PIECES, FILLED)), []).headline
    assert headline.startswith("The selection is removed and its place is filled")
    assert headline.endswith("; 5 Gaussians from photographs, 11 invented.")


def test_rows_that_are_gone_have_no_values():
    source = remove_row(add()).source
    assert source.proxy_index.min() >= 0
    expanded = source.expand(torch.ones(len(source.rendered)))
    assert torch.equal(expanded, (~source.gone_mask).float())


def test_new_colours_are_told_from_colours_and_not_from_labels():
    """A splat that was completed from photographs before is recoloured to further ones."""
    scene = replace(SCENE, generated=torch.full_like(SCENE.generated, NOT_INVENTED))
    rows = torch.arange(len(scene)) < 9
    dyed = replace(scene, sh=scene.sh + 0.1 * rows[:, None, None])
    state = replace(begin_with(scene, VIEWS), rendered_context=dyed)
    assert torch.equal(state.recolored_mask, rows)
    assert torch.equal(state.scene.sh, dyed.sh)
