"""Φ of any painter: what was asked for counts, and the rest tells whether it shows the target."""

import pytest
import torch

from gscompleter import InputError, load_generator
from gscompleter.config.generators import PaintedSettings
from gscompleter.generators import GeneratorRequest
from gscompleter.generators.painted import (
    Painted,
    Painting,
    fit_mask,
    fit_painting,
)
from gscompleter.generators.warp import BORDER_WIDTH
from gscompleter.numerics.image_ops import dilate
from gscompleter.types import View
from known_room import SIZE, TARGET, known_room
from scenes import Room, camera_at, view_of

CONTEXT = known_room()
TRUTH = view_of(Room(), TARGET).image
RIM = dilate(CONTEXT.holes, BORDER_WIDTH)
SCENE = CONTEXT.known_colors


def pasted() -> torch.Tensor:
    """Return the image as the scene shows it, with the truth in the mask."""
    return torch.where(RIM[..., None], TRUTH, CONTEXT.target_render.image)


def use(painting: View):
    (output,) = Painted((painting,), "someone").synthesize(
        [GeneratorRequest(CONTEXT.views[1], TARGET, CONTEXT)]
    )
    return output


def test_the_mask_is_painted_and_the_rest_is_the_scene():
    output = use(Painting(pasted(), TARGET))
    assert (output.image - TRUTH)[RIM].abs().max() < 0.02
    assert torch.equal(output.image[~RIM], SCENE[~RIM])
    assert output.notes == ()
    assert output.painter == "someone"
    assert not output.is_photograph


def test_the_exposure_of_the_painting_is_that_of_the_scene():
    """A program that made everything darker and redder is corrected by what it did not paint."""
    gain = torch.tensor([0.9, 0.75, 0.8])
    plain = use(Painting(TRUTH, TARGET)).image
    darker = use(Painting(gain * TRUTH, TARGET)).image
    assert (darker - plain)[RIM].abs().mean() < 0.1 * (gain * TRUTH - TRUTH)[RIM].abs().mean()


def test_a_change_outside_of_the_mask_is_told_and_has_no_effect():
    """A box is painted onto the wall that photographs show."""
    box = (slice(30, 50), slice(10, 30))
    assert not RIM[box].any()
    image = pasted()
    image[box] = torch.tensor([1.0, 0.0, 1.0])
    output = use(Painting(image, TARGET, name="target3.png"))
    assert torch.equal(output.image[~RIM], SCENE[~RIM])
    (note,) = output.notes
    assert note.startswith("Outside of its mask, target3.png differs from the scene in ")
    left, right = (int(word) for word in note.partition("x ")[2].split(",")[0].split(" to "))
    assert abs(left - 10) <= 4
    assert abs(right - 30) <= 4


def test_the_last_pixel_of_a_difference_is_inside_of_the_image():
    image = pasted()
    image[-12:, :20] = torch.tensor([1.0, 0.0, 1.0])
    (note,) = use(Painting(image, TARGET)).notes
    assert f" to {SIZE - 1})" in note
    assert "(largest regions, in pixels: x 0 to " in note


def test_the_image_of_another_camera_is_refused():
    other = view_of(Room(), camera_at(-0.5, yaw=-20, size=SIZE)).image
    with pytest.raises(InputError, match=r"^a\.png does not show what its camera sees"):
        use(Painting(other, TARGET, name="a.png"))


def test_each_reason_of_a_refusal_has_its_own_sentence():
    with pytest.raises(InputError, match=r"shifted by .* paint it in the exposure of the scene"):
        use(Painting(pasted() / 2, TARGET))
    spoilt = pasted()
    spoilt[0, 0] = torch.nan
    with pytest.raises(InputError, match="not finite"):
        use(Painting(spoilt, TARGET))


def test_what_is_transparent_continues_the_border():
    transparent = torch.zeros_like(RIM)
    transparent[:, : SIZE // 2] = True
    marked = torch.tensor([1.0, 0.0, 1.0]).expand(SIZE, SIZE, 3)
    image = torch.where(RIM[..., None], marked, pasted())
    image = torch.where(transparent[..., None], 0.0, image)
    whole = use(Painting(torch.where(RIM[..., None], marked, pasted()), TARGET)).image
    output = use(Painting(image, TARGET, ignore_mask=transparent, name="layer.png"))
    is_open = CONTEXT.holes & transparent
    assert is_open.any()
    assert torch.equal(output.image[~transparent], whole[~transparent])
    assert (output.image - marked)[is_open].abs().mean() > 0.3
    assert "layer.png leaves " in output.notes[0]


def test_what_an_earlier_target_filled_in_another_way_is_no_difference():
    """The mask of the export is larger than the hole that is left."""
    box = (slice(30, 50), slice(10, 30))
    asked = RIM.clone()
    asked[box] = True
    image = pasted()
    image[box] = torch.tensor([1.0, 0.0, 1.0])
    output = use(Painting(image, TARGET, asked=asked))
    assert output.notes == ()
    assert torch.equal(output.image[~RIM], SCENE[~RIM])


def test_a_target_without_a_painting_is_refused():
    other = Painting(TRUTH, camera_at(0.1, size=SIZE))
    with pytest.raises(InputError, match="has 1 image, none of them painted for the target"):
        use(other)


def test_it_is_one_generator_among_others():
    phi = load_generator(
        "painted", photographs=[View(pasted(), TARGET)], settings=PaintedSettings("me")
    )
    (output,) = phi.synthesize([GeneratorRequest(CONTEXT.views[1], TARGET, CONTEXT)])
    assert torch.equal(output.image, use(Painting(pasted(), TARGET)).image)
    assert output.painter == "me"
    assert not phi.supports_padding
    with pytest.raises(InputError, match="painter "):
        load_generator("painted", settings=PaintedSettings(""))


def test_a_painting_of_any_size_is_scaled():
    large = TRUTH.repeat_interleave(3, dim=0).repeat_interleave(3, dim=1)
    whole = torch.ones(large.shape[:2], dtype=torch.bool)
    painting = fit_painting(large, whole, TARGET, "large.png")
    assert (painting.image - TRUTH).abs().mean() < 0.02
    assert painting.ignore_mask is None
    assert torch.equal(fit_mask(whole, TARGET, "mask.png"), torch.ones_like(RIM))
    with pytest.raises(InputError, match=r"^large\.png has 288 x 279 pixels, and its target 96"):
        fit_painting(large[:-9], whole[:-9], TARGET, "large.png")


def test_transparent_pixels_do_not_bleed_into_painted_ones():
    """Below what is transparent, programs keep any colour."""
    white = torch.ones(2 * SIZE, 2 * SIZE, 3)
    opaque = torch.zeros(2 * SIZE, 2 * SIZE, dtype=torch.bool)
    opaque[:, 31:] = True
    colors = white * torch.where(opaque, 0.5, 1.0)[..., None]
    painting = fit_painting(colors, opaque, TARGET, "layer.png")
    painted = painting.valid_mask
    assert abs(int(painted[0].sum()) - (SIZE - 15)) <= 1
    assert (painting.image[painted] - 0.5).abs().max() < 0.01
