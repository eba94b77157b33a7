"""`--json`: every command answers a program with one JSON object, and with nothing else."""

import json
import shutil
from pathlib import Path

import pytest

from batch_jobs import open_here
from command import run
from gscompleter import load_ply
from gscompleter.apps.batch import engine
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.cli import COMMANDS, OptionClasses
from gscompleter.system.files.reading import hash_file
from paths import ROOT

FRAMES = ("--context", 0, 1, "--near", 0.5, "--far", 20, "--resolution", 32)


@pytest.fixture
def answer(monkeypatch, capsys):
    """Run a command with --json, and return its answer; the standard output holds no more."""

    def ask(*words: object, code: int = 0) -> dict:
        capsys.readouterr()
        assert run(monkeypatch, *words, "--json") == code
        return json.loads(capsys.readouterr().out)

    return ask


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_the_option(command):
    names = {field for kind in OptionClasses()[command].__mro__ for field in vars(kind)}
    assert "json" in names


def test_every_answer_is_in_the_contracts():
    text = (ROOT / "docs" / "contracts.md").read_text("utf-8")
    section = text.split("## Answers as JSON")[1].split("\n## ")[0]
    assert [name for name in COMMANDS if f"`{name}`" not in section] == []


def test_a_completion_answers_with_its_summary(room, tmp_path, answer):
    out = tmp_path / "out"
    found = answer("complete", room, *FRAMES, "--target", 2, "--out", out)
    summary = json.loads((out / "summary.json").read_text())
    assert found == {"out": str(out), **summary}
    plan = ("--dry-run", "--quiet", "--out", tmp_path / "plan")
    again = answer("complete", room, *FRAMES, "--target", 2, *plan)
    assert [target["frame"] for target in again["targets"]] == [2]


def test_a_plan_answers_with_its_targets(room, tmp_path, answer):
    out = tmp_path / "out"
    found = answer("complete", room, *FRAMES, "--target", 2, "--dry-run", "--out", out)
    (target,) = found["targets"]
    assert target["frame"] == 2
    assert 0 < target["hole_fraction"] < 1
    assert Path(found["cameras"]).is_file()


def test_exported_holes_answer_with_their_file(room, tmp_path, answer):
    words = ("complete", room, *FRAMES, "--target", 2, "--out", tmp_path / "out")
    found = answer(*words, "--export-holes", tmp_path / "holes")
    assert found["holes"] == json.loads((tmp_path / "holes" / "holes.json").read_text())


def test_files_of_a_completion_answer(completed_room, tmp_path, answer, monkeypatch):
    monkeypatch.setattr(
        "gscompleter.apps.viewer.packages.load_libraries", lambda: Libraries({}, {})
    )
    out = tmp_path / "OUT"
    shutil.copytree(completed_room, out)
    completed = load_ply(out / "completed.ply")
    count = int((completed.generated > 0).sum())
    assert answer("report", out) == {"report": str(out / "report.html")}
    converted = tmp_path / "a.glb"
    assert answer("convert", out / "completed.ply", converted) == {
        "out": str(converted),
        "gaussians": len(completed),
        "generated": count,
        "notes": [],
        "rounding": None,
    }
    given = tmp_path / "given.ply"
    assert answer("strip", out / "completed.ply", "--out", given) == {
        "out": str(given),
        "gaussians": len(completed) - count,
        "generated_removed": count,
        # The scene was reconstructed, so that no file was given.
        "is_same_file": False,
        "missing": 0,
    }
    assert hash_file(given) == hash_file(out / "context.ply")
    page = tmp_path / "page.html"
    assert answer("view", out, "--save", page) == {"page": str(page), "notes": []}
    cleaned = answer("clean", "--scene", given, "--out", tmp_path / "clean")
    assert cleaned["gaussians"]["given"] == len(completed) - count


def test_what_is_installed_and_known_answers(answer):
    assert {"kind", "name", "there", "told", "install"} == set(answer("doctor")[0])
    assert answer("models")[0]["name"]
    assert answer("warmup")["folder"]


@pytest.mark.slow
def test_a_batch_answers_with_its_rows(room, tmp_path, answer, monkeypatch):
    monkeypatch.setattr(engine, "open_local", open_here)
    manifest = tmp_path / "scenes.csv"
    lines = ["folder,name,context,target,near,far,resolution"]
    lines += [f"{room},good,0 1,2,0.5,20,32", f"{tmp_path / 'nothing'},bad,0 1,2,0.5,20,32"]
    manifest.write_text("\n".join(lines) + "\n")
    found = answer("batch", manifest, "--out", tmp_path / "out", "--workers", 1, code=3)
    assert found["failed"] == 1
    assert {row["job"]: row["state"] for row in found["rows"]} == {"good": "done", "bad": "failed"}


def test_a_refusal_has_no_answer(tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "convert", tmp_path / "no.ply", tmp_path / "b.ply", "--json") == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("gscompleter: ")
