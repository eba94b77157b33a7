"""Equirectangular panoramas: recognised, split into views, and posed as rigs."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from command import run
from gscompleter.data.formats import open_photographs
from gscompleter.data.panorama import VIEWS, compute_view_rotation, has_panoramas, split_panorama
from gscompleter.data.sfm.poses import list_photograph_files
from gscompleter.system.files.image import ORIENTATION, write_image
from gscompleter.types import Camera
from mapping_stand_in import similarity_removed
from panoramas import panorama
from scenes import Room, camera_at, cast, view_of

CENTRES = [(-0.6, 0.0, 1.0), (-0.1, 0.2, 1.4), (0.5, -0.1, 1.6), (0.2, 0.1, 0.6)]
GPANO = b'http://ns.adobe.com/xap/1.0/\0<x GPano:ProjectionType="equirectangular"/>'


def panoramas(folder: Path, count: int) -> Path:
    """Write panoramas of the room from several places, each turned by 20° more."""
    folder.mkdir()
    for number, centre in enumerate(CENTRES[:count]):
        panorama(folder / f"{number}.png", centre, 20.0 * number)
    return folder


def ordinary(path: Path, width: int = 128) -> Path:
    """Write a photograph of the room, 64 pixels high."""
    image = view_of(Room(), camera_at(x=0.4, yaw=15, size=max(width, 64))).image
    write_image(path, image[:64, :width])
    return path


def test_views_are_what_pinhole_cameras_see(tmp_path):
    path = panorama(tmp_path / "a.png", CENTRES[0])
    views = [pixels for pixels, _ in split_panorama(path)]
    assert len(views) == len(VIEWS)
    for pixels, (yaw, pitch) in zip(views, VIEWS, strict=True):
        c2w, side = torch.eye(4), len(pixels)
        c2w[:3, :3] = torch.from_numpy(compute_view_rotation(yaw, pitch))
        c2w[:3, 3] = torch.tensor(CENTRES[0])
        K = torch.tensor([[side / 2, 0, side / 2], [0, side / 2, side / 2], [0, 0, 1]])
        true, _ = cast(Room(), Camera(c2w, K, side, side, 0.1, 20.0))
        off = np.abs(pixels / 255 - true.numpy()).mean()
        assert off < 0.02  # where the panorama is seen through another view it is 0.2
    assert all(pitch >= 0 for _, pitch in VIEWS)  # the operator stands below


def test_a_panorama_is_read_as_other_photographs_are(tmp_path):
    """Upright as EXIF says, with its mask; and grey of 16 bits is scaled, not clipped to white."""
    path = panorama(tmp_path / "a.png", CENTRES[0])
    image = Image.open(path)
    hidden = np.zeros((image.height, image.width), dtype=bool)
    hidden[: image.height // 2] = True
    exif = image.getexif()
    exif[ORIENTATION] = 3
    image.rotate(180).save(tmp_path / "turned.png", exif=exif)
    upright = split_panorama(path, hidden)
    turned = split_panorama(tmp_path / "turned.png", hidden)
    for (pixels, shade), (other, other_shade) in zip(upright, turned, strict=True):
        assert np.array_equal(pixels, other)
        assert np.array_equal(shade, other_shade)

    grey = np.asarray(image.convert("L"))
    Image.fromarray(grey).save(tmp_path / "8.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "16.png")
    for (pixels, _), (other, _) in zip(
        split_panorama(tmp_path / "8.png"), split_panorama(tmp_path / "16.png"), strict=True
    ):
        assert np.array_equal(pixels, other)


def test_a_panorama_on_its_side_is_none(tmp_path):
    image = Image.open(panorama(tmp_path / "a.png", CENTRES[0]))
    exif = image.getexif()
    exif[ORIENTATION] = 6
    image.save(tmp_path / "a.png", exif=exif)
    assert not has_panoramas([tmp_path / "a.png"])


def test_a_view_that_rises_looks_up():
    ahead, up = compute_view_rotation(0, 0)[:, 2], compute_view_rotation(0, 50)[:, 2]
    assert ahead == pytest.approx([0, 0, 1])
    assert up[1] < -0.7
    assert compute_view_rotation(90, 0)[:, 2] == pytest.approx([1, 0, 0])


def test_panoramas_are_recognised_by_their_borders_or_their_metadata(tmp_path):
    closed = panorama(tmp_path / "a.png", CENTRES[0])
    wide, plain = ordinary(tmp_path / "wide.png"), tmp_path / "plain.png"
    framed = Image.new("RGB", (128, 64), "white")
    framed.paste(Image.open(wide).resize((64, 32)), (32, 16))
    framed.save(plain)
    assert has_panoramas([closed])
    assert not has_panoramas([wide])
    assert not has_panoramas([plain])  # a thing before a white wall: its borders meet, too
    assert not has_panoramas([wide, ordinary(tmp_path / "narrow.png", 64)])

    Image.open(wide).save(tmp_path / "wide.jpg")
    content = (tmp_path / "wide.jpg").read_bytes()
    segment = b"\xff\xe1" + (len(GPANO) + 2).to_bytes(2, "big") + GPANO
    (tmp_path / "marked.jpg").write_bytes(content[:2] + segment + content[2:])
    assert has_panoramas([tmp_path / "marked.jpg", wide])


def test_panoramas_beside_other_sizes_are_refused(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    for width in (64, 128):
        ordinary(panoramas(tmp_path / f"p{width}", 2) / "other.png", width)
        out = tmp_path / "out"
        assert run(monkeypatch, "poses", tmp_path / f"p{width}", "--out", out, "--quiet") == 2
        said = capsys.readouterr().err
        assert "other panoramas lie photographs of other sizes; put panoramas of one size" in said
        assert said.count("\n") == 1
        assert not out.exists()


@pytest.mark.parametrize("command", ["poses", "complete"])
def test_one_panorama_is_refused(tmp_path, monkeypatch, capsys, command):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    given, out = panoramas(tmp_path / "p", 1), tmp_path / "out"
    assert run(monkeypatch, command, given, "--out", out, "--quiet") == 2
    assert "There is a single panorama in " in capsys.readouterr().err
    assert not out.exists()
    assert list_photograph_files(panoramas(tmp_path / "two", 2)) == ["0.png", "1.png"]


@pytest.mark.parametrize("name", ["VID_1.insv", "IMG_1.INSP"])
@pytest.mark.parametrize("command", ["poses", "complete"])
def test_files_of_insta360_have_to_be_exported_first(tmp_path, monkeypatch, capsys, name, command):
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / name).write_bytes(b"raw")
    for given in (tmp_path / "walk", tmp_path / "walk" / name):
        assert run(monkeypatch, command, given, "--out", tmp_path / "out", "--quiet") == 2
        said = capsys.readouterr().err
        assert "export 360° JPEG or MP4 (2:1) from Insta360 Studio" in said
        assert said.count("\n") == 1


@pytest.mark.slow
def test_several_panoramas_are_a_scene_of_views_with_common_centres(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    given, out = panoramas(tmp_path / "room", 4), tmp_path / "poses"
    assert run(monkeypatch, "poses", given, "--out", out) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "4 panoramas were split into 36 views of 90° each."
    assert said[1].startswith("36 of 36 cameras and ")

    opened = open_photographs(out)
    poses = {frame.name: frame.c2w for frame in opened.frames}
    found = np.array([poses[f"view_0/{number}.jpg"][:3, 3] for number in range(4)])
    extent = np.ptp(found, axis=0).max()
    for number, (yaw, pitch) in enumerate(VIEWS):
        for i in range(4):
            first, view = poses[f"view_0/{i}.jpg"], poses[f"view_{number}/{i}.jpg"]
            assert np.abs(view[:3, 3] - first[:3, 3]).max() < 1e-6 * extent
            assert first[:3, :3].T @ view[:3, :3] == pytest.approx(
                compute_view_rotation(yaw, pitch), abs=1e-6
            )
    true = np.array(CENTRES)
    off = np.linalg.norm(similarity_removed(found, true) - true, axis=1)
    assert off.max() < 0.005  # of an extent of 1.1
    assert float(opened.camera(0).K[0, 0]) == opened.camera(0).width / 2
