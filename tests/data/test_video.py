"""Videos in place of photographs: which frames are chosen, and what is refused."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from command import run
from gscompleter.data.formats import open_photographs
from gscompleter.data.panorama import has_panoramas
from gscompleter.data.sfm import poses
from gscompleter.data.sfm.poses import find_poses
from gscompleter.data.video import extract_frames, is_video, measure_frames, select_frames
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.system.files.video import find_ffmpeg, read_video, write_video
from mapping_stand_in import model_script, similarity_removed, stand_in
from panoramas import panorama
from scenes import Room, camera_at, view_of

pytest.importorskip("imageio_ffmpeg", reason="needs gscompleter[film]")

STILL, BLURRED = 5, (9, 14, 15, 28)
"""Frames before the camera moves, and frames without sharp edges."""
WAY = [max(number - STILL, 0) / 34 for number in range(40)]
CAMERAS = [camera_at(2 * t - 1, 0.2 * t, 0.3 * t, 4 - 8 * t, size=160) for t in WAY]


def film() -> list[np.ndarray]:
    """Take grey photographs along a way through the room, 160 × 120 pixels."""
    shown = [view_of(Room(), camera).image[20:140].mean(-1, keepdim=True) for camera in CAMERAS]
    frames = [convert_to_pixels(image.expand(-1, -1, 3)) for image in shown]
    for number in BLURRED:
        frames[number] = cv2.GaussianBlur(frames[number], (0, 0), 2)
    return frames


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """Return a video of the room."""
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    write_video(path, film(), 10)
    return path


def change(source: Path, target: Path, *options: object) -> Path:
    """Copy a video without decoding it, with other metadata or in another container."""
    command = [find_ffmpeg(), "-v", "error", "-y", *options, "-i", source, "-c", "copy", target]
    subprocess.run([*map(str, command)], check=True)
    return target


def extracted(video: Path, folder: Path, count: int = 40) -> dict[int, np.ndarray]:
    """Return the chosen frames by number."""
    folder.mkdir()
    extract_frames(video, folder, count)
    return {int(p.stem[6:]): np.asarray(Image.open(p)) for p in sorted(folder.iterdir())}


def test_chosen_frames_are_sharp_and_the_camera_has_moved_between_them(video, tmp_path):
    chosen = extracted(video, tmp_path / "frames", 6)
    assert len(chosen) == 6
    assert len([number for number in chosen if number <= STILL]) <= 1
    assert not chosen.keys() & set(BLURRED)
    true = film()
    for number, pixels in chosen.items():
        others = [np.abs(pixels.astype(int) - frame).mean() for frame in true[STILL:]]
        assert min(others) < 6
        assert int(np.argmin(others)) + STILL == max(number, STILL)


def test_fewer_frames_are_spread_over_the_whole_way(video, tmp_path):
    ways = np.array([WAY[number] for number in extracted(video, tmp_path / "frames", 7)])
    assert len(ways) == 7
    assert ways[0] < 1 / 7
    assert ways[-1] > 6 / 7
    assert np.diff(ways).max() < 2 / 7


def test_the_same_video_gives_the_same_bytes(video, tmp_path):
    for name in ("a", "b"):
        extracted(video, tmp_path / name, 8)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_ten_bits_are_read_as_eight(video, tmp_path):
    deep, options = tmp_path / "deep.mp4", ("-c:v", "libx264", "-pix_fmt", "yuv420p10le")
    command = [find_ffmpeg(), "-v", "error", "-i", str(video), *options, str(deep)]
    subprocess.run(command, check=True)
    for is_grey in (False, True):
        pixels, true = (next(read_video(path, "null", is_grey)) for path in (deep, video))
        assert pixels.shape == true.shape
        assert np.abs(pixels.astype(int) - true).mean() < 6


@pytest.mark.parametrize("ending", [".mov", ".mkv", ".MP4"])
def test_rotation_metadata_and_containers_are_honoured(video, tmp_path, ending):
    lying = change(video, tmp_path / f"lying{ending}", "-display_rotation", 90)
    assert is_video(lying)
    upright, turned = (next(read_video(path, "null", False)) for path in (video, lying))
    assert turned.shape == (160, 120, 3)
    assert np.abs(np.rot90(upright).astype(int) - turned).mean() < 2
    assert np.abs(np.rot90(upright, 3).astype(int) - turned).mean() > 20
    small = next(read_video(lying, "scale=w=40:h=40:force_original_aspect_ratio=decrease", True))
    assert small.shape == (40, 30)


def test_pixels_that_are_not_square_are_shown_as_players_show_them(video, tmp_path):
    """As in HDV and other anamorphic files; frames would be squeezed, which no lens explains."""
    narrow = tmp_path / "narrow.mp4"
    squeezed = ("-vf", "scale=120:120,setsar=4/3", "-c:v", "libx264", "-crf", "1")
    command = [find_ffmpeg(), "-v", "error", "-i", str(video), *squeezed, str(narrow)]
    subprocess.run(command, check=True)
    shown, true = (next(read_video(path, "null", False)) for path in (narrow, video))
    assert shown.shape == true.shape
    assert np.abs(shown.astype(int) - true).mean() < 0.03 * true.max()
    chosen = extracted(narrow, tmp_path / "frames", 6)
    assert {pixels.shape for pixels in chosen.values()} == {(120, 160, 3)}


def test_of_each_window_the_sharpest_frame_is_chosen_half_a_window_on():
    motion = np.array([0, 0.2, 0.9, 1, 2, 2.6, 3, 3.4])
    sharpness = np.array([1, 2, 3, 8, 1, 2, 9, 6.0])
    assert select_frames(sharpness, motion, 9) == [2, 5, 7]  # 1 is too near to 0.9, 3 to 2.6
    assert select_frames(sharpness, motion, 2) == [3, 6]
    sharpness[2] = 10
    assert select_frames(sharpness, motion, 2) == [2, 6]
    assert select_frames(np.ones(5), np.arange(5.0), 9) == [0, 1, 2, 3, 4]
    assert select_frames(np.zeros(0), np.zeros(0), 4) == []


def test_a_camera_that_trembles_makes_no_way():
    big = convert_to_pixels(view_of(Room(), camera_at(size=320)).image).mean(-1).astype(np.uint8)
    shifts = [(0, 0), (1, 0), (0, 2), (2, 1)] * 10
    still = (big[100 + y : 260 + y, 100 + x : 260 + x] for x, y in shifts)
    assert measure_frames(map(np.ascontiguousarray, still))[1].max() < 1
    moving = (big[100:260, 2 * n : 160 + 2 * n] for n in range(40))
    sharpness, motion = measure_frames(map(np.ascontiguousarray, moving))
    assert 10 < motion.max() <= 40
    assert np.all(sharpness > 0)


def broken(video: Path, folder: Path, kind: str) -> Path:
    """Write a file that is no video to choose frames from."""
    path = folder / f"{kind}.mp4"
    content = video.read_bytes()
    if kind == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif kind == "truncated-mkv":
        whole = change(video, folder / "whole.mkv").read_bytes()
        path = folder / "truncated.mkv"
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "sound":
        command = [find_ffmpeg(), "-v", "error", "-f", "lavfi", "-i", "sine=d=1", str(path)]
        subprocess.run(command, check=True)
    elif kind == "list":  # which must not be followed
        path.write_text(f"ffconcat version 1.0\nfile '{video}'\n")
    elif kind == "still":
        write_video(path, film()[:STILL], 10)
    else:
        path.write_bytes({"empty": b"", "text": b"no video", "pointer": LFS}[kind])
    return path


LFS = b"version https://git-lfs.github.com/spec/v1\n"
UNREADABLE = "is no video that can be read to its end ("
BROKEN = {
    **dict.fromkeys(("truncated", "truncated-mkv", "sound", "list", "empty", "text"), UNREADABLE),
    "still": "The camera hardly moves in ",
    "pointer": "is a git-lfs pointer",
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_cannot_be_used_is_refused_with_a_sentence(video, tmp_path, monkeypatch, capsys, kind):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    given, out = broken(video, tmp_path, kind), tmp_path / "out"
    for command in ("poses", "complete"):
        assert run(monkeypatch, command, given, "--out", out, "--quiet") == 2
        said = capsys.readouterr().err
        assert BROKEN[kind] in said
        assert said.count("\n") == 1
        assert "@ 0x" not in said
        assert not out.exists()


@pytest.mark.linux
@pytest.mark.parametrize("said", ["P6", "P6\\n16 1", "P6\\n16 16\\n25", "P6\\n16 16\\n255\\nab"])
def test_a_decoder_that_ends_within_a_frame_is_a_sentence(video, tmp_path, monkeypatch, said):
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\nprintf '{said}'\necho 'cut off' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr("gscompleter.system.files.video.find_ffmpeg", lambda: str(program))
    with pytest.raises(InputError, match=r"no video that can be read to its end \(cut off\)"):
        list(read_video(video, "null", is_grey=False))


@pytest.mark.parametrize("count", [2, 5000])
def test_too_few_or_too_many_frames_are_refused(video, tmp_path, monkeypatch, capsys, count):
    words = ("poses", video, "--out", tmp_path / "out", "--frames", count)
    assert run(monkeypatch, *words) == 2
    assert "frames" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["poses", "complete"])
def test_frames_of_a_folder_of_photographs_are_refused(tmp_path, monkeypatch, capsys, command):
    folder = tmp_path / "photographs"
    folder.mkdir()
    Image.new("RGB", (32, 24)).save(folder / "a.png")
    words = (command, folder, "--out", tmp_path / "out", "--frames", 8)
    assert run(monkeypatch, *words) == 2
    assert "--frames chooses from a video" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_missing_video_is_refused(tmp_path, monkeypatch, capsys):
    for command in ("poses", "complete"):
        words = (tmp_path / "no.mp4", "--out", tmp_path / "out", "--frames", 8)
        assert run(monkeypatch, command, *words) == 2
        assert re.search("There is no .*no.mp4;", capsys.readouterr().err)


def test_a_missing_package_is_named(video, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert run(monkeypatch, "poses", video, "--out", tmp_path / "out", "--quiet") == 2
    assert "pip install gscompleter[film]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_many_frames_can_be_chosen(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (300, 24, 32, 3), dtype=np.uint8)
    write_video(tmp_path / "noise.mp4", noise, 10)
    assert len(extracted(tmp_path / "noise.mp4", tmp_path / "frames", 250)) > 200


def test_the_next_run_keeps_the_poses_unless_it_wants_other_frames(video, tmp_path, monkeypatch):
    out = tmp_path / "poses"
    names = [f"frame_{number:06d}.jpg" for number in range(40)]
    stand_in(monkeypatch, tmp_path, model_script(names))
    first = find_poses(video, out, num_frames=8)
    assert first.origin.startswith("8 sharp frames of ")
    assert len(list((out / "images").iterdir())) == 8
    assert {path.name for path in out.iterdir()} == {"images", "sparse", "summary.json"}
    stand_in(monkeypatch, tmp_path, "raise SystemExit('asked again')")
    assert find_poses(video, out, num_frames=8).reused
    with pytest.raises(InputError, match="asked again"):
        find_poses(video, out, overwrite=True, num_frames=9)


@pytest.mark.slow
def test_a_video_is_completed_by_one_command(video, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    out = tmp_path / "out"
    words = ["complete", video, "--out", out, "--frames", 8, "--resolution", 48, 48]
    assert run(monkeypatch, *words, "--context", 0, 2, "--target", 4) == 0
    said = capsys.readouterr().err
    assert "8 sharp frames of " in said
    assert " photographs, 8 of 8 photographs." in said.replace("\n", " ")
    assert (out / "completed.ply").exists()

    opened = open_photographs(out / "colmap")
    found = np.stack([opened.camera(i).center.numpy() for i in range(len(opened))])
    true = np.stack([CAMERAS[int(frame.name[6:12])].center.numpy() for frame in opened.frames])
    off = np.linalg.norm(similarity_removed(found, true) - true, axis=1)
    assert off.max() < 0.04  # of an extent of 2.1

    monkeypatch.setattr(poses, "MAPPING_PROCESS", "nobody")
    words = [*words, "--context", 0, 2, "--target", 4, "--overwrite"]
    assert run(monkeypatch, *words) == 0  # with the cameras that are there


def test_a_360_degree_video_gives_panoramas(tmp_path):
    path = tmp_path / "walk.mp4"
    places = [(x, 0.0, 1.0) for x in (-0.8, -0.4, 0.0, 0.4)]
    files = [panorama(tmp_path / f"{n}.png", place) for n, place in enumerate(places)]
    write_video(path, [np.asarray(Image.open(file)) for file in files], 10)
    extracted(path, tmp_path / "frames")
    assert has_panoramas(sorted((tmp_path / "frames").iterdir()))
