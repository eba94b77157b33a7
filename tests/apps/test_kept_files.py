"""Commands keep what they were not asked to replace: files beside a result, and what links name."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter import InputError, save_ply
from gscompleter.evaluation.store import claim
from scenes import random_gaussians


@pytest.fixture
def splat(tmp_path) -> Path:
    """Write a splat without labels."""
    save_ply(tmp_path / "scene.ply", random_gaussians(8))
    return tmp_path / "scene.ply"


def write_labelled(path: Path) -> Path:
    """Write a splat of which some Gaussians were generated."""
    labels = torch.tensor([0] * 6 + [1] * 2, dtype=torch.uint8)
    save_ply(path, replace(random_gaussians(8), generated=labels))
    return path


@pytest.mark.parametrize("ending", [".splat", ".spz", ".compressed.ply"])
@pytest.mark.parametrize("has_labels", [False, True])
def test_convert_keeps_labels_that_lie_beside_its_file_already(
    splat, tmp_path, monkeypatch, capsys, ending, has_labels
):
    if has_labels:
        splat = write_labelled(tmp_path / "labelled.ply")
    beside = tmp_path / f"x{ending}.generated.json"
    beside.write_text("mine")
    out = tmp_path / f"x{ending}"
    assert run(monkeypatch, "convert", splat, out) == 2
    said = capsys.readouterr().err
    assert f"x{ending}.generated.json exists; name another file, or overwrite it" in said
    assert beside.read_text() == "mine"
    assert not out.exists()
    assert run(monkeypatch, "convert", splat, out, "--overwrite") == 0
    assert beside.exists() == has_labels


def test_strip_keeps_labels_that_lie_beside_its_file_already(splat, tmp_path, monkeypatch):
    (tmp_path / "x.splat.generated.json").write_text("mine")
    assert run(monkeypatch, "strip", splat, "--out", tmp_path / "x.splat") == 2
    assert (tmp_path / "x.splat.generated.json").read_text() == "mine"
    assert not (tmp_path / "x.splat").exists()


def test_labels_are_not_written_to_what_a_link_names(tmp_path, monkeypatch):
    (tmp_path / "notes.json").write_text("mine")
    (tmp_path / "x.splat.generated.json").symlink_to("notes.json")
    splat = write_labelled(tmp_path / "labelled.ply")
    assert run(monkeypatch, "convert", splat, tmp_path / "x.splat", "--overwrite") == 0
    assert (tmp_path / "notes.json").read_text() == "mine"
    assert "sha256" in json.loads((tmp_path / "x.splat.generated.json").read_text())


def test_report_writes_to_nothing_that_a_link_names(completed_room, tmp_path, monkeypatch, capsys):
    out = Path(shutil.copytree(completed_room, tmp_path / "out"))
    (tmp_path / "thesis.html").write_text("mine")
    (out / "report.html").unlink()
    (out / "report.html").symlink_to("../thesis.html")
    assert run(monkeypatch, "report", out) == 2
    assert "report.html is in the way of a result" in " ".join(capsys.readouterr().err.split())
    assert (tmp_path / "thesis.html").read_text() == "mine"
    (out / "report.html").unlink()
    assert run(monkeypatch, "report", out) == 0
    assert (out / "report.html").is_file()


@pytest.mark.linux
@pytest.mark.parametrize("name", ["index.html", "rows", "jobs", "run.json", "tasks/a/row.json"])
def test_batch_and_evaluate_write_through_no_link_out_of_their_folder(tmp_path, name):
    out, home = tmp_path / "out", tmp_path / "home"
    home.mkdir()
    (home / "mine").write_text('{"version": 4, "seed": 0}')
    (out / name).parent.mkdir(parents=True)
    (out / "run.json").write_text('{"version": 4, "seed": 0}')
    (out / name).unlink(missing_ok=True)
    (out / name).symlink_to(home if "." not in name else home / "mine")
    with pytest.raises(InputError, match=f"{name} is a link out of the folder of the results"):
        claim(out, {"seed": 0})
    assert os.listdir(home) == ["mine"]


@pytest.mark.linux
def test_batch_and_evaluate_accept_a_link_within_their_folder_and_one_to_it(tmp_path):
    claim(tmp_path / "out", {"seed": 0})
    (tmp_path / "out" / "first").symlink_to("run.json")
    (tmp_path / "linked").symlink_to("out")
    claim(tmp_path / "linked", {"seed": 0})


@pytest.mark.linux
def test_cameras_are_not_searched_for_into_what_a_link_names(room, tmp_path, monkeypatch, capsys):
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for name in ("0.png", "1.png", "2.png"):
        shutil.copy(room / name, photographs)
    (tmp_path / "home").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "colmap").symlink_to("../home")
    words = ("complete", photographs, "--out", tmp_path / "out", "--overwrite")
    assert run(monkeypatch, *words) == 2
    assert "colmap is a link" in " ".join(capsys.readouterr().err.split())
    assert os.listdir(tmp_path / "home") == []
