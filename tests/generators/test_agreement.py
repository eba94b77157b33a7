"""Comparison of a synthesized image with the photographs: corrected colours, notes on others."""

import pytest
import torch

from gscompleter import InputError
from gscompleter.generators import GeneratorOutput, as_generator
from gscompleter.generators.agreement import compare_with_observed, paint_consistently
from gscompleter.generators.warp import WarpedImage
from gscompleter.generators.warp_inpaint import WarpInpaint
from gscompleter.stages.synthesize import synthesize
from known_room import TARGET, known_room
from scenes import Room, camera_at, view_of

TRUTH = view_of(Room(), camera_at(0.0)).image
SEEN = torch.arange(96).expand(96, 96) < 60
GAIN, OFFSET = torch.tensor([0.9, 1.1, 1.05]), torch.tensor([0.05, -0.04, 0.02])
SHIFTED = (TRUTH - OFFSET) / GAIN
NOISE = torch.rand(96, 96, 3, generator=torch.Generator().manual_seed(0))


def observed() -> WarpedImage:
    """Return the left half of the true image; the right half is unknown."""
    image = torch.where(SEEN[..., None], TRUTH, torch.zeros_like(TRUTH))
    return WarpedImage(image, SEEN, torch.ones(96, 96), torch.ones(0, 3))


def paint_checked(*arguments) -> tuple[torch.Tensor, tuple[str, ...]]:
    """Return the image and the notes of `paint_consistently`."""
    found = paint_consistently(*arguments)
    return found.image, found.notes


def test_a_colour_shift_is_measured_and_taken_back_in_the_unseen_part_too():
    found = compare_with_observed(SHIFTED, observed().image, SEEN)
    assert found.is_consistent
    assert torch.allclose(found.gain, GAIN, atol=0.01)
    assert torch.allclose(found.offset, OFFSET, atol=0.01)
    assert (found.image - TRUTH).abs().max() < 0.01


def test_a_colour_shift_stays_where_the_paper_leaves_it():
    image, notes = paint_checked(lambda seed: SHIFTED, 0, observed(), 0, False)
    assert torch.equal(image, SHIFTED.clamp(0, 1))
    assert notes == ()


def test_a_fifth_of_the_image_that_shows_something_else_does_not_bend_the_colours():
    spoiled = SHIFTED.clone()
    spoiled[:, :12] = 1.0
    found = compare_with_observed(spoiled, observed().image, SEEN)
    assert found.is_consistent
    assert (found.image - TRUTH)[:, 14:].abs().max() < 0.03


def test_an_image_that_agrees_stays_and_is_worth_no_note():
    image, notes = paint_checked(lambda seed: TRUTH, 0, observed())
    assert (image - TRUTH).abs().max() < 1e-3
    assert notes == ()


def test_something_else_is_noted_and_left_as_it_is():
    image, notes = paint_checked(lambda seed: NOISE, 0, observed())
    assert torch.equal(image, NOISE)
    assert len(notes) == 1
    assert "disagrees with the photographs" in notes[0]
    assert "62% of it" in notes[0]


def test_an_image_in_negative_is_no_colour_shift():
    found = compare_with_observed(1 - TRUTH, observed().image, SEEN)
    assert not found.is_consistent
    assert found.residual < found.limit
    _, (note,) = paint_checked(lambda seed: 1 - TRUTH, 0, observed())
    assert "only with channels scaled by -1.00, -1.00" in note


@pytest.mark.parametrize("contrast", [0.5, 1.0])
def test_the_limit_follows_the_contrast_of_the_scene(contrast):
    """The limit is relative to the residual of a constant colour, so that plain grey fails."""
    dull = 0.5 + contrast * (TRUTH - 0.5)
    found = compare_with_observed(dull, dull, SEEN)
    assert found.is_consistent
    assert found.limit == pytest.approx(contrast * compare_with_observed(TRUTH, TRUTH, SEEN).limit)
    grey = compare_with_observed(torch.full_like(TRUTH, 0.5) + 0.01 * NOISE, dull, SEEN)
    assert grey.residual > grey.limit
    assert not grey.is_consistent


def test_a_blank_wall_over_most_of_the_scene_hides_nothing():
    walled = TRUTH.clone()
    walled[:57] = 0.7
    assert compare_with_observed(walled, walled, SEEN).is_consistent
    grey = torch.full_like(TRUTH, 0.7) + 0.001 * NOISE
    assert not compare_with_observed(grey, walled, SEEN).is_consistent
    assert not compare_with_observed(torch.cat([grey[:57], NOISE[57:]]), walled, SEEN).is_consistent


def test_of_images_that_all_disagree_the_nearest_is_kept():
    images = {7: NOISE, 8: 0.5 * NOISE + 0.5 * TRUTH.flip(1), 9: TRUTH.flip(0)}
    found = {
        seed: compare_with_observed(image, observed().image, SEEN) for seed, image in images.items()
    }
    assert not any(one.is_consistent for one in found.values())
    best = min(found, key=lambda seed: found[seed].residual)
    assert len({one.residual for one in found.values()}) == 3
    image, _ = paint_checked(lambda seed: images[seed], 7, observed(), 2)
    assert torch.equal(image, images[best])


def test_a_seed_that_gives_nan_is_passed_over_and_nothing_but_nan_is_refused():
    broken = torch.full_like(TRUTH, float("nan"))
    image, _ = paint_checked(lambda seed: broken if seed == 0 else TRUTH, 0, observed(), 1)
    assert (image - TRUTH).abs().max() < 1e-3
    with pytest.raises(InputError, match=r"no finite image \(2 seed"):
        paint_consistently(lambda seed: broken, 0, observed(), 1)


def test_in_fog_anything_agrees():
    fog = torch.full_like(TRUTH, 0.5) + 0.02 * NOISE
    assert compare_with_observed(torch.full_like(TRUTH, 0.45), fog, SEEN).is_consistent


def test_further_seeds_are_tried_where_asked_and_only_until_one_agrees():
    tried = []

    def paint(seed: int) -> torch.Tensor:
        tried.append(seed)
        return SHIFTED if seed == 9 else NOISE

    image, notes = paint_checked(paint, 7, observed(), 5)
    assert tried == [7, 8, 9]
    assert (image - TRUTH).abs().max() < 0.01
    assert notes == ()
    tried.clear()
    _, notes = paint_checked(paint, 0, observed(), 1)
    assert tried == [0, 1]
    assert "best of 2 seeds" in notes[0]


def test_where_nothing_was_seen_nothing_is_said():
    nothing = WarpedImage(TRUTH, torch.zeros_like(SEEN), torch.ones(96, 96), torch.ones(0, 3))
    image, notes = paint_checked(lambda seed: NOISE, 0, nothing)
    assert torch.equal(image, NOISE)
    assert notes == ()


class Talking:
    """A generator of a user that adds a note."""

    def __call__(self, nearest, target, context):
        image = torch.full((target.height, target.width, 3), 0.5)
        return GeneratorOutput(image, ("Painted grey.",))


def test_the_stage_takes_the_notes_of_a_generator_that_has_some():
    context = known_room()
    assert synthesize(as_generator(Talking()), [(TARGET, context)])[0].notes == ("Painted grey.",)
    assert synthesize(as_generator(WarpInpaint()), [(TARGET, context)])[0].notes == ()
