"""Validation of numbers in the input, with one sentence each."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from command import run
from gscompleter import InputError, load_camera, load_cameras, load_views
from gscompleter.data.local_origin import choose_local_origin, shift_to_origin
from gscompleter.data.scene import write_cameras
from scenes import camera_at, photographed, random_gaussians

SIZE = 64
PLACES = ((-0.3, 0), (0.1, 0), (0.7, 12))


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """Return a synthetic room photographed from three places."""
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    return photographed(tmp_path_factory.mktemp("room"), cameras)


def changed(scene: Path, folder: Path, change) -> Path:
    """Copy a scene with its first frame changed by `change(content, frame)`."""
    shutil.copytree(scene, folder)
    content = json.loads((folder / "transforms.json").read_text())
    change(content, content["frames"][0])
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def refused(monkeypatch, capsys, scene: Path, *more, target: object = 2) -> str:
    """Return the sentence of `complete`, which exits with 2 and writes nothing."""
    out = scene.parent / "out"
    where = ("--context", 0, 1, "--target", target, "--out", out)
    assert run(monkeypatch, "complete", scene, *where, *more) == 2
    said = capsys.readouterr().err
    assert said.startswith("gscompleter: ")
    assert said.count("\n") == 1
    assert len(said) < 1000
    assert not out.exists()
    return said


def at(row: int, value: float):
    def change(_content, frame):
        frame["transform_matrix"][row][3] = value

    return change


def to(**values):
    return lambda _content, frame: frame.update(values)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (to(fl_y=1e300), "`fl_y` of frame 0.png"),
        (to(fl_x=1e-300), "`fl_x` of frame 0.png"),
        (to(fl_x=1e9), "focal length is 1.5625e+07 times the size of the image"),
        (to(fl_x=1e-6), "focal length is 1.5625e-08 times the size of the image"),
        (to(cx=1e300), "`cx` of frame 0.png"),
        (to(cy=-1e6), "principal point lies -15625 image sizes from the corner"),
        (to(k1=1e300), "`k1` of frame 0.png"),
        (to(w=10**9), "`w` of frame 0.png"),
        (to(camera_angle_x=1e-300), "`camera_angle_x` of frame 0.png"),
        (at(0, 1e300), "`transform_matrix` of frame 0.png"),
        (at(2, -1e10), "pose holds 1e+10"),
        (to(camera_model="X" * 100_000), "camera model 'XXX"),
        (to(file_path="0" * 100_000), "`file_path` of frame 0"),
        (to(file_path="0\nb"), "frame 0 b of"),
        (to(file_path=["z"] * 50_000), "`file_path` of frame 0"),
        (to(fl_x="9" * 100_000), "`fl_x` of frame 0.png"),
        (lambda content, _: content.update(depth_unit_scale_factor=1e300), "depth_unit_scale"),
    ],
)
def test_impossible_cameras_get_one_short_sentence(
    room, tmp_path, monkeypatch, capsys, change, sentence
):
    said = refused(monkeypatch, capsys, changed(room, tmp_path / "scene", change))
    assert sentence in said


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--near", 1e-300), "near plane at 1e-300 is impossible"),
        (("--far", 1e300), "far plane at 1e+300 is impossible"),
        (("--resolution", 10**6, 10**6), "at most 16384"),
        (("--resolution", 16, 60_000), "at most 16384"),
        (("--resolution", 64, 10**400), "at most 16384"),
        (("--format", "x" * 100_000), "There is no format 'xxx"),
    ],
)
def test_impossible_options_get_one_short_sentence(
    room, tmp_path, monkeypatch, capsys, more, sentence
):
    scene = shutil.copytree(room, tmp_path / "scene")
    assert sentence in refused(monkeypatch, capsys, scene, *more)


@pytest.mark.parametrize(
    ("w", "h", "sentence"),
    [(10**9, 10**9, "`w` of frame 0"), (1, 5000, "at least 16"), (64, 15, "at least 16")],
)
def test_a_target_camera_of_an_impossible_size_is_refused(
    room, tmp_path, monkeypatch, capsys, w, h, sentence
):
    scene = shutil.copytree(room, tmp_path / "scene")
    file = tmp_path / "target.json"
    write_cameras(file, [camera_at(0.7, size=SIZE)])
    content = json.loads(file.read_text())
    content["frames"][0].update(w=w, h=h)
    file.write_text(json.dumps(content))
    assert sentence in refused(monkeypatch, capsys, scene, target=file)


def test_a_photograph_on_its_side_is_refused(tmp_path):
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    content = {"fl_x": 50.0, "w": 60, "h": 40, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    for w, h in ((60, 40), (30, 20), (61, 40)):
        Image.new("RGB", (w, h)).save(tmp_path / "a.png")
        assert load_views(tmp_path)[0].camera.width == w
    Image.new("RGB", (20, 30)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="has 20 × 30 pixels, and its camera 60 × 40"):
        load_views(tmp_path)


def test_a_strip_that_would_become_too_long_is_refused(tmp_path):
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50.0, "frames": frames}))
    Image.new("RGB", (2, 400)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="2 × 400 pixels that covers 256 × 256 .* above 16384"):
        load_views(tmp_path, resolution=(256, 256))


def moved(scene: Path, folder: Path, by: tuple[float, float, float]) -> Path:
    """Copy a scene with its cameras moved by `by`, in float64."""
    shutil.copytree(scene, folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        for row, offset in enumerate(by):
            frame["transform_matrix"][row][3] += offset
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


UTM = (482_000.25, 5_458_000.5, 120.0)


def test_large_coordinates_keep_the_baselines(room, tmp_path):
    far = moved(room, tmp_path / "far", UTM)
    near, remote = load_views(room), load_views(far)
    for ours, theirs in zip(near, remote, strict=True):
        expected = ours.camera.center - near[0].camera.center
        assert np.allclose(theirs.camera.center, expected, atol=1e-6)
    # A camera alone is in the same frame as the views.
    assert np.array_equal(load_camera(far, 2).c2w, remote[2].camera.c2w)


def test_a_photograph_alone_in_a_map_has_a_local_origin():
    """What is seen from it would be rounded to steps of half a metre."""
    pose = np.eye(4)
    pose[:3, 3] = UTM
    assert choose_local_origin([pose]).tolist() == list(UTM)
    assert choose_local_origin([pose, pose]).tolist() == list(UTM)
    pose[:3, 3] /= 1000
    assert not choose_local_origin([pose]).any()


def test_a_splat_far_away_is_fine_enough_for_one_camera_or_for_none():
    """Of one camera the spread tells nothing."""
    camera = camera_at(size=16)
    splat = replace(random_gaussians(50), means=random_gaussians(50).means + 5)
    for offset, is_fine in ((2000.0, True), (5e6, False)):
        origin = np.array([offset, 0.0, 0.0])
        there = replace(splat, means=splat.means + torch.from_numpy(origin).float())
        for cameras in ([camera], [camera, camera]):
            if is_fine:
                moved_back = shift_to_origin(origin, there, cameras)
                assert torch.allclose(moved_back.means, splat.means, atol=1e-3)
            else:
                with pytest.raises(InputError, match="float32 has steps of 0.5"):
                    shift_to_origin(origin, there, cameras)


def test_coordinates_that_float32_can_hold_are_left_alone(room, tmp_path):
    aside = moved(room, tmp_path / "aside", (300.0, -200.0, 0.0))
    assert load_camera(aside, 0).center.tolist() == pytest.approx([299.7, -200.0, 0.0])


# The next test completes around a local origin, and `test_map_coordinates.py` in a map.
@pytest.mark.slow
def test_a_remote_scene_is_completed_around_a_local_origin(room, tmp_path, monkeypatch):
    far, out = moved(room, tmp_path / "far", UTM), tmp_path / "out"
    origin = np.array([UTM[0] - 0.3, *UTM[1:]])
    where = ("--context", 0, 1, "--out", out)
    # Frame 2 of the scene, from a file of cameras in map coordinates.
    target = shutil.copy(far / "transforms.json", tmp_path / "target.json")
    cameras = json.loads(target.read_text())
    cameras["frames"] = cameras["frames"][2:]
    target.write_text(json.dumps(cameras))
    assert run(monkeypatch, "complete", far, *where, "--target", target) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frame"]["method"] == "given"
    assert np.allclose(np.array(summary["frame"]["transform"])[:3, 3], -origin)
    (row,) = summary["targets"]
    assert 0.05 < row["hole_fraction"] < 0.9
    assert row["added"] > 0
    (camera,) = load_cameras(target, origin=origin.tolist())
    assert np.allclose(camera.center, load_camera(far, 2).center)


# `tests/apps/test_map_coordinates.py` moves one.
@pytest.mark.slow
def test_a_splat_in_large_coordinates_is_moved_or_refused(room, tmp_path, monkeypatch, capsys):
    from gscompleter import load_ply, save_ply
    from gscompleter.types import merge
    from scenes import gaussians_of

    views = load_views(room)[:2]
    splat = merge([gaussians_of(view, view.image[..., 0] + 2) for view in views])
    for offset, fine in ((2000.0, True), (5e6, False)):
        far = moved(room, tmp_path / f"{offset}" / "far", (offset, 0.0, 0.0))
        splat.means[:, 0] += offset
        save_ply(far.parent / "splat.ply", splat)
        splat.means[:, 0] -= offset
        more = ("--scene", far.parent / "splat.ply", "--quiet")
        if fine:
            out = far.parent / "out"
            where = ("--context", 0, 1, "--target", 2, "--out", out)
            assert run(monkeypatch, "complete", far, *where, *more) == 0
            assert load_ply(out / "context.ply").means.abs().max() < 20
            frame = json.loads((out / "summary.json").read_text())["frame"]
            assert frame["transform"][0][3] == pytest.approx(0.3 - offset)
        else:
            said = refused(monkeypatch, capsys, far, *more)
            assert "relative to a local origin" in said
