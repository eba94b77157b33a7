"""Exports of phones give the cameras and the depth of the room that they show."""

import json
import struct
import sys
from dataclasses import replace
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from zipfile import ZipFile, ZipInfo

import numpy as np
import pytest
import torch

from damage import require_plain
from gscompleter import InputError
from gscompleter.data.formats import open_photographs
from gscompleter.data.phones import export
from gscompleter.data.photographs import Photographs
from phone_files import (
    UNSURE,
    UPRIGHT,
    WIDE,
    Files,
    camera_of,
    depth_of,
    encode,
    nerf_capture,
    pack,
    photograph,
    polycam,
    record3d,
    scanner_app,
    write_archive,
    write_folder,
)
from scenes import Room, view_of


@pytest.fixture(autouse=True)
def lzfse(monkeypatch):
    """Without pyliblzfse, decode streams of one block that is not compressed."""
    if find_spec("liblzfse") is None:
        module = ModuleType("liblzfse")
        module.__spec__ = ModuleSpec("liblzfse", None)
        module.decompress = lambda data: data[8:-4]
        monkeypatch.setitem(sys.modules, "liblzfse", module)


def check_room(
    photographs: Photographs, size: tuple[int, int], name: str = "room", unsure: int = UNSURE
) -> None:
    """Check cameras, photographs and depth against the room."""
    assert (len(photographs), photographs.notes) == (4, ())
    assert photographs.name == name
    for number, view in enumerate(photographs.views(range(4))):
        truth = camera_of(number, size)
        assert torch.allclose(view.camera.c2w, truth.c2w, atol=2e-6)
        assert torch.allclose(view.camera.K, truth.K, atol=1e-3)
        seen = view_of(Room(), view.camera).image
        assert view.image.shape == seen.shape
        assert (view.image - seen).abs().mean() < 0.02
        # The room differs from any other place.
        other = view_of(Room(), camera_of((number + 1) % 4, size)).image
        assert (view.image - other).abs().mean() > 0.06
        assert view.depth is not None
        # Each pixel of a depth map covers 3 × 3 of the photograph, and is true at their centre.
        depth = torch.from_numpy(depth_of(number, size))
        assert (view.depth[1::3, 1::3] - depth)[:, unsure:].abs().max() < 6e-4
        assert (view.depth[:, 3 * unsure :] > 0).all()
        assert (view.depth[:, : 3 * unsure] == 0).all()
        at_centers = view_of(Room(), view.camera).depth
        assert at_centers is not None
        assert (view.depth - at_centers)[1::3, 1 + 3 * unsure :: 3].abs().max() < 1e-3


FOLDERS = {
    "polycam": (polycam, WIDE),
    "3d-scanner-app": (scanner_app, WIDE),
    "record3d": (record3d, UPRIGHT),
}


@pytest.mark.parametrize("name", FOLDERS)
def test_folders_and_archives_show_the_room_from_where_they_say(tmp_path, name):
    write, size = FOLDERS[name]
    files = write()
    folder = write_folder(tmp_path / "folder" / "room", files)
    ending = "r3d" if name == "record3d" else "zip"
    archive = write_archive(tmp_path / "flat" / f"room.{ending}", files)
    within = write_archive(tmp_path / "within" / f"room.{ending}", files, "Aug 5/")
    for path in (folder, archive, within):
        photographs = open_photographs(path)
        assert photographs.format == name
        check_room(photographs, size)
        check_room(open_photographs(path, format=name), size)


@pytest.mark.parametrize("form", ["./{}", "Aug 5/./{}", "Aug 5//{}", "{}", "Aug 5/{}"])
@pytest.mark.parametrize("separator", ["/", "\\"])
def test_archives_of_any_program_are_read(tmp_path, form, separator):
    """Some write "./" in front of names, and Windows PowerShell backslashes."""
    files = {form.format(name): content for name, content in polycam().items()}
    path = tmp_path / "room.zip"
    with ZipFile(path, "w") as archive:
        for name, content in files.items():
            entry = ZipInfo()
            entry.filename = name.replace("/", separator)
            archive.writestr(entry, content)
    check_room(open_photographs(path), WIDE)


def test_a_dot_in_the_name_of_a_folder_begins_no_ending(tmp_path):
    for day in ("2024.05.01", "2024.05.02"):
        check_room(open_photographs(write_folder(tmp_path / day, polycam())), WIDE, day)
        archive = write_archive(tmp_path / f"{day}.zip", polycam())
        check_room(open_photographs(archive), WIDE, day)


def test_small_copies_keep_depth_and_confidence(tmp_path):
    photographs = open_photographs(write_folder(tmp_path / "room", polycam()))
    view = photographs.views([1], WIDE[0] // 3)[0]
    assert view.depth is not None
    depth = torch.from_numpy(depth_of(1, WIDE))
    assert (view.depth - depth)[:, UNSURE:].abs().max() < 6e-4
    assert (view.depth[:, :UNSURE] == 0).all()


# Polycam and 3d Scanner App.


def test_corrected_photographs_come_first_and_the_others_serve_without_them(tmp_path):
    scene = write_folder(tmp_path / "room", polycam())
    check_room(open_photographs(scene), WIDE)
    check_room(open_photographs(write_folder(tmp_path / "raw" / "room", polycam(False))), WIDE)
    for path in (scene / "keyframes" / "corrected_images").iterdir():
        path.unlink()
    moved = open_photographs(scene).camera(2).center - camera_of(2, WIDE).center
    assert moved.tolist() == pytest.approx([0.01, 0.0, 0.0], abs=1e-6)


def test_the_folder_of_keyframes_serves_too(tmp_path):
    scene = write_folder(tmp_path / "room", polycam())
    check_room(open_photographs(scene / "keyframes"), WIDE, "keyframes")


def test_frames_without_depth_or_confidence_are_kept(tmp_path):
    files = polycam()
    del files["keyframes/depth/1660000000001.png"]
    del files["keyframes/confidence/1660000000002.png"]
    views = open_photographs(write_folder(tmp_path / "room", files)).views([0, 1, 2])
    assert views[1].depth is None
    assert (views[0].depth == 0).any()
    assert (views[2].depth > 0).all()


def without(files: Files, part: str) -> Files:
    return {name: content for name, content in files.items() if part not in name}


def changed(files: Files, name: str, **values: object) -> Files:
    content = json.loads(files[name])
    return {**files, name: json.dumps({**content, **values}).encode()}


CAMERA = "keyframes/corrected_cameras/1660000000002.json"
PHOTOGRAPH = "keyframes/corrected_images/1660000000002.jpg"
DEPTH, CONFIDENCE = (f"keyframes/{kind}/1660000000002.png" for kind in ("depth", "confidence"))
FRAME = "frame_00002.json"
BROKEN = {
    "pose": (changed(polycam(), CAMERA, t_11="up"), "`t_11` of frame 1660000000002"),
    "sheared": (changed(polycam(), CAMERA, t_00=3.0), "Frame 1660000000002 .* not a rigid"),
    "size": (changed(polycam(), CAMERA, width=0.5), "`width` of frame 1660000000002"),
    "no JSON": ({**polycam(), CAMERA: b"<html>"}, "frame 1660000000002 .* is not JSON"),
    "deep JSON": ({**polycam(), CAMERA: b"[" * 9000}, "frame 1660000000002 .* is not JSON"),
    "bomb": (
        {**record3d(), "rgbd/1.depth": b"bvxn" + struct.pack("<II", 2**31, 0) + b"bvx$"},
        "larger than the photograph",
    ),
    "photograph": ({**polycam(), PHOTOGRAPH: b"JPG"}, "Frame 1660000000002 .* is not an image"),
    "depth": ({**polycam(), DEPTH: b"PNG"}, "The depth of frame 1660000000002 .* is not an image"),
    "cut confidence": (
        {**polycam(), CONFIDENCE: b"PNG"},
        "The confidence of frame 1660000000002 .* is not an image",
    ),
    "8-bit depth": (
        {**without(polycam(), CONFIDENCE), DEPTH: encode(np.zeros((3, 4), np.uint8))},
        r"The depth of frame 1660000000002 .*zip is uint8 of shape \(3, 4\); one channel is needed",
    ),
    "confidence": (
        {**polycam(), CONFIDENCE: encode(np.zeros((3, 4), np.uint8))},
        r"The depth of frame 1660000000002 .* its confidence \(3, 4\);",
    ),
    "two photographs": (
        {**polycam(), PHOTOGRAPH.replace("jpg", "png"): photograph(0, WIDE, "PNG")},
        "Frame 1660000000002 of .* has several files, 1660000000002.jpg, 1660000000002.png; keep",
    ),
    "scanner": (changed(scanner_app(), FRAME, intrinsics=[1, 2]), "`intrinsics` of frame 00002"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_frame_is_refused_by_its_name(tmp_path, kind):
    files, sentence = BROKEN[kind]
    with pytest.raises(InputError, match=sentence) as error:
        open_photographs(write_archive(tmp_path / "room.zip", files)).views(range(3))
    assert "\n" not in str(error.value)


def test_photographs_without_any_camera_are_refused(tmp_path):
    files = {**without(scanner_app(), ".jpg"), "frame_00009.jpg": photograph(0, WIDE)}
    with pytest.raises(InputError, match="No photograph of .* has a camera"):
        open_photographs(write_folder(tmp_path / "room", files))


def test_photographs_without_a_camera_are_told(tmp_path):
    """Also in archives; a camera without a photograph is usual in 3d Scanner App."""
    camera = "keyframes/corrected_cameras/1660000000001.json"
    few = changed(record3d(), "metadata", poses=POSES[:3], perFrameIntrinsicCoeffs=[])
    for name, files, lost in (
        ("room.zip", without(polycam(), camera), "1660000000001"),
        ("room.r3d", few, "3"),
    ):
        photographs = open_photographs(write_archive(tmp_path / name, files))
        assert len(photographs) == 3
        told = f"Left out of {tmp_path / name}: 1 photograph without a camera ({lost})."
        assert told in photographs.notes


def test_a_photograph_with_a_longer_name_takes_the_place_of_none(tmp_path):
    files = {**scanner_app(), "frame_x_00002.jpg": photograph(3, WIDE)}
    scene = write_folder(tmp_path / "room", files)
    photographs = open_photographs(scene)
    told = f"Left out of {scene}: 1 photograph without a camera (x_00002)."
    assert photographs.notes == (told,)
    check_room(replace(photographs, notes=()), WIDE)


def test_other_files_beside_photographs_are_no_cameras(tmp_path):
    files = {f"frame_{number}.jpg": photograph(0, WIDE) for number in (1, 2)}
    files["frame_1.json"] = b'{"shapes": []}'
    with pytest.raises(InputError, match="There are no posed photographs"):
        open_photographs(write_folder(tmp_path / "room", files))


PARTS = {
    "polycam": (polycam, ("keyframes/corrected_images/", "keyframes/depth/")),
    "scanner": (scanner_app, (".jpg", "depth_", "conf_")),
    "record3d": (record3d, ("rgbd/1.jpg", "rgbd/1.depth", "rgbd/1.conf")),
}


@pytest.mark.parametrize("kind", PARTS)
def test_files_that_were_cut_are_told_in_plain_words(tmp_path, kind):
    write, parts = PARTS[kind]
    for number, part in enumerate(parts):
        files = dict(write())
        names = [name for name in files if part in name]
        assert names
        for keep in (1, 20):
            cut = {name: files[name][:keep] for name in names}
            folder = write_folder(tmp_path / f"{number}-{keep}" / "room", {**files, **cut})
            with pytest.raises(InputError) as error:
                open_photographs(folder).views(range(3))
            assert "again" in require_plain(str(error.value))


# Archives.


@pytest.mark.parametrize("name", FOLDERS)
def test_several_recordings_in_an_archive_are_refused(tmp_path, name):
    """Also where the second one lacks a part."""
    files = FOLDERS[name][0]()
    for number, lacking in enumerate((None, ".jpg", ".json", "metadata")):
        second = files if lacking is None else without(files, lacking)
        both = {
            **{f"a/{n}": data for n, data in files.items()},
            **{f"b/{n}": d for n, d in second.items()},
        }
        with pytest.raises(InputError, match="holds several recordings; unpack it"):
            open_photographs(write_archive(tmp_path / f"{number}.zip", both)).views(range(4))


@pytest.mark.parametrize("cameras", [(), ("a",), ("a", "b")])
@pytest.mark.parametrize("folder", ["", "keyframes/images/", "keyframes/corrected_images/"])
def test_photographs_of_something_else_in_two_folders_are_no_recordings(tmp_path, folder, cameras):
    """Also with JSON files of the names that those of an export have, and of other content."""
    beside = folder.replace("images", "cameras")
    files = {f"{home}/{folder}frame_{n}.jpg": b"x" for home in "ab" for n in range(2)}
    files |= {f"{home}/{beside}frame_{n}.json": b"{}" for home in cameras for n in range(2)}
    with pytest.raises(InputError, match="There are no posed photographs in"):
        open_photographs(write_archive(tmp_path / "other.zip", files))


def test_pictures_beside_a_recording_are_none_of_it(tmp_path):
    pictures = {f"{home}/frame_0.jpg": b"x" for home in ("a", "b")}
    path = write_archive(tmp_path / "room.r3d", {**record3d(), **pictures})
    check_room(open_photographs(path), UPRIGHT)


@pytest.mark.parametrize("name", ["room.zip", "room.r3d"])
def test_damaged_archives_are_refused_in_a_sentence(tmp_path, name):
    path = write_archive(tmp_path / name, record3d() if name == "room.r3d" else polycam())
    whole = path.read_bytes()
    for data in (b"", whole[: len(whole) // 2], b"PK\3\4" + whole[200:]):
        path.write_bytes(data)
        with pytest.raises(InputError, match="room.* cannot be read .*export the recording again"):
            open_photographs(path).views([0])


def test_files_in_archives_have_a_limit(tmp_path, monkeypatch):
    path = write_archive(tmp_path / "room.zip", polycam())
    photographs = open_photographs(path)
    monkeypatch.setattr(export, "MAX_ENTRY", 2000)
    with pytest.raises(InputError, match=r"its keyframes/corrected_images/.* is too large"):
        photographs.views([0])


def test_an_archive_of_something_else_is_no_scene(tmp_path):
    path = write_archive(tmp_path / "other.zip", {"notes.txt": b"hello"})
    with pytest.raises(InputError, match="There are no posed photographs in"):
        open_photographs(path)


# Record3D.


@pytest.mark.parametrize("size", [UPRIGHT, WIDE])
@pytest.mark.parametrize("own_lenses", [True, False])
def test_recordings_of_both_orientations_have_the_lens_of_each_photograph(
    tmp_path, size, own_lenses
):
    path = write_archive(tmp_path / "room.r3d", record3d(size, own_lenses))
    check_room(open_photographs(path), size)


def test_compressed_depth_is_decoded(tmp_path):
    compress = getattr(import_module("liblzfse"), "compress", None)
    if compress is None:
        pytest.skip("pyliblzfse is not installed")
    files = record3d(pack=compress)
    assert len(files["rgbd/0.conf"]) < len(record3d()["rgbd/0.conf"]) / 2
    check_room(open_photographs(write_archive(tmp_path / "room.r3d", files)), UPRIGHT)


def test_without_the_decoder_depth_is_left_out_with_a_note(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    path = write_archive(tmp_path / "room.r3d", record3d())
    photographs = open_photographs(path)
    (note,) = photographs.notes
    assert "gscompleter[phones]" in note
    assert photographs.views([0])[0].depth is None
    bare = write_archive(tmp_path / "bare.r3d", without(record3d(), ".depth"))
    assert open_photographs(bare).notes == ()


def test_a_lens_for_each_photograph_needs_no_other(tmp_path):
    """Also one of the recording that is no matrix is not asked then."""
    for number, K in enumerate((None, [1])):
        files = changed(record3d(), "metadata", K=K)
        path = write_archive(tmp_path / str(number) / "room.r3d", files)
        check_room(open_photographs(path), UPRIGHT)


POSES = json.loads(record3d()["metadata"])["poses"]
RECORDINGS = {
    "no metadata": (without(record3d(), "metadata"), "no `metadata` in"),
    "no poses": (changed(record3d(), "metadata", poses=[]), "has no poses; record with the LiDAR"),
    "short": (changed(record3d(), "metadata", poses=[[0] * 6] * 4), "`poses` of .* 4 × 7"),
    "lenses": (changed(record3d(), "metadata", perFrameIntrinsicCoeffs=[1]), "4 × 4 numbers"),
    "K": (changed(record3d(own_lenses=False), "metadata", K=[1]), "`K` of .* 9 numbers"),
    "depth": ({**record3d(), "rgbd/1.depth": b"bvx2" + b"\xff" * 40}, "The depth of frame 1"),
    "odd depth": ({**record3d(), "rgbd/1.depth": pack(b"\0" * 28)}, "depth of frame 1"),
    "no depth": ({**record3d(), "rgbd/1.depth": pack(b"")}, "depth of frame 1"),
    "huge": ({**record3d(), "rgbd/1.depth": b"\0" * 99_999}, "larger than the photograph"),
    "confidence": ({**record3d(), "rgbd/1.conf": pack(b"\0" * 12)}, "its confidence"),
    "cut confidence": ({**record3d(), "rgbd/1.conf": b"bvx-"}, "The confidence of frame 1"),
}


@pytest.mark.parametrize("kind", RECORDINGS)
def test_a_broken_recording_is_refused_in_a_sentence(tmp_path, kind):
    files, sentence = RECORDINGS[kind]
    with pytest.raises(InputError, match=sentence) as error:
        open_photographs(write_archive(tmp_path / "room.r3d", files)).views(range(2))
    assert "\n" not in str(error.value)


def test_frames_without_a_pose_are_left_out_with_a_note(tmp_path):
    """Record3D writes zeros where tracking failed."""
    files = changed(record3d(), "metadata", poses=[[0] * 7, *POSES[1:]])
    photographs = open_photographs(write_archive(tmp_path / "room.r3d", files))
    assert photographs.posed == list(range(1, len(POSES)))
    assert any("NaN or infinity" in note for note in photographs.notes)


def test_frames_that_were_dropped_keep_the_poses_of_the_others(tmp_path):
    path = write_archive(tmp_path / "room.r3d", without(record3d(), "rgbd/1."))
    photographs = open_photographs(path)
    assert len(photographs) == 3
    assert torch.allclose(photographs.camera(1).c2w, camera_of(2, UPRIGHT).c2w, atol=2e-6)


def test_unknown_depth_is_zero(tmp_path):
    depth = depth_of(0, UPRIGHT).copy()
    depth[0, UNSURE:] = np.nan, *[-1.0] * (depth.shape[1] - UNSURE - 1)
    files = {**record3d(), "rgbd/0.depth": pack(depth.tobytes())}
    view = open_photographs(write_archive(tmp_path / "room.r3d", files)).views([0])[0]
    assert view.depth is not None
    assert (view.depth[:3] == 0).all()
    assert (view.depth[3:, 3 * UNSURE :] > 0).all()


# Others.


def test_recordings_of_nerf_capture_have_depth(tmp_path):
    photographs = open_photographs(write_folder(tmp_path / "room", nerf_capture()))
    check_room(photographs, WIDE, unsure=0)


@pytest.mark.parametrize("name", ["scan.usdz", "scan.LAS", "scan.fbx"])
def test_models_of_scaniverse_are_refused_with_what_to_record_instead(tmp_path, name):
    (tmp_path / name).write_bytes(b"model")
    with pytest.raises(InputError, match="without photographs and cameras.*Scaniverse.*Polycam"):
        open_photographs(tmp_path / name)
