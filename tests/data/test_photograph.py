"""One photograph is one value: each fact is read once, and renders stand in for files."""

from collections import Counter
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from gscompleter.data import masks, photograph
from gscompleter.data.cameras import Intrinsics
from gscompleter.data.frame import Frame
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.masks import find_given
from gscompleter.data.one_photograph import open_photograph
from gscompleter.data.photograph import Photograph, StoredPhotograph
from gscompleter.data.photographs import build_photographs
from gscompleter.data.scene import open_photographs
from gscompleter.data.sfm.placing import write_new_copies
from gscompleter.render.loading import load_renderer
from gscompleter.system.files.image import ORIENTATION, convert_to_pixels
from gscompleter.virtual_capture.render_views import render_views
from gscompleter.virtual_capture.rendered_photograph import RenderedPhotograph
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 40
MODEL = 0x0110


@pytest.fixture
def asked(monkeypatch) -> Counter:
    """Count what is asked of each file, by the name of the question and the file."""
    counts: Counter = Counter()

    def count(module, name):
        original = getattr(module, name)

        def ask(path, *arguments):
            counts[name, Path(path).name] += 1
            return original(path, *arguments)

        monkeypatch.setattr(module, name, ask)

    for name in ("read_image_size", "read_orientation", "open_image", "has_alpha"):
        count(photograph, name)
    count(masks, "find_mask")
    return counts


def save_turned(path: Path, orientation: int, mode: str = "RGB") -> None:
    """Save a photograph that EXIF turns, of noise that is wider than high."""
    pixels = np.random.default_rng(0).integers(0, 256, (30, 44, len(mode)), np.uint8)
    image = Image.fromarray(pixels, mode)
    exif = image.getexif()
    exif[ORIENTATION] = orientation
    exif[MODEL] = "a phone"
    image.save(path, exif=exif)


def test_a_new_photograph_is_asked_for_each_fact_once(tmp_path, asked):
    cameras = [camera_at(x, size=SIZE) for x in (-0.3, 0.0, 0.3)]
    known = open_photographs(photographed(tmp_path / "scene", cameras))
    new = tmp_path / "new"
    new.mkdir()
    for number, orientation in enumerate((1, 6)):
        save_turned(new / f"{number}.jpg", orientation)
    asked.clear()
    given = find_given(new, ["0.jpg", "1.jpg"])
    copies = write_new_copies(given, known, tmp_path / "work", MaskReading())
    of_new = {question: n for question, n in asked.items() if question[1].endswith(".jpg")}
    assert set(of_new) == {
        (name, f"{number}.jpg")
        for name in ("read_image_size", "read_orientation", "open_image", "find_mask")
        for number in (0, 1)
    }
    assert set(of_new.values()) == {1}
    # The second one is turned by EXIF, and shares its lens with the first.
    assert [(copy.width, copy.height) for copy in copies] == [(44, 30), (30, 44)]
    assert copies[0].lens == copies[1].lens != ""
    # Those of the scene are asked once as well, however often their lenses are.
    assert max(asked.values()) == 1


@pytest.mark.parametrize("orientation", [1, 2, 3, 4, 5, 6, 7, 8])
def test_a_single_photograph_is_upright(tmp_path, orientation):
    save_turned(tmp_path / "a.png", orientation)
    (photographs,) = open_photograph(tmp_path / "a.png")
    (view,) = photographs.views([0])
    with Image.open(tmp_path / "a.png") as image:
        upright = np.array(ImageOps.exif_transpose(image))
    assert np.array_equal(convert_to_pixels(view.image), upright)
    assert photographs.frame(0).size() == upright.shape[1::-1]


@pytest.mark.parametrize("orientation", [1, 3, 6])
@pytest.mark.parametrize("is_beside", [False, True])
def test_masks_and_alpha_of_a_single_photograph_hide_however_it_is_turned(
    tmp_path, orientation, is_beside
):
    save_turned(tmp_path / "a.png", orientation, "RGB" if is_beside else "RGBA")
    if is_beside:
        width, height = StoredPhotograph(tmp_path / "a.png").upright_size
        mask = np.full((height, width), 255, np.uint8)
        mask[:4] = 0
        (tmp_path / "masks").mkdir()
        Image.fromarray(mask).save(tmp_path / "masks" / "a.png")
    photographs = open_photographs(tmp_path / "a.png")
    described = photographs.describe_masks([0])
    assert described is not None
    assert described.startswith("masks of 1" if is_beside else "the alpha channel of 1")
    if is_beside:
        (view,) = photographs.views([0])
        assert view.ignore_mask is not None
        assert view.ignore_mask[:4].all()
        assert not view.ignore_mask[4:].any()


@pytest.mark.parametrize("is_packed", [False, True])
def test_an_alpha_that_is_the_same_everywhere_hides_nothing(tmp_path, is_packed):
    pixels = np.full((SIZE, SIZE, 4), 100, np.uint8)
    pixels[..., 3] = 0
    path = tmp_path / "a.png"
    Image.fromarray(pixels).save(path)
    shown = StoredPhotograph(path.read_bytes, "bytes") if is_packed else path
    frame = Frame("a.png", "a.png", np.eye(4), Intrinsics((SIZE, SIZE), (40.0, 40.0)), shown)
    (view,) = build_photographs("a", "a", [frame]).views([0])
    assert view.ignore_mask is None
    assert torch.allclose(view.image, torch.tensor(100 / 255))


def test_a_container_is_not_opened_for_a_size_that_its_cameras_give():
    def read() -> bytes:
        raise AssertionError("was opened")

    lens = Intrinsics((SIZE, SIZE), (40.0, 40.0))
    frame = Frame("a", "a", np.eye(4), lens, StoredPhotograph(read))
    assert frame.size() == (SIZE, SIZE)
    assert frame.has_photograph()
    assert frame.file is None


def test_a_render_stands_where_a_photograph_is_asked_for(monkeypatch):
    """It has the pixels that a .png of it would have, and none is encoded for that."""
    camera = camera_at(size=SIZE)
    scene = gaussians_of(view_of(Room(), camera_at(0.2, size=SIZE)))
    renderer = load_renderer("cpu")
    (view,) = render_views(scene, [camera], renderer)
    alpha = view.valid_mask.to(torch.uint8).mul(255).numpy()
    assert 0 < alpha.mean() < 255
    file = BytesIO()
    Image.fromarray(np.dstack([convert_to_pixels(view.image), alpha])).save(file, "PNG")

    K = camera.K.double().tolist()
    lens = Intrinsics((SIZE, SIZE), (K[0][0], K[1][1]), (K[0][2], K[1][2]))
    frame = Frame("View 1", "View 1", camera.c2w.double().numpy(), lens, None)
    stored = replace(frame, image=StoredPhotograph(file.getvalue))
    (expected,) = build_photographs("a", "a", [stored]).views([0])

    monkeypatch.setattr(Image.Image, "save", None)
    monkeypatch.setattr(Image, "open", None)
    render = RenderedPhotograph(camera, scene, renderer)
    assert isinstance(render, Photograph)
    photographs = build_photographs("a", "a", [replace(frame, image=render)])
    (drawn,) = photographs.views([0])
    assert torch.equal(drawn.image, expected.image)
    assert torch.equal(drawn.ignore_mask, expected.ignore_mask)
    assert photographs.frame(0).size() == (SIZE, SIZE)
    assert not photographs.is_hidden(0)
    assert photographs.describe_masks([0]) is None
