"""Poses of a data set in `evaluate`: refined once for a scene, the same for all methods."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command import run
from gscompleter.apps.commands.evaluate import EvaluateOptions, decide_evaluation
from gscompleter.apps.evaluating import scoring
from gscompleter.apps.evaluating.cases import collect_tasks
from gscompleter.apps.requests.evaluation import EvaluationRequest, ReproductionRequest
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation import scene_poses
from gscompleter.evaluation.run_facts import RunFacts, strip_folder
from gscompleter.evaluation.scene_poses import is_contradicted, refine_scene
from gscompleter.evaluation.store import list_row_paths, read_run_file
from scenes import photographed
from shaken_room import CAMERAS, CONTEXT, DONE, SHAKEN, correct, write_shaken


@pytest.fixture
def scene(tmp_path) -> Path:
    """Write photographs of the room, one of them with a wrong pose."""
    return write_shaken(tmp_path / "room")


@pytest.fixture
def cases(scene) -> Path:
    """Write a case whose context has the wrong pose."""
    row = {"scene": scene.name, "context": CONTEXT, "target": 6, "near": 0.5, "far": 20.0}
    file = scene.parent / "cases.json"
    file.write_text(json.dumps({"resolution": [64, 64], "cases": [row]}))
    return file


def refuse(photographs):
    """Stand in for a second refinement, which nobody needs."""
    raise AssertionError


def test_a_scene_is_refined_once_and_read_back(scene, tmp_path, monkeypatch):
    photographs = open_photographs(scene)
    assert is_contradicted(photographs)
    monkeypatch.setattr(scene_poses, "refine_poses", correct)
    refined, done = refine_scene(photographs, tmp_path / "out")
    assert done == DONE
    assert np.array_equal(refined.frames[SHAKEN].c2w, CAMERAS[SHAKEN].c2w.double().numpy())
    monkeypatch.setattr(scene_poses, "refine_poses", refuse)
    again, done = refine_scene(photographs, tmp_path / "out")
    assert done == DONE
    for frame, wanted in zip(again.frames, refined.frames, strict=True):
        assert np.array_equal(frame.c2w, wanted.c2w)


def test_poses_that_agree_stay_as_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_poses, "refine_poses", refuse)
    photographs = open_photographs(photographed(tmp_path / "room", CAMERAS))
    for _ in range(2):
        kept, done = refine_scene(photographs, tmp_path / "out")
        assert done is None
        assert [frame.c2w for frame in kept.frames] == [frame.c2w for frame in photographs.frames]


def test_a_refinement_that_agrees_no_better_is_remembered(scene, tmp_path, monkeypatch):
    worse = replace(DONE, refined_error=0.39)
    monkeypatch.setattr(scene_poses, "refine_poses", lambda given: (given, worse))
    photographs = open_photographs(scene)
    refine_scene(photographs, tmp_path / "out")
    monkeypatch.setattr(scene_poses, "refine_poses", refuse)
    kept, done = refine_scene(photographs, tmp_path / "out")
    assert done == worse
    assert kept.frames == photographs.frames


def test_a_damaged_photograph_costs_no_case_of_others(scene):
    photographs = open_photographs(scene)
    photographs.frames[0].file.path.write_bytes(b"no image")
    assert is_contradicted(photographs)


def evaluate(monkeypatch, cases: Path, out: Path, *more: object) -> int:
    """Score the scene before completion."""
    return run(monkeypatch, "evaluate", cases, "--methods", "context", "--out", out, *more)


def read_context_psnr(out: Path) -> float:
    """Return the PSNR of the photograph with the wrong pose."""
    (path,) = list_row_paths(out)
    return read_run_file(path)["steps"][0]["scores"]["context_psnr"][1]["after"]


@pytest.mark.slow
def test_methods_see_refined_cameras_and_tables_say_so(cases, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scene_poses, "refine_poses", correct)
    refined, given = tmp_path / "refined", tmp_path / "given"
    assert evaluate(monkeypatch, cases, refined) == 0
    assert evaluate(monkeypatch, cases, given, "--no-refine-poses") == 0
    assert read_context_psnr(refined) > read_context_psnr(given) + 0.5

    first_line = (refined / "tables.md").read_text().splitlines()[0]
    said = "poses: refined where matches missed them (room 0.40 to 0.10, in pixels of images whose"
    assert said in first_line
    assert "poses: as given" in (given / "tables.md").read_text().splitlines()[0]
    content = json.loads((refined / "tables.json").read_text())
    assert content["made_with"]["poses"] == {"room": vars(DONE)}

    # No folder mixes both.
    capsys.readouterr()
    assert evaluate(monkeypatch, cases, refined, "--no-refine-poses") == 2
    assert "refines_poses" in capsys.readouterr().err


def test_a_line_says_what_was_done_to_the_poses_of_each_scene():
    facts = RunFacts("plane-sweep", "warp-inpaint", 0, 0, ())
    assert facts.sentence.endswith("seed 0; poses: as given.")
    poses = {f"room{number}": vars(DONE) for number in range(7)}
    sentence = replace(facts, poses=poses).sentence
    assert "room0 0.40 to 0.10, " in sentence
    assert "room5" not in sentence
    assert sentence.endswith("more scenes, in pixels of images whose shorter side has 256).")


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("own/models.py:paint", "models.py:paint"),
        ("/home/me/flux.1", "flux.1"),
        ("~/flux.1", "flux.1"),
        ("../flux.1", "flux.1"),
        ("weights/own.safetensors", "own.safetensors"),
        ("USER/flux.1", "USER/flux.1"),
        ("warp-inpaint", "warp-inpaint"),
    ],
)
def test_a_line_that_may_be_published_names_no_folder(name, shown):
    assert strip_folder(name) == shown


def test_without_colmap_poses_stay_and_a_line_says_what_would_help(
    cases, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(scoring, "has_pycolmap", lambda: False)
    assert evaluate(monkeypatch, cases, tmp_path / "out") == 0
    assert "pip install 'gscompleter[poses]' refines" in capsys.readouterr().err
    assert "poses: as given" in (tmp_path / "out" / "tables.md").read_text()


def decide(*paths: Path, **options) -> EvaluationRequest | ReproductionRequest:
    """Decide on a run."""
    return decide_evaluation(EvaluateOptions(paths=paths, out=Path("out"), **options))


def test_benchmarks_of_others_leave_poses_as_given(scene, cases, tmp_path):
    assert decide(cases).cases.refines_poses
    assert not decide(cases, no_refine_poses=True).cases.refines_poses
    for reproduction in ({"preset": "re10k"}, {"table": ("models",)}):
        assert not decide(cases, **reproduction).run.cases.refines_poses

    # A rule chooses frames of any data; an index fixes those of a benchmark.
    index = tmp_path / "index.json"
    index.write_text(json.dumps({"room": {"context": [2, 4], "target": [6]}}))
    for protocol, refines in (("n-2", True), (str(index), False)):
        tasks = collect_tasks(decide(scene, protocol=(protocol,)).cases, [], [])
        assert tasks
        assert all(task.refines_poses == refines for task in tasks)
