"""Commands on photographs whose poses matches contradict."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command import run
from gscompleter import load_ply
from gscompleter.apps.completing import preparation
from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from scenes import camera_at, photographed

CAMERAS = [
    camera_at(x=0.3 * i - 1.05, y=0.1 * (i % 3), z=0.05 * i, yaw=14 - 4 * i, size=160)
    for i in range(8)
]
SHAKEN = 4
"""Photograph whose given pose is turned by a pixel and a half."""
CONTEXT = (2, SHAKEN)
DONE = PoseRefinement(8, given_error=0.4, refined_error=0.1, moved=0.05)


@pytest.fixture
def scene(tmp_path) -> Path:
    """Write photographs of the room, one of them with a wrong pose."""
    folder = photographed(tmp_path / "scene", CAMERAS)
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][SHAKEN]["transform_matrix"] = turn(
        np.array(content["frames"][SHAKEN]["transform_matrix"])
    ).tolist()
    path.write_text(json.dumps(content))
    return folder


def turn(pose: np.ndarray) -> np.ndarray:
    """Turn a camera by 0.6 degrees to the side and up."""
    angle = np.radians(0.6)
    about_y = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    about_x = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ np.array(about_y) @ np.array(about_x)
    return turned


def correct(photographs: Photographs) -> tuple[Photographs, PoseRefinement]:
    """Stand in for COLMAP: give the wrong camera its true pose."""
    frames = list(photographs.frames)
    frames[SHAKEN] = replace(frames[SHAKEN], c2w=CAMERAS[SHAKEN].c2w.double().numpy())
    return replace(photographs, frames=tuple(frames)), DONE


QUICK = [
    word
    for name in ("registration.iterations", "refine.iterations", "refine.color-rounds")
    for word in (f"--config.{name}", 2)
]
"""Few steps of the stages, where the result does not matter."""


def complete(monkeypatch, scene: Path, out: Path, *more: object) -> dict:
    """Complete at a photograph, and return the summary."""
    words = ("--context", *CONTEXT, "--target", 6, "--resolution", 96, 96, "--out", out)
    assert run(monkeypatch, "complete", scene, *words, *more) == 0
    return json.loads((out / "summary.json").read_text())


def test_refined_poses_are_told_and_kept(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(preparation, "refine_poses", correct)
    out = tmp_path / "out"
    assert complete(monkeypatch, scene, out, *QUICK)["scene"]["refined_poses"] == vars(DONE)
    assert DONE.describe() in capsys.readouterr().err.replace("\n", " ")
    (row,) = json.loads((out / "refined_poses.json").read_text())["frames"]
    pose = np.array(row["transform_matrix"]) @ OPENCV_FROM_OPENGL
    assert np.array_equal(pose, CAMERAS[SHAKEN].c2w.double().numpy())

    # COLMAP is not asked again beside a splat: its poses lie there.
    monkeypatch.setattr(preparation, "refine_poses", None)
    capsys.readouterr()
    splat = ("--scene", out / "completed.ply", "--dry-run")
    complete(monkeypatch, scene, tmp_path / "again", *QUICK, *splat)
    assert "are used" in capsys.readouterr().err


# `test_refined_poses_are_told_and_kept` begins so.
@pytest.mark.slow
def test_contradicted_poses_are_refined_and_the_next_command_takes_them(
    scene, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(preparation, "refine_poses", correct)
    first = complete(monkeypatch, scene, tmp_path / "first")
    assert first["scene"]["refined_poses"] == vars(DONE)
    assert DONE.describe() in capsys.readouterr().err.replace("\n", " ")
    stored = json.loads((tmp_path / "first" / "refined_poses.json").read_text())
    (row,) = stored["frames"]
    pose = np.array(row["transform_matrix"]) @ OPENCV_FROM_OPENGL
    assert np.array_equal(pose, CAMERAS[SHAKEN].c2w.double().numpy())

    # As given, the photographs fit the scene worse.
    kept = complete(monkeypatch, scene, tmp_path / "kept", "--no-refine-poses")
    assert kept["scene"]["refined_poses"] is None
    assert not (tmp_path / "kept" / "refined_poses.json").exists()
    assert first["context"][1]["psnr_after"] > kept["context"][1]["psnr_after"] + 0.5

    # COLMAP is not asked again beside a splat: its poses lie there.
    monkeypatch.setattr(preparation, "refine_poses", None)
    capsys.readouterr()
    again = tmp_path / "again"
    splat = tmp_path / "first" / "completed.ply"
    second = complete(monkeypatch, scene, again, "--scene", splat)
    assert "are used" in capsys.readouterr().err
    assert second["context"][1]["psnr_before"] > kept["context"][1]["psnr_after"] + 0.5
    assert (again / "refined_poses.json").read_bytes() == (
        tmp_path / "first" / "refined_poses.json"
    ).read_bytes()
    assert len(load_ply(again / "completed.ply")) >= len(load_ply(splat))


def test_poses_that_agree_are_not_refined(tmp_path, monkeypatch):
    monkeypatch.setattr(preparation, "refine_poses", None)
    scene = photographed(tmp_path / "scene", CAMERAS)
    complete(monkeypatch, scene, tmp_path / "out", "--dry-run")
    assert not (tmp_path / "out" / "refined_poses.json").exists()


def test_without_colmap_a_line_says_what_would_help(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(preparation, "has_pycolmap", lambda: False)
    complete(monkeypatch, scene, tmp_path / "out", "--dry-run")
    assert "pip install 'gscompleter[poses]' refines them" in capsys.readouterr().err


@pytest.mark.slow
def test_refined_poses_that_agree_no_better_are_not_taken(scene, tmp_path, monkeypatch, capsys):
    worse = replace(DONE, refined_error=0.39)
    monkeypatch.setattr(preparation, "refine_poses", lambda given: (given, worse))
    summary = complete(monkeypatch, scene, tmp_path / "out")
    assert summary["scene"]["refined_poses"] is None
    assert "Given poses are kept" in capsys.readouterr().err


@pytest.mark.slow
def test_colmap_refines_the_photographs_of_a_command(scene, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    summary = complete(monkeypatch, scene, tmp_path / "out")
    done = summary["scene"]["refined_poses"]
    assert done["photographs"] == 8
    assert done["refined_error"] < 0.8 * done["given_error"]
    photographs = open_photographs(scene)
    stored = json.loads((tmp_path / "out" / "refined_poses.json").read_text())
    pose = np.array(stored["frames"][SHAKEN]["transform_matrix"]) @ OPENCV_FROM_OPENGL
    true = CAMERAS[SHAKEN].c2w.double().numpy()
    angle = np.degrees(np.arccos((np.trace(pose[:3, :3].T @ true[:3, :3]) - 1) / 2))
    before = photographs.frames[SHAKEN].c2w
    assert angle < 0.3 < np.degrees(np.arccos((np.trace(before[:3, :3].T @ true[:3, :3]) - 1) / 2))
