"""Masks that mean something else than their reader takes them for: inverted, cut out, labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageFilter

from exact_room import make_cameras, write_colmap
from gscompleter import InputError, load_views
from gscompleter.data.formats import open_photographs
from gscompleter.data.mask_checks import (
    MAX_READ,
    are_probably_inverted,
    check_hiding_masks,
    check_selected_share,
    check_selecting_masks,
)
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.sfm.poses import write_upright
from gscompleter.system.files.image import read_mask

WIDTH, HEIGHT = 64, 48
UPPER = slice(0, HEIGHT // 4)
"""Rows of what is to be ignored, a quarter of the photograph."""
DISC = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] - np.array([24, 30])[:, None, None])) < 12
"""Pixels of a thing that was clicked."""
INVERTED = MaskReading(is_inverted=True)
LARGE = MaskReading(may_be_large=True)


def save(path: Path, pixels: np.ndarray, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def paint(inside: np.ndarray, white: int = 255) -> np.ndarray:
    return np.where(inside, white, 0).astype(np.uint8)


def upper_quarter() -> np.ndarray:
    """Return True in the upper quarter of a photograph."""
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[UPPER] = True
    return inside


def write_masked(folder: Path, masks: list[np.ndarray]) -> Path:
    """Write photographs of a room, and masks of the first of them."""
    cameras = make_cameras(4, width=WIDTH, height=HEIGHT, focal=52.0)
    scene = write_colmap(folder, cameras)
    for number, mask in enumerate(masks):
        save(scene / "masks" / f"photo_{number:03d}.png", mask)
    return scene


@pytest.mark.parametrize(
    ("shares", "expected"),
    [([0.75, 0.9, 0.1], True), ([0.75, 0.2], False), ([0.5, 0.5], False), ([0.51], True)],
)
def test_masks_are_probably_inverted_if_most_take_away_more_than_half(shares, expected):
    assert are_probably_inverted(shares) == expected


def test_masks_that_hide_most_of_most_photographs_are_refused_unless_meant_so(tmp_path):
    scene = write_masked(tmp_path / "room", [paint(upper_quarter())] * 4)
    with pytest.raises(InputError) as refusal:
        load_views(scene)
    said = str(refusal.value)
    assert said.startswith("Masks hide 75 % of the photographs (")
    assert said.endswith(
        "masks), where what is black is ignored; if it is the other way round, add --invert-masks; "
        "if it is meant so, add --large-masks, or --no-masks to use all pixels."
    )
    hidden = torch.from_numpy(upper_quarter())
    for view in load_views(scene, large_masks=True):
        assert torch.equal(view.ignore_mask, ~hidden)
    for view in load_views(scene, invert_masks=True):
        assert torch.equal(view.ignore_mask, hidden)


def test_right_masks_that_are_inverted_are_refused_as_well(tmp_path):
    scene = write_masked(tmp_path / "room", [paint(~upper_quarter())] * 4)
    assert load_views(scene)[0].ignore_mask.float().mean() == 0.25
    with pytest.raises(InputError, match="what is white is ignored; .*leave --invert-masks out"):
        load_views(scene, invert_masks=True)


def test_masks_of_some_photographs_tell_and_black_ones_only_leave_theirs_out(tmp_path):
    black = np.zeros((HEIGHT, WIDTH), np.uint8)
    few = write_masked(tmp_path / "few", [black, paint(upper_quarter())])
    with pytest.raises(InputError, match="hide 75 % of the photographs"):
        load_views(few, [2, 3])
    right = write_masked(tmp_path / "right", [black, paint(~upper_quarter())])
    assert load_views(right, [1])[0].ignore_mask.float().mean() == 0.25
    one_black = write_masked(tmp_path / "one", [black])
    assert load_views(one_black, [1])[0].ignore_mask is None
    all_black = write_masked(tmp_path / "black", [black] * 4)
    with pytest.raises(InputError, match=r"masks of the photographs .* are black everywhere, and"):
        load_views(all_black)


def test_nothing_is_inverted_where_there_is_no_mask(tmp_path):
    scene = write_masked(tmp_path / "room", [])
    for path in (scene / "images").iterdir():
        colors = np.asarray(Image.open(path).convert("RGB"))
        save(path, np.dstack([colors, paint(upper_quarter())]))
    with pytest.raises(InputError, match="No mask is used for the photographs"):
        load_views(scene, invert_masks=True)
    # Transparent is always ignored, however much it is.
    assert load_views(scene)[0].ignore_mask.float().mean() == 0.75


def test_masks_named_as_inverted_ones_are_inverted_by_their_name(tmp_path):
    scene = write_masked(tmp_path / "room", [])
    for number in range(4):
        name = f"dynamic_mask_photo_{number:03d}.png"
        save(scene / "images" / name, paint(upper_quarter()))
    assert load_views(scene)[0].ignore_mask.float().mean() == 0.25
    for number in range(4):
        name = f"dynamic_mask_photo_{number:03d}.png"
        save(scene / "images" / name, paint(~upper_quarter()))
    with pytest.raises(InputError, match="hide 75 % .* where what is white is ignored"):
        load_views(scene)
    assert load_views(scene, invert_masks=True)[0].ignore_mask.float().mean() == 0.25


def test_what_goes_is_seldom_most_of_the_images_or_of_the_splat(tmp_path):
    right = save(tmp_path / "right.png", paint(DISC))
    wrong = save(tmp_path / "wrong.png", paint(~DISC))
    black = save(tmp_path / "black.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    check_selecting_masks([right, black], MaskReading(), "the photographs")
    check_selecting_masks([wrong], INVERTED, "the photographs")
    check_selecting_masks([wrong], LARGE, "the photographs")
    with pytest.raises(InputError, match=r"select 86 % of the photographs, .* white goes; if it"):
        check_selecting_masks([wrong, black], MaskReading(), "the photographs")
    with pytest.raises(InputError, match=r"black\.png is black everywhere, and what masks show wh"):
        check_selecting_masks([black], MaskReading(), "the photographs")
    check_selected_share(0.4, MaskReading())
    check_selected_share(0.8, LARGE)
    with pytest.raises(InputError, match="select 80 % of the Gaussians of the splat, where what"):
        check_selected_share(0.8, MaskReading())


def test_the_share_that_a_sentence_names_is_above_half_as_that_of_most(tmp_path):
    wrong = save(tmp_path / "wrong.png", paint(upper_quarter()))
    right = save(tmp_path / "right.png", paint(np.ones((HEIGHT, WIDTH), bool)))
    with pytest.raises(InputError, match="Masks hide 75 % of the photographs"):
        check_hiding_masks([wrong, right, wrong], MaskReading(), 3)


def test_masks_beside_a_sample_that_hides_everything_tell_as_well(tmp_path):
    black = save(tmp_path / "black.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    right = save(tmp_path / "right.png", paint(~upper_quarter()))
    masks = [right] * 100
    for sampled in np.linspace(0, 99, MAX_READ).round().astype(int):
        masks[sampled] = black
    check_hiding_masks(masks, MaskReading(), len(masks))
    with pytest.raises(InputError, match="black everywhere"):
        check_hiding_masks([black] * 100, MaskReading(), 100)


def test_masks_of_which_names_turn_some_are_white_or_black_where_they_hide(tmp_path):
    black = save(tmp_path / "a.png", paint(upper_quarter()))
    white = save(tmp_path / "dynamic_mask_b.png", paint(~upper_quarter()))
    with pytest.raises(InputError, match="75 % .* where what is black or white is ignored"):
        check_hiding_masks([black, white], MaskReading(), 2)


def test_masks_of_another_option_are_not_turned_by_this_one(tmp_path):
    mask = save(tmp_path / "masks/a.png", paint(upper_quarter()))
    with pytest.raises(InputError, match="save them in the other colours; if it is meant so"):
        check_hiding_masks([mask], MaskReading(is_turned_by_option=False), 1)


@pytest.mark.parametrize("brightness", [20, 128, 255])
def test_of_something_cut_out_the_alpha_is_the_mask(tmp_path, brightness):
    """However dark it is, as programs of segmentation export it."""
    texture = np.random.default_rng(0).integers(0, brightness, (HEIGHT, WIDTH, 3), np.uint8)
    cut_out = save(tmp_path / "cut.png", np.dstack([texture, paint(DISC)]))
    assert np.array_equal(read_mask(cut_out), ~DISC)
    over_black = np.dstack([np.where(DISC[..., None], texture, 0), paint(DISC)])
    assert np.array_equal(read_mask(save(tmp_path / "black.png", over_black)), ~DISC)


@pytest.mark.parametrize("alpha", [0, 100, 255])
def test_a_constant_alpha_says_nothing(tmp_path, alpha):
    constant = np.full((HEIGHT, WIDTH), alpha, np.uint8)
    grey = paint(DISC)
    mask = save(tmp_path / "mask.png", np.dstack([grey, grey, grey, constant]))
    assert np.array_equal(read_mask(mask), ~DISC)

    scene = write_masked(tmp_path / "room", [])
    plain = load_views(scene, [0])[0].image
    photograph = scene / "images/photo_000.png"
    colors = np.asarray(Image.open(photograph).convert("RGB"))
    save(photograph, np.dstack([colors, constant]))
    photographs = open_photographs(scene)
    for opened in (photographs, photographs.leave_out_masks()):
        (view,) = opened.views([0])
        assert view.ignore_mask is None
        assert torch.equal(view.image, plain)
    assert not write_upright(scene / "images", "photo_000.png", tmp_path / "copies").is_masked


def label_map() -> np.ndarray:
    labels = np.ones((HEIGHT, WIDTH), np.uint8)
    labels[DISC] = 2
    labels[40:, 40:] = 5
    return labels


def test_a_map_of_labels_is_refused(tmp_path):
    labels = label_map()
    palette = Image.fromarray(labels).convert("P")
    palette.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0, 0, 0, 0, 0, 0, 0, 0, 0, 128])
    palette.save(tmp_path / "palette.png")
    save(tmp_path / "labels.png", labels)
    save(tmp_path / "wide.png", labels.astype(np.uint16) * 300)
    trimap = np.where(upper_quarter(), 128, paint(DISC)).astype(np.uint8)
    save(tmp_path / "trimap.png", trimap)
    named = {"labels": "has 2;", "wide": "has 600;", "trimap": "has 128;", "palette": "has "}
    for name, level in named.items():
        sentence = f"{name}.png is no mask .* a map of labels: .*{level}"
        with pytest.raises(InputError, match=sentence):
            read_mask(tmp_path / f"{name}.png")


def test_soft_and_compressed_edges_are_no_labels(tmp_path):
    # Large enough for flat blocks of a JPEG, and for a wide edge.
    mask = Image.fromarray(paint(DISC)).resize((640, 480), Image.Resampling.BICUBIC)
    expected = np.asarray(mask) < 128
    masks = {
        "soft.png": mask.filter(ImageFilter.GaussianBlur(12)),
        "coarse.png": mask.resize((80, 60), Image.Resampling.BOX).resize((640, 480), 0),
        "compressed.jpg": mask,
        "grey.png": mask.point(lambda value: value // 2),
    }
    for name, image in masks.items():
        image.save(tmp_path / name, **({"quality": 30} if name.endswith("jpg") else {}))
        assert (read_mask(tmp_path / name) == expected).mean() > 0.99, name
    gradient = np.tile(np.linspace(0, 255, 640).astype(np.uint8), (480, 1))
    assert 0.4 < read_mask(save(tmp_path / "gradient.png", gradient)).mean() < 0.6


@pytest.mark.parametrize("quality", [50, 75, 95])
@pytest.mark.parametrize("color", [(255, 0, 0), (255, 255, 0), (192, 128, 0), (128, 128, 128)])
def test_a_compressed_mask_of_one_colour_on_black_is_a_mask(tmp_path, color, quality):
    """Edges of a JPEG overshoot a colour; of pure white and black the overshoot is cut off."""
    rows, columns = np.mgrid[:240, :320]
    inside = np.hypot(rows - 120, columns - 160) + 20 * np.sin(columns / 9) < 80
    colors = np.where(inside[..., None], np.array(color), 0).astype(np.uint8)
    Image.fromarray(colors).save(tmp_path / "mask.jpg", quality=quality, subsampling=0)
    assert (read_mask(tmp_path / "mask.jpg") == ~inside).mean() > 0.98


def test_a_compressed_map_of_labels_is_refused(tmp_path):
    labels = np.zeros((240, 320, 3), np.uint8)
    labels[40:200, 40:120] = (192, 128, 0)
    labels[40:200, 180:280] = (0, 128, 192)
    Image.fromarray(labels).save(tmp_path / "labels.jpg", quality=75)
    with pytest.raises(InputError, match="is no mask .* a map of labels"):
        read_mask(tmp_path / "labels.jpg")


def test_copies_for_colmap_are_masked_as_the_user_means_it(tmp_path):
    save(tmp_path / "a.png", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    mask = save(tmp_path / "mask.png", paint(upper_quarter()))
    assert write_upright(tmp_path, "a.png", tmp_path, mask, INVERTED).is_masked
    written = np.asarray(Image.open(tmp_path / "masks/a.png.png"))
    assert np.array_equal(written == 0, upper_quarter())
