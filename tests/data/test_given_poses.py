"""The command `poses` on photographs that have cameras."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command import run
from gscompleter.data import given_poses
from gscompleter.data.cameras import Distortion, Intrinsics
from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.data.transforms import write_transforms
from gscompleter.system.errors import InputError
from scenes import camera_at, photographed
from shaken_room import CAMERAS, DONE, SHAKEN, correct, write_shaken

KEPT = PoseRefinement(8, given_error=0.1, refined_error=0.1, moved=0.0)


@pytest.fixture
def scene(tmp_path) -> Path:
    """Write photographs of the room, one of them with a wrong pose."""
    return write_shaken(tmp_path / "scene")


def test_refined_cameras_are_written_for_other_programs(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(given_poses, "refine_poses", correct)
    out = tmp_path / "out"
    assert run(monkeypatch, "poses", scene, "--out", out, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["is_refined"]
    assert (answer["given_error_px"], answer["refined_error_px"]) == (
        DONE.given_error,
        DONE.refined_error,
    )
    given, refined = open_photographs(scene), open_photographs(out)
    for number, (before, after) in enumerate(zip(given.frames, refined.frames, strict=True)):
        # The photographs themselves, where they lie.
        assert after.file.path.samefile(before.file.path)
        assert refined.camera(number).K.equal(given.camera(number).K)
        if number != SHAKEN:
            assert np.allclose(after.c2w, before.c2w, rtol=0, atol=1e-12)
    true = CAMERAS[SHAKEN].c2w.double().numpy()
    assert np.allclose(refined.frames[SHAKEN].c2w, true, rtol=0, atol=1e-6)


def test_cameras_that_agree_stay(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(given_poses, "refine_poses", lambda photographs: (photographs, KEPT))
    out = tmp_path / "out"
    assert run(monkeypatch, "poses", scene, "--out", out) == 0
    assert "stay as they are" in capsys.readouterr().out.replace("\n", " ")
    pairs = zip(open_photographs(scene).frames, open_photographs(out).frames, strict=True)
    for before, after in pairs:
        assert np.allclose(after.c2w, before.c2w, rtol=0, atol=1e-12)


def test_photographs_that_cannot_be_refined_are_refused(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(given_poses, "refine_poses", lambda photographs: (photographs, None))
    assert run(monkeypatch, "poses", scene, "--out", tmp_path / "out") == 2
    assert "cannot be refined" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_the_file_cannot_hold_is_refused_before_a_refinement(
    scene, tmp_path, monkeypatch, capsys
):
    def fail(photographs: Photographs) -> None:
        raise AssertionError("minutes of COLMAP")

    monkeypatch.setattr(given_poses, "refine_poses", fail)
    (scene / "masks").mkdir()
    for frame in open_photographs(scene).frames:
        mask = Image.new("L", frame.size(), 255)
        mask.paste(0, (0, 0, 4, 4))
        mask.save(scene / "masks" / f"{Path(frame.name).stem}.png")
    words = ("poses", scene, "--invert-masks", "--out", tmp_path / "out")
    assert run(monkeypatch, *words) == 2
    assert "the other way round" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_photograph_that_is_gone_is_left_out(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(given_poses, "refine_poses", lambda photographs: (photographs, KEPT))
    open_photographs(scene).frames[0].file.path.unlink()
    assert run(monkeypatch, "poses", scene, "--out", tmp_path / "out") == 0
    assert f"{len(CAMERAS) - 1} photographs stay" in capsys.readouterr().out.replace("\n", " ")
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert len(content["frames"]) == len(CAMERAS) - 1


def test_a_scene_without_any_photograph_is_refused(scene, tmp_path, monkeypatch, capsys):
    for frame in open_photographs(scene).frames:
        frame.file.path.unlink()
    assert run(monkeypatch, "poses", scene, "--out", tmp_path / "out") == 2
    assert "None of the photographs" in capsys.readouterr().err


def test_photographs_that_colmap_left_out_are_not_called_refined(room):
    some = given_poses.RefinedCameras(room, replace(DONE, photographs=1), "")
    assert "cameras of 1 of 2 photographs are refined" in some.describe(Path("out"))
    every = given_poses.RefinedCameras(room, replace(DONE, photographs=2), "")
    assert "cameras of 2 photographs are refined" in every.describe(Path("out"))
    kept = given_poses.RefinedCameras(room, KEPT, "")
    assert "cameras of 2 photographs stay" in kept.describe(Path("out"))


@pytest.mark.slow
def test_colmap_refines_given_cameras(scene, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    assert run(monkeypatch, "poses", scene, "--out", tmp_path / "out") == 0
    done = json.loads((tmp_path / "out" / "summary.json").read_text())["poses"]
    assert done["refined_error"] < 0.8 * done["given_error"]


LENSES = {
    "radial": Distortion(radial=(0.1, -0.02, 0.003), tangential=(0.001, -0.002)),
    "fisheye": Distortion("equidistant", radial=(0.1, -0.02, 0.003, 0.001)),
}


def with_lens(photographs: Photographs, lens: Distortion) -> Photographs:
    """Return photographs that were taken through a lens."""
    intrinsics = Intrinsics((32, 32), (30.0, 31.0), (15.5, 16.5), distortion=lens)
    frames = [replace(frame, intrinsics=intrinsics) for frame in photographs.frames]
    return replace(photographs, frames=tuple(frames))


@pytest.fixture
def room(tmp_path) -> Photographs:
    cameras = [camera_at(x=x, size=32) for x in (0.0, 0.5)]
    return open_photographs(photographed(tmp_path / "room", cameras))


@pytest.mark.parametrize("name", LENSES)
def test_lenses_come_back(room, tmp_path, name):
    written = with_lens(room, LENSES[name])
    path = tmp_path / "transforms.json"
    write_transforms(path, written, tmp_path)
    for before, after in zip(written.frames, open_photographs(path).frames, strict=True):
        assert after.intrinsics.distortion == before.intrinsics.distortion
        assert after.intrinsics.compute_pinhole(32, 32) == before.intrinsics.compute_pinhole(32, 32)


@pytest.mark.parametrize(
    "lens", [Distortion("division", (0.1,)), Distortion(denominator=(0.1, 0.0, 0.0))]
)
def test_a_lens_that_the_file_does_not_hold_is_refused(room, tmp_path, lens):
    with pytest.raises(InputError, match="does not hold; undistort"):
        write_transforms(tmp_path / "transforms.json", with_lens(room, lens), tmp_path)


def test_fisheye_lenses_beside_others_are_refused(room, tmp_path):
    fisheye = with_lens(room, LENSES["fisheye"]).frames[0]
    mixed = replace(room, frames=(fisheye, *room.frames[1:]))
    with pytest.raises(InputError, match="fisheye and other lenses"):
        write_transforms(tmp_path / "transforms.json", mixed, tmp_path)


@pytest.mark.linux
def test_paths_lead_to_the_photographs_through_a_link(room, tmp_path):
    (tmp_path / "far" / "away").mkdir(parents=True)
    home = tmp_path / "link"
    home.symlink_to(tmp_path / "far" / "away")
    write_transforms(home / "transforms.json", room, home)
    for before, after in zip(room.frames, open_photographs(home).frames, strict=True):
        assert after.file is not None
        assert after.file.path.samefile(before.file.path)


def test_masks_are_named_unless_they_are_the_other_way_round(room, tmp_path):
    mask = tmp_path / "room" / "mask.png"
    mask.write_bytes(room.frames[0].file.path.read_bytes())
    frames = [replace(frame, mask=mask) for frame in room.frames]
    path = tmp_path / "transforms.json"
    masked = replace(room, frames=tuple(frames))
    write_transforms(path, masked, tmp_path)
    assert all(frame.mask.samefile(mask) for frame in open_photographs(path).frames)
    with pytest.raises(InputError, match="the other way round"):
        write_transforms(path, masked.invert_masks(), tmp_path)
