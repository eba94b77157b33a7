"""Files of a trainer that go with its splat."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from command import run
from gscompleter import save_ply
from gscompleter.apps.inputs.captures import select_listed_cameras
from gscompleter.data.camera_files import read_cameras
from gscompleter.splats.alignment.trainer_files import (
    find_trainer_files,
    keep_trainer_files,
    write_trainer_cameras,
)
from gscompleter.splats.alignment.trainer_frames import find_cameras_beside
from scenes import camera_at, random_gaussians

LIST = '[{"img_name": "a"}]'


def write(path: Path, text: str = "x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_of_several_lists_the_one_with_the_name_of_the_splat_goes_with_it(tmp_path):
    write(tmp_path / "cameras.json", LIST)
    own = write(tmp_path / "cameras_2.json", LIST.replace("a", "b"))
    write(tmp_path / "cameras_3.json", LIST)
    splat = tmp_path / "splat_2.ply"
    # A splat alone looks from there, too.
    assert find_cameras_beside(splat) == own
    (tmp_path / "out").mkdir()
    keep_trainer_files(splat, tmp_path / "out")
    kept = tmp_path / "out" / "trainer" / "cameras.json"
    assert kept.read_text() == own.read_text()
    # The result has another name, and finds it.
    assert find_cameras_beside(tmp_path / "out" / "completed.ply") == kept
    # Another splat beside it may be in another frame.
    assert find_cameras_beside(tmp_path / "out" / "moved.ply") is None
    # Whatever lies beside the result comes first.
    near = write(tmp_path / "out" / "cameras.json", LIST)
    assert find_cameras_beside(tmp_path / "out" / "completed.ply") == near


def test_all_that_tells_of_a_training_goes_from_result_to_result(tmp_path):
    model = tmp_path / "model"
    splat = model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    write(splat)
    write(model / "cameras.json", LIST)
    write(model / "cfg_args", "Namespace(resolution=2)")
    write(splat.parent / "dataparser_transforms.json", "{}")
    # gsplat's example trainer keeps its settings above the folder of its splats.
    write(splat.parent.parent / "cfg.yml", "data_factor: 2\n")
    first = tmp_path / "first"
    second = tmp_path / "second"
    for folder, given in ((first, splat), (second, first / "completed.ply")):
        folder.mkdir()
        keep_trainer_files(given, folder)
        kept = {path.name: path.read_text() for path in (folder / "trainer").iterdir()}
        assert kept == {
            "cameras.json": LIST,
            "cfg_args": "Namespace(resolution=2)",
            "dataparser_transforms.json": "{}",
            "cfg.yml": "data_factor: 2\n",
        }


def test_beside_a_splat_alone_there_is_nothing_to_keep(tmp_path):
    splat = write(tmp_path / "lone" / "splat.ply")
    write(tmp_path / "lone" / "cameras.json", '{"not": "a list"}')
    assert list(find_trainer_files(splat)) == []
    keep_trainer_files(splat, tmp_path)
    assert not (tmp_path / "trainer").exists()


def test_a_command_keeps_them_and_replaces_them_with_its_results(tmp_path, monkeypatch):
    splat = tmp_path / "given" / "splat.ply"
    splat.parent.mkdir()
    save_ply(splat, random_gaussians(2000))
    write(tmp_path / "given" / "cameras.json", LIST)
    out = tmp_path / "out"
    words = ("clean", "--scene", splat, "--out", out, "--quiet")
    assert run(monkeypatch, *words) == 0
    kept = out / "trainer" / "cameras.json"
    assert kept.read_text() == LIST
    (tmp_path / "given" / "cameras.json").unlink()
    assert run(monkeypatch, *words, "--overwrite") == 0
    assert not kept.exists()


def test_cameras_are_written_as_they_are_read(tmp_path):
    cameras = {"a/1.jpg": camera_at(x=0.5, yaw=20), "b/1.jpg": camera_at(y=-0.25, size=64)}
    write_trainer_cameras(tmp_path, cameras)
    frames = read_cameras(tmp_path / "trainer" / "cameras.json")
    assert [frame.name for frame in frames] == list(cameras)
    for frame, camera in zip(frames, cameras.values(), strict=True):
        np.testing.assert_allclose(frame.c2w, camera.c2w.numpy(), atol=1e-6)
        assert frame.intrinsics.size == (camera.width, camera.height)
        assert frame.intrinsics.focal == (camera.K[0, 0].item(), camera.K[1, 1].item())


def test_a_scene_of_photographs_is_completed_further_without_them(
    completed_room, tmp_path, monkeypatch, capsys
):
    summary = json.loads((completed_room / "summary.json").read_text())
    splat = completed_room / "completed.ply"
    words = ("complete", "--scene", splat, "--auto", 1, "--dry-run", "--out", tmp_path / "plan")
    assert run(monkeypatch, *words) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert f"at {len(summary['context'])} cameras of " in said
    # Its photographs are found to be where they were.
    listed = json.loads((completed_room / "trainer" / "cameras.json").read_text())
    assert [entry["img_name"] for entry in listed] == [row["file"] for row in summary["context"]]


def test_cameras_of_the_list_that_see_what_is_removed_join_those_around_it(tmp_path):
    place = torch.tensor([[0.0, 0.0, 3.0], [0.1, 0.1, 3.1]])
    sides = {f"{x}.jpg": camera_at(x=x, size=128) for x in (-0.5, -0.4, -0.3, 0.3, 0.4, 0.5)}
    away = {"away.jpg": camera_at(yaw=90, size=128)}
    write_trainer_cameras(tmp_path, {**away, **sides})
    path = tmp_path / "trainer" / "cameras.json"
    listed = select_listed_cameras(path, place, np.zeros(3), 64)
    assert len(listed) == 4
    # Far from each other, and no larger than the others.
    assert {round(camera.center[0].item(), 1) for camera in listed} >= {-0.5, 0.5}
    assert {camera.width for camera in listed} == {64}

    write_trainer_cameras(tmp_path, away)
    assert select_listed_cameras(path, place, np.zeros(3), 64) == []
    # Nobody named the list.
    path.write_text("[{}]")
    assert select_listed_cameras(path, place, np.zeros(3), 64) == []
