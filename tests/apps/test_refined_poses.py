"""Commands on photographs whose poses matches contradict."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from command import run
from gscompleter import load_ply, save_ply
from gscompleter.apps.inputs import refined_poses
from gscompleter.apps.inputs.reading import read_photographs
from gscompleter.apps.inputs.splat import locate_splat, move_to_splat
from gscompleter.apps.inputs.task import InputSplatFile, Opened
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.formats import open_photographs
from gscompleter.data.transforms import OPENCV_FROM_OPENGL
from gscompleter.splats.edits import EditDraft, Edits, record_edit
from scenes import Room, gaussians_of, photographed, random_gaussians, view_of
from shaken_room import CAMERAS, CONTEXT, DONE, SHAKEN, correct, write_shaken


@pytest.fixture
def scene(tmp_path) -> Path:
    """Write photographs of the room, one of them with a wrong pose."""
    return write_shaken(tmp_path / "scene")


def complete(monkeypatch, scene: Path, out: Path, *more: object) -> dict:
    """Complete at a photograph, and return the summary."""
    words = ("--context", *CONTEXT, "--target", 6, "--resolution", 96, 96, "--out", out)
    assert run(monkeypatch, "complete", scene, *words, *more) == 0
    return json.loads((out / "summary.json").read_text())


# `test_a_cleaning_compares_at_refined_poses_and_the_next_command_takes_them` is shorter.
@pytest.mark.slow
def test_contradicted_poses_are_refined_and_the_next_command_takes_them(
    scene, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(refined_poses, "refine_poses", correct)
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
    monkeypatch.setattr(refined_poses, "refine_poses", None)
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
    monkeypatch.setattr(refined_poses, "refine_poses", None)
    scene = photographed(tmp_path / "scene", CAMERAS)
    complete(monkeypatch, scene, tmp_path / "out", "--dry-run")
    assert not (tmp_path / "out" / "refined_poses.json").exists()


def test_without_colmap_a_line_says_what_would_help(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(refined_poses, "has_pycolmap", lambda: False)
    complete(monkeypatch, scene, tmp_path / "out", "--dry-run")
    assert "pip install 'gscompleter[poses]' refines them" in capsys.readouterr().err


def test_poses_that_cannot_be_refined_are_told(scene, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    monkeypatch.setattr(refined_poses, "refine_poses", lambda given: (given, None))
    complete(monkeypatch, scene, tmp_path / "out", "--dry-run")
    said = capsys.readouterr().err.replace("\n", " ")
    assert "Given poses are kept, though matches contradict them by" in said


@pytest.mark.slow
def test_refined_poses_that_agree_no_better_are_not_taken(scene, tmp_path, monkeypatch, capsys):
    worse = replace(DONE, refined_error=0.39)
    monkeypatch.setattr(refined_poses, "refine_poses", lambda given: (given, worse))
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


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    """Write a splat of what the photograph with the wrong pose shows, from where it was taken."""
    path = tmp_path_factory.mktemp("splat") / "room.ply"
    save_ply(path, gaussians_of(view_of(Room(), CAMERAS[SHAKEN])))
    return path


@pytest.mark.slow
def test_photographs_come_to_a_given_splat(scene, splat, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(refined_poses, "refine_poses", correct)
    summary = complete(monkeypatch, scene, tmp_path / "refined", "--scene", splat)
    done = summary["scene"]["refined_poses"]
    assert done["splat_refined"] > done["splat_given"] + 0.1
    said = capsys.readouterr().err.replace("\n", " ")
    assert f"agrees with the photographs at {done['splat_given']:.2f} dB as given" in said
    assert (tmp_path / "refined" / "refined_poses.json").is_file()
    # The photographs have moved, and the splat has not.
    assert summary["frame"]["method"] == "given"

    kept = complete(monkeypatch, scene, tmp_path / "kept", "--scene", splat, "--no-refine-poses")
    assert kept["scene"]["refined_poses"] is None
    assert summary["context"][1]["psnr_before"] > kept["context"][1]["psnr_before"] + 0.5


# `tests/evaluation/test_scene_poses.py` and `tests/data/test_refining.py` refine.
@pytest.mark.slow
def test_poses_that_a_given_splat_contradicts_are_kept(scene, splat, monkeypatch):
    photographs = open_photographs(scene)
    refined, _ = correct(photographs)
    opened = Opened(SceneRequest(scene), refined, "nerfstudio", len(refined))
    task = read_photographs(opened, CONTEXT, "cpu")
    task = move_to_splat(task, load_ply(splat), locate_splat(splat, False), opened)
    # As if matches agreed with the wrong camera, which the splat does not.
    done = refined_poses.ask_splat(opened, photographs, task, DONE)
    assert done.is_contradicted_by_splat
    assert not done.is_accepted
    assert "Given poses are kept, though they miss matches by 0.40 px" in done.describe()
    wrong = replace(opened, photographs=photographs)
    assert refined_poses.ask_splat(wrong, refined, task, DONE).is_accepted


def test_a_splat_is_asked_with_what_was_taken_out_of_it(scene, tmp_path, monkeypatch):
    given, taken_out = random_gaussians(20), random_gaussians(7, seed=1)
    save_ply(tmp_path / "given.ply", given)
    save_ply(tmp_path / "completed.ply", given)
    record_edit(
        *(tmp_path, EditDraft("remove"), 27, [], tmp_path / "given.ply", Edits(tmp_path), None),
        taken_out,
    )
    photographs = open_photographs(scene)
    opened = Opened(SceneRequest(scene), photographs, "nerfstudio", len(photographs))
    splat_file = InputSplatFile(tmp_path / "completed.ply")
    task = replace(read_photographs(opened, CONTEXT, "cpu"), scene=given, splat_file=splat_file)
    asked = []
    monkeypatch.setattr(refined_poses, "compare_poses", lambda splat, *_: asked.append(len(splat)))
    refined_poses.ask_splat(opened, photographs, task, DONE)
    assert asked == [len(given) + len(taken_out)]


@pytest.mark.parametrize("is_remade", [False, True])
def test_a_splat_that_is_made_anew_is_no_witness_of_poses(scene, monkeypatch, is_remade):
    photographs = open_photographs(scene)
    opened = Opened(SceneRequest(scene), photographs, "nerfstudio", len(photographs))
    task = read_photographs(opened, CONTEXT, "cpu")
    task = replace(task, scene=random_gaussians(20), is_remade=is_remade)
    worse = replace(DONE, splat_given=30.0, splat_refined=20.0)
    monkeypatch.setattr(refined_poses, "refine_poses", correct)
    monkeypatch.setattr(refined_poses, "ask_splat", lambda *_: worse)
    quiet = Console(quiet=True)
    taken, _ = refined_poses.read_at_refined_poses(opened, lambda _: task, quiet)
    assert (taken.given is not None) == is_remade
    # A command knows it before what it reads does.
    known, _ = refined_poses.read_at_refined_poses(opened, lambda _: task, quiet, asks_splat=False)
    assert known.given is not None


def test_a_cleaning_compares_at_refined_poses_and_the_next_command_takes_them(
    scene, splat, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(refined_poses, "refine_poses", correct)
    out = tmp_path / "out"
    words = ("--scene", splat, "--context", *CONTEXT, "--resolution", 96, 96)
    assert run(monkeypatch, "clean", scene, *words, "--out", out) == 0
    assert "refined ones by 0.10 px (of 256); the splat agrees" in capsys.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["scene"]["refined_poses"]["refined_error"] == DONE.refined_error
    (row,) = json.loads((out / "refined_poses.json").read_text())["frames"]
    pose = np.array(row["transform_matrix"]) @ OPENCV_FROM_OPENGL
    assert np.array_equal(pose, CAMERAS[SHAKEN].c2w.double().numpy())

    # The next command takes them, as they lie beside its splat.
    photographs = open_photographs(scene)
    opened = Opened(SceneRequest(scene), photographs, "nerfstudio", len(photographs))
    opened = refined_poses.take_over_poses(opened, out / "completed.ply", Console(quiet=True))
    assert opened.refinement is not None
    assert np.array_equal(opened.photographs.frames[SHAKEN].c2w, pose)
