"""New photographs that are placed among photographs with cameras."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gscompleter.data.formats import open_photographs
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.masks import find_given
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm import placing, poses
from gscompleter.data.sfm.placing import (
    NewCopy,
    identify_input,
    name_new,
    place_photographs,
    write_new_copies,
)
from gscompleter.numerics.geometry import resize_camera
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import write_image
from mapping_stand_in import stand_in
from scenes import Room, camera_at, photographed, view_of

CAMERAS = [
    camera_at(x=0.3 * i - 1.05, y=0.1 * (i % 3), z=0.05 * i, yaw=14 - 4 * i, size=160)
    for i in range(8)
]
NEW = (2, 5)
"""Cameras whose photographs are new."""


@pytest.fixture
def known(tmp_path) -> Photographs:
    """Open photographs with cameras, without the new ones."""
    cameras = [camera for number, camera in enumerate(CAMERAS) if number not in NEW]
    return open_photographs(photographed(tmp_path / "scene", cameras))


@pytest.fixture
def new(tmp_path) -> Path:
    """Write new photographs without cameras."""
    folder = tmp_path / "new"
    folder.mkdir()
    for number in NEW:
        write_image(folder / f"new {number}.png", view_of(Room(), CAMERAS[number]).image)
    return folder


def measure_errors(joined: Photographs, count: int) -> list[tuple[float, float]]:
    """Measure the distance and the angle (degrees) of the last cameras from the true ones."""
    errors = []
    for frame, number in zip(joined.frames[-count:], NEW, strict=True):
        true = CAMERAS[number].c2w.double().numpy()
        cosine = (np.trace(frame.c2w[:3, :3].T @ true[:3, :3]) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        errors.append((float(np.linalg.norm(frame.c2w[:3, 3] - true[:3, 3])), float(angle)))
    return errors


def test_new_photographs_are_placed_and_known_cameras_stay(known, new, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    joined, placed = place_photographs(new, known, tmp_path / "colmap")
    assert placed.total == 2
    assert placed.failures == {}
    assert len(joined) == 8
    assert joined.frames[:6] == known.frames
    # The photographs lie 0.3 apart, and a pixel is 0.4 degrees wide.
    for distance, angle in measure_errors(joined, 2):
        assert distance < 0.02
        assert angle < 0.3
    # They have the lens of the others, whose focal length they hardly change.
    assert joined.camera(6).K[0, 0] == pytest.approx(CAMERAS[0].K[0, 0].item(), rel=0.02)
    assert {path.name for path in (tmp_path / "colmap").iterdir()} == {
        "images",
        "sparse",
        "summary.json",
    }
    assert [frame.file_name for frame in joined.frames[6:]] == ["new/new_2.png", "new/new_5.png"]

    # The next run with the same photographs needs no COLMAP.
    again, reused = place_photographs(new, known, tmp_path / "colmap")
    assert reused.reused
    assert np.array_equal(again.frames[7].c2w, joined.frames[7].c2w)


def test_a_known_lens_and_a_guessed_one_share_no_camera(tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    from gscompleter.data.sfm.placing_process import PlacingJob, extract_placing_features

    pinhole = (60.0, 60.0, 32.0, 32.0)
    of_copies = {"a.png": None, "b.png": pinhole, "c.png": pinhole, "d.png": None}
    for name in of_copies:
        Image.new("RGB", (64, 64), "grey").save(tmp_path / name)
    job = PlacingJob(
        images=str(tmp_path),
        masks="",
        work=str(tmp_path),
        model="",
        threads=1,
        known=[],
        new=[NewCopy(name, 64, 64, "lens", None, of, False) for name, of in of_copies.items()],
        origin=[0.0, 0.0, 0.0],
    )
    cameras = extract_placing_features(job)
    assert cameras["a.png"] == cameras["d.png"] != cameras["b.png"] == cameras["c.png"]


# The test above has two such copies alone.
@pytest.mark.slow
def test_copies_of_one_size_from_photographs_of_two_have_cameras_of_their_own(
    known, new, tmp_path, monkeypatch
):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    # The first has the size of the known photographs, and so their lens. The other one is reduced
    # to that size.
    monkeypatch.setattr(placing, "MAX_COPY_SIDE", 160)
    large = resize_camera(CAMERAS[NEW[1]], 320, 320)
    write_image(new / f"new {NEW[1]}.png", view_of(Room(), large).image)
    joined, placed = place_photographs(new, known, tmp_path / "colmap")
    assert placed.failures == {}
    for distance, angle in measure_errors(joined, 2):
        assert distance < 0.05
        assert angle < 0.5


# `test_refining.py` has a far origin, and `test_poses.py` names what is not placed.
@pytest.mark.slow
def test_a_far_origin_does_not_matter_and_what_shows_something_else_is_named(known, new, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    Image.new("RGB", (160, 160), "grey").save(new / "wall.png")
    origin = np.array([4e5, -5e6, 120.0])
    moved = []
    for frame in known.frames:
        c2w = frame.c2w.copy()
        c2w[:3, 3] += origin
        moved.append(replace(frame, c2w=c2w))
    far = replace(known, frames=tuple(moved), origin=origin)
    joined, placed = place_photographs(new, far, tmp_path / "colmap")
    assert len(joined) == 8
    for frame, number in zip(joined.frames[6:], NEW, strict=True):
        true = CAMERAS[number].c2w[:3, 3].double().numpy() + origin
        assert np.linalg.norm(frame.c2w[:3, 3] - true) < 0.02
    first, second = placed.notes
    assert first == "2 of 3 new photographs were placed among those of the scene."
    assert second == (
        "Not placed, and left out: wall.png (it shares no features with a photograph of SCENE)."
    )


@pytest.mark.slow
def test_photographs_none_of_which_fits_are_refused_and_nothing_is_left(known, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    other = tmp_path / "other"
    other.mkdir()
    Image.new("RGB", (160, 160), "grey").save(other / "wall.png")
    with pytest.raises(InputError, match=r"No photograph in .* could be placed .*wall\.png"):
        place_photographs(other, known, tmp_path / "colmap")
    assert not (tmp_path / "colmap").exists()


@pytest.mark.parametrize(("folder", "home"), [("phone", "phone"), ("images", "new")])
def test_a_new_photograph_with_the_name_of_an_old_one_is_told_apart(known, tmp_path, folder, home):
    old = known.frame(1)
    frame = name_new(replace(old, name=old.file_name), tmp_path / folder)
    assert frame.file_name == f"{home}/{old.file_name}"
    joined = replace(known, frames=(*known.frames, frame))
    assert joined.find_frame(frame.file_name) == 6
    with pytest.raises(InputError, match="2 photographs of .* name the path of one"):
        joined.find_frame(old.file_name)


def test_photographs_of_the_scene_are_not_placed_again(known, new, tmp_path):
    inside = known.frames[0].file.path
    assert isinstance(inside, Path)
    with pytest.raises(InputError, match="All 6 photographs in .* have cameras in SCENE already"):
        place_photographs(inside.parent, known, tmp_path / "colmap")
    with pytest.raises(InputError, match="There are no photographs"):
        place_photographs(tmp_path / "nowhere", known, tmp_path / "colmap")


def test_reasons_follow_from_the_features_in_common(known, new, tmp_path, monkeypatch):
    rows = [
        {"is_placed": False, "like": "known/00003.png", "matches": 12},
        {"is_placed": False, "like": "known/00001.png", "matches": 80},
    ]
    script = f"import json\nprint(json.dumps(dict(new={rows})))"
    stand_in(monkeypatch, tmp_path, script)
    monkeypatch.setattr(placing, "PLACING_PROCESS", "stand_in_mapping")
    monkeypatch.setattr(poses, "find_spec", lambda name: True)
    with pytest.raises(InputError) as caught:
        place_photographs(new, known, tmp_path / "colmap")
    name = known.frames[3].file_name
    assert f"12 features in common with {name}, and 30 are needed" in str(caught.value)
    assert "80 features in common with" in str(caught.value)
    assert "fit no single camera" in str(caught.value)


def test_a_missing_package_is_told_how_to_install(known, new, tmp_path, monkeypatch):
    monkeypatch.setattr(poses, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'gscompleter\[poses\]'"):
        place_photographs(new, known, tmp_path / "colmap")


@pytest.mark.parametrize("is_used", [True, False])
def test_masks_that_are_not_used_hide_nothing_of_new_photographs(known, new, tmp_path, is_used):
    """`update --photos --no-masks` uses all pixels to place them as well."""
    (new / "masks").mkdir()
    mask = Image.new("L", (160, 160))
    mask.putpixel((80, 80), 255)
    mask.save(new / "masks" / "new 2.png")
    reading = MaskReading(may_be_large=True, is_used=is_used)
    given = find_given(new, [f"new {number}.png" for number in NEW], reading)
    copies = write_new_copies(given, known, tmp_path, reading)
    assert any(copy.is_masked for copy in copies) is is_used
    assert bool(list(tmp_path.rglob("masks/**/*new*2.png.png"))) is is_used


@pytest.mark.slow
def test_masks_of_new_photographs_are_kept(known, new, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    mask = np.full((160, 160), 255, dtype=np.uint8)
    mask[:40] = 0
    (new / "masks").mkdir()
    Image.fromarray(mask).save(new / "masks" / "new 2.png")
    joined, _ = place_photographs(new, known, tmp_path / "colmap")
    (view,) = joined.views([6])
    assert view.ignore_mask is not None
    assert view.ignore_mask[:38].all()
    assert not view.ignore_mask[42:].any()

    # A mask that comes later makes another result.
    names = [f"new {number}.png" for number in NEW]
    with_mask = identify_input(find_given(new, names), known)
    (new / "masks" / "new 2.png").unlink()
    assert identify_input(find_given(new, names), known) != with_mask


@pytest.mark.slow
def test_real_photographs_are_placed_within_a_pixel(shared, tmp_path):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    opened = open_photographs(shared / "data" / "fountain_p11")
    new = tmp_path / "new"
    new.mkdir()
    shutil.copyfile(opened.frames[3].file.path, new / "a.jpg")
    rest = replace(opened, frames=(*opened.frames[:3], *opened.frames[4:]))
    joined, _ = place_photographs(new, rest, tmp_path / "colmap")
    true = opened.frames[3].c2w
    found = joined.frames[-1].c2w
    # A pixel is 0.1 degrees wide, and neighbours are a tenth of the extent apart.
    centres = np.stack([frame.c2w[:3, 3] for frame in opened.frames])
    extent = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.005 * extent
    cosine = (np.trace(found[:3, :3].T @ true[:3, :3]) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 0.1
    summary = json.loads((tmp_path / "colmap" / "summary.json").read_text())
    assert summary["placed"]["total"] == 1
