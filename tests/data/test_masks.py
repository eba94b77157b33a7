"""Masks and alpha channels of photographs, however programs store them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from exact_room import ExactCamera, make_cameras, write_colmap, write_transforms
from gscompleter import InputError
from gscompleter.data.cameras import Intrinsics
from gscompleter.data.file_names import FolderListings
from gscompleter.data.formats import open_photographs
from gscompleter.data.frame import Frame, locate_images
from gscompleter.data.masks import (
    fill_hidden,
    find_mask,
    find_masks_in,
    leave_out_masks,
    load_mask,
)
from gscompleter.data.sfm.poses import list_all_photographs, write_upright
from gscompleter.system.files.image import ORIENTATION, read_mask, read_pixels

WIDTH, HEIGHT = 64, 48
HIDDEN_ROWS = HEIGHT // 4
LURE = (255, 0, 255)
"""Colour below masks that no surface of the room has."""


def small_cameras(count: int = 3, **lens: object) -> list[ExactCamera]:
    return make_cameras(count, width=WIDTH, height=HEIGHT, focal=52.0, **lens)


def upper_quarter(white: int = 255, black: int = 0) -> np.ndarray:
    """Make a mask that hides the upper quarter."""
    mask = np.full((HEIGHT, WIDTH), white, np.uint8)
    mask[:HIDDEN_ROWS] = black
    return mask


def spoil(photograph: Path) -> None:
    """Paint the upper quarter of a photograph in a colour that must not be seen again."""
    with Image.open(photograph) as image:
        pixels = np.array(image.convert("RGB"))
    pixels[:HIDDEN_ROWS] = LURE
    Image.fromarray(pixels).save(photograph)


def save(path: Path, mask: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path)


def hide_by(name: str) -> Callable[[Path], None]:
    def hide(scene: Path) -> None:
        save(scene / name, upper_quarter())

    return hide


def hide_by_dynamic_mask(scene: Path) -> None:
    save(scene / "images/dynamic_mask_photo_000.png", upper_quarter(0, 255))


def hide_by_alpha(scene: Path) -> None:
    photograph = scene / "images/photo_000.png"
    colors = np.asarray(Image.open(photograph))
    Image.fromarray(np.dstack([colors, upper_quarter()])).save(photograph)


def hide_by_palette(scene: Path) -> None:
    """Use a colour of a palette as the transparent one."""
    photograph = scene / "images/photo_000.png"
    pixels = np.array(Image.open(photograph))
    pixels[:HIDDEN_ROWS] = LURE
    palette = Image.fromarray(pixels).quantize(256, method=Image.Quantize.MEDIANCUT)
    index = np.asarray(palette)[0, 0].item()
    palette.save(photograph, transparency=index)


def hide_by_mask_path(scene: Path) -> None:
    save(scene / "elsewhere/first.png", upper_quarter())
    content = json.loads((scene / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = "elsewhere\\first.png"
    (scene / "transforms.json").write_text(json.dumps(content))


WAYS = {
    "masks/NAME.png": hide_by("masks/photo_000.png"),
    "masks/NAME.png.png": hide_by("masks/photo_000.png.png"),
    "mask/NAME_mask.png": hide_by("mask/photo_000_mask.png"),
    "masks/images/NAME.png": hide_by("masks/images/photo_000.png"),
    "images/masks/NAME.png": hide_by("images/masks/photo_000.png"),
    "Masks/NAME.PNG": hide_by("Masks/PHOTO_000.PNG"),
    "images/NAME_mask.png": hide_by("images/photo_000_mask.png"),
    "images/NAME.mask.png": hide_by("images/photo_000.mask.png"),
    "images/NAME.png.png": hide_by("images/photo_000.png.png"),
    "dynamic_mask_NAME.png": hide_by_dynamic_mask,
    "alpha": hide_by_alpha,
    "transparent colour": hide_by_palette,
}


@pytest.mark.parametrize("write", [write_colmap, write_transforms])
@pytest.mark.parametrize("way", WAYS)
def test_a_photograph_is_hidden_where_its_mask_is_black(tmp_path, write, way):
    scene = write(tmp_path / "room", small_cameras())
    spoil(scene / "images/photo_000.png")
    if "Masks" in way:
        (scene / "masks").mkdir()  # a folder of other masks, whose case fits better
    WAYS[way](scene)
    if "Masks" in way:
        (scene / "masks").rmdir()
        (scene / "Masks").rename(scene / "masks")
    photographs = open_photographs(scene)
    assert len(photographs) == 3
    view, other = photographs.views([0, 1])
    assert torch.equal(~view.ignore_mask, torch.from_numpy(upper_quarter() > 0))
    assert other.ignore_mask is None
    said = photographs.describe_masks([0, 1])
    assert said is not None
    assert re.search(r"\bof 1 photograph\b", said)
    assert photographs.describe_masks([1, 2]) is None


def test_mask_path_of_windows_is_read(tmp_path):
    scene = write_transforms(tmp_path, small_cameras())
    hide_by_mask_path(scene)
    (view,) = open_photographs(scene).views([0])
    assert torch.equal(~view.ignore_mask, torch.from_numpy(upper_quarter() > 0))


@pytest.mark.parametrize("resolution", [None, (18, 24), 40])
def test_nothing_of_what_a_mask_hides_is_left_in_the_view(tmp_path, resolution):
    """Not even next to the border, where resizing mixes neighbours."""
    lens = {"model": "OPENCV", "distortion": (-0.05, 0.01, 0.0, 0.0)}
    scene = write_transforms(tmp_path, small_cameras(**lens))
    clean = open_photographs(scene).views([0], resolution)[0].image
    spoil(scene / "images/photo_000.png")
    hide_by("masks/photo_000.png")(scene)
    (view,) = open_photographs(scene).views([0], resolution)
    valid = view.valid_mask
    assert 0.7 < valid.float().mean() < 0.85
    # Where neither the mask nor its border is, the photograph is as it was without a mask.
    assert (view.image - clean)[valid].abs().mean() < 0.004
    lured = (view.image - torch.tensor(LURE) / 255).abs().amax(dim=-1) < 0.3
    assert not lured.any()


def test_masks_of_zeros_and_ones_and_soft_masks_mean_the_same(tmp_path):
    expected = upper_quarter() == 0
    soft = upper_quarter().copy()
    soft[HIDDEN_ROWS - 1] = 100
    soft[HIDDEN_ROWS] = 200
    wide = (upper_quarter().astype(np.uint16) > 0).astype(np.uint16)
    for name, mask in (
        ("ones.png", upper_quarter(white=1)),
        ("soft.png", soft),
        ("wide.png", wide),
        ("one_bit.png", upper_quarter() > 0),
        ("alpha.png", np.dstack([np.full((HEIGHT, WIDTH, 3), 255, np.uint8), upper_quarter()])),
    ):
        save(tmp_path / name, mask)
        assert np.array_equal(read_mask(tmp_path / name), expected), name
    save(tmp_path / "black.png", np.zeros((4, 4), np.uint8))
    assert read_mask(tmp_path / "black.png").all()


@pytest.mark.parametrize("speck", [255, 254, 128])
def test_colours_are_the_mask_where_alpha_makes_nothing_transparent(tmp_path, speck):
    """Editors that scale or flatten a picture leave specks that are not quite opaque."""
    colors = np.repeat(upper_quarter()[..., None], 3, axis=-1)
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[0, 0] = speck
    save(tmp_path / "mask.png", np.dstack([colors, alpha]))
    assert np.array_equal(read_mask(tmp_path / "mask.png"), upper_quarter() == 0)


def test_a_mask_of_another_size_is_scaled_and_of_another_shape_refused(tmp_path):
    scene = write_transforms(tmp_path, small_cameras())
    mask = scene / "masks/photo_000.png"
    save(mask, np.kron(upper_quarter(), np.ones((2, 2), np.uint8)))
    (view,) = open_photographs(scene).views([0])
    assert torch.equal(~view.ignore_mask, torch.from_numpy(upper_quarter() > 0))
    for shape in ((HEIGHT, HEIGHT), (WIDTH, HEIGHT), (9, 500)):
        save(mask, np.full(shape, 255, np.uint8))
        with pytest.raises(InputError, match=r"The mask .* another aspect ratio; export the mask"):
            open_photographs(scene).views([0])


def test_a_mask_of_the_stored_pixels_is_turned_with_its_photograph(tmp_path):
    save(tmp_path / "stored.png", upper_quarter())
    turned = load_mask(tmp_path / "stored.png", (HEIGHT, WIDTH), "x", orientation=6)
    assert np.array_equal(turned, np.rot90(upper_quarter() == 0, -1))
    save(tmp_path / "upright.png", upper_quarter())
    upright = load_mask(tmp_path / "upright.png", (WIDTH, HEIGHT), "x", orientation=6)
    assert np.array_equal(upright, upper_quarter() == 0)


def test_hidden_pixels_take_the_nearest_colours():
    pixels = np.zeros((5, 6, 3), np.uint8)
    pixels[:, 0] = 10
    pixels[:, 5] = 200
    hidden = np.zeros((5, 6), bool)
    hidden[:, 1:5] = True
    filled = fill_hidden(pixels, hidden)
    assert filled[..., 0].tolist() == [[10, 10, 10, 200, 200, 200]] * 5
    assert np.array_equal(fill_hidden(pixels, np.ones((5, 6), bool)), pixels)


def test_masks_beside_photographs_are_no_photographs(tmp_path):
    names = ["a.jpg", "a_mask.png", "a.jpg.png", "dynamic_mask_a.png", "b_mask.png", "c.mask.png"]
    assert leave_out_masks(names) == ["a.jpg", "b_mask.png", "c.mask.png"]
    for name in names:
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    assert list_all_photographs(tmp_path) == ["a.jpg", "b_mask.png", "c.mask.png"]


def test_masks_of_another_camera_with_the_same_file_names_are_not_taken(tmp_path):
    for name in ("images/left/0.png", "images/right/0.png", "masks/left/0.png"):
        save(tmp_path / name, upper_quarter())
    listings = FolderListings()
    left = find_mask(tmp_path / "images/left/0.png", "left/0.png", listings)
    assert left == tmp_path / "masks/left/0.png"
    assert find_mask(tmp_path / "images/right/0.png", "right/0.png", listings) is None


def test_copies_for_colmap_take_their_masks_and_alpha_along(tmp_path):
    """Turned upright like the photographs, named as COLMAP wants them, and shrunk with them."""
    image = Image.new("RGB", (WIDTH, HEIGHT), "red")
    exif = image.getexif()
    exif[ORIENTATION] = 6
    image.save(tmp_path / "turned.jpg", exif=exif)
    save(tmp_path / "mask.png", upper_quarter())
    copy = write_upright(tmp_path, "turned.jpg", tmp_path, tmp_path / "mask.png")
    assert copy.is_masked
    written = np.asarray(Image.open(tmp_path / "masks/turned.jpg.png"))
    assert np.array_equal(written == 0, np.rot90(upper_quarter() == 0, -1))
    Image.fromarray(np.dstack([np.full((HEIGHT, WIDTH, 3), 9, np.uint8), upper_quarter()])).save(
        tmp_path / "clear.png"
    )
    assert write_upright(tmp_path, "clear.png", tmp_path).is_masked
    written = np.asarray(Image.open(tmp_path / "masks/clear.png.png"))
    assert np.array_equal(written, upper_quarter())
    image.save(tmp_path / "whole.png")
    assert not write_upright(tmp_path, "whole.png", tmp_path).is_masked


def test_copies_for_colmap_scale_grey_of_16_bits(tmp_path):
    grey = np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 21
    Image.fromarray(grey).save(tmp_path / "grey.png")
    write_upright(tmp_path, "grey.png", tmp_path)
    written = read_pixels(tmp_path / "images/grey.png")
    assert np.array_equal(written, read_pixels(tmp_path / "grey.png"))
    assert written.min() < 10
    assert written.max() > 240


def test_a_mask_of_a_named_folder_lies_there_by_path_or_by_name(tmp_path):
    for name in ("a/x.png", "y.jpg.png"):
        save(tmp_path / name, np.zeros((4, 4), np.uint8))
    found = find_masks_in(tmp_path, ["a/x.jpg", "b/y.jpg", "z.jpg"], [None] * 3)
    assert found == [tmp_path / "a/x.png", tmp_path / "y.jpg.png", None]


def make_files(folder: Path, *names: str) -> list[Path]:
    """Write images of one pixel below a folder, and return their paths."""
    paths = [folder / name for name in names]
    for path in paths:
        save(path, np.zeros((1, 1), np.uint8))
    return paths


def test_no_photograph_is_a_mask_of_itself_or_of_another(tmp_path):
    names = ["a.jpg", "b/a.jpg", "c.png"]
    photographs = make_files(tmp_path, *names)
    assert find_masks_in(tmp_path, names, photographs) == [None, None, None]
    beside, below = make_files(tmp_path, "a.jpg.png", "b/a.png")
    assert find_masks_in(tmp_path, names, photographs) == [beside, below, None]


@pytest.mark.parametrize("name", ["../images/a.jpg", "..\\images\\a.jpg", "/HOME/images/a.jpg"])
def test_masks_are_looked_for_in_the_folder_that_was_named(tmp_path, name):
    name = name.replace("/HOME", str(tmp_path))
    photographs = make_files(tmp_path, "images/a.jpg")
    (mask, _) = make_files(tmp_path, "goes/a.png", "images/a.jpg.png")
    assert find_masks_in(tmp_path / "goes", [name], photographs) == [mask]
    mask.unlink()
    assert find_masks_in(tmp_path / "goes", [name], photographs) == [None]


def test_a_mask_of_several_photographs_is_refused(tmp_path):
    names = ["cam0/1.jpg", "cam1/1.jpg"]
    photographs = make_files(tmp_path / "images", *names)
    make_files(tmp_path / "masks", "1.png")
    with pytest.raises(InputError, match=r"1\.png may be the mask of several photographs"):
        find_masks_in(tmp_path / "masks", names, photographs)
    same = [photographs[0], photographs[0]]
    assert None not in find_masks_in(tmp_path / "masks", names, same)
    names.append("1.jpg")
    photographs += make_files(tmp_path / "images", "1.jpg")
    found = find_masks_in(tmp_path / "masks", names, photographs)
    assert [mask is None for mask in found] == [True, True, False]


def test_a_mask_beside_a_scene_of_another_machine_is_of_one_photograph(tmp_path):
    frames = [
        Frame(f"/home/a/data/{name}", name, np.eye(4), Intrinsics(None, (1.0, 1.0)), None)
        for name in ("cam0/1.jpg", "cam1/1.jpg")
    ]
    make_files(tmp_path / "images", "cam0/1.jpg")
    (mask,) = make_files(tmp_path / "masks", "1.png")
    found = locate_images(frames, [tmp_path])
    # The other photograph is missing.
    assert [frame.mask for frame in found] == [mask, None]
    assert found[0].name == "cam0/1.jpg"
    make_files(tmp_path / "images", "cam1/1.jpg")
    with pytest.raises(InputError, match=r"1\.png may be the mask of several photographs"):
        locate_images(frames, [tmp_path])
    # A name with no more than a drive is one of another machine as well.
    (other,) = make_files(tmp_path / "images", "2.jpg")
    (moved,) = locate_images([replace(frames[0], name="D:\\2.jpg")], [tmp_path])
    assert (moved.name, moved.image, moved.written) == ("2.jpg", other, "D:\\2.jpg")

    own = make_files(tmp_path / "masks", "cam0/1.png", "cam1/1.png")
    assert [frame.mask for frame in locate_images(frames, [tmp_path])] == own


def test_masks_that_are_named_as_no_photograph_are_said(tmp_path):
    scene = write_transforms(tmp_path / "room", small_cameras())
    make_files(tmp_path / "masks", "photo_000.png", "photo_0001.png", "._photo_001.png")
    photographs = open_photographs(scene).take_masks_of(tmp_path / "masks")
    (note,) = photographs.notes
    assert "1 mask in" in note
    assert note.endswith("is named as no photograph with a camera: photo_0001.png.")
    (tmp_path / "masks/photo_0001.png").unlink()
    assert open_photographs(scene).take_masks_of(tmp_path / "masks").notes == ()
