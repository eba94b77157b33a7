"""Commands on a splat alone: objects on nothing, and what is up."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command import run
from gscompleter import load_cameras, save_ply
from gscompleter.types import Gaussians
from solids import ALL_FACES, CEILING, Z_UP, chair, room
from viewer_pages import NONE, content_of


@pytest.fixture(autouse=True)
def few_cameras(monkeypatch) -> None:
    """Search for standpoints among few cameras."""
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_RANDOM", 80)
    monkeypatch.setattr("gscompleter.virtual_capture.standpoints.NUM_IMPROVED", 8)
    monkeypatch.setattr("gscompleter.apps.inputs.captures.NUM_STANDPOINTS", 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    save_ply(folder / "chair.ply", chair(0.012))
    save_ply(folder / "room.ply", make_z_up_room())
    return folder


def make_z_up_room() -> Gaussians:
    """Make a room without a ceiling, whose z axis is up."""
    scene = room([face for face in ALL_FACES if face != CEILING])
    return replace(scene, means=scene.means @ Z_UP.T)


@pytest.mark.slow
def test_nothing_is_added_to_an_object_whose_cameras_are_found(
    folder, tmp_path, monkeypatch, capsys
):
    # A splat without anything goes on by itself.
    words = ("complete", folder / "chair.ply", "--resolution", 96)
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 0
    said = capsys.readouterr()
    assert "The splat is an object on nothing" in said.err
    assert "Up is -y, as in most files" in said.err
    headline = said.out.splitlines()[0]
    assert headline.startswith("Nothing was gained, because the splat is an object on nothing")
    assert "photographs" not in headline
    assert "Coverage around" not in said.out
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["gaussians"]["added"] == 0
    assert summary["settings"]["config"]["guards"][-1] == "hull"
    assert "to cover it would be no gain" in (tmp_path / "out/report.html").read_text()


@pytest.mark.slow
def test_cameras_that_are_found_stand_upright_on_the_floor(folder, tmp_path, monkeypatch, capsys):
    words = ("complete", folder / "room.ply", "--auto", 1, "--resolution", 64, "--dry-run")
    assert run(monkeypatch, *words, "--out", tmp_path / "found") == 0
    assert "Up is +z, from the splat's floor; --up X Y Z" in capsys.readouterr().err
    for camera in load_cameras(tmp_path / "found/renders.json"):
        assert camera.c2w[2, 0].abs() < 1e-4
        assert camera.c2w[2, 1] < -0.5
    up = ("--up", 0, -1, 0)
    assert run(monkeypatch, *words, *up, "--out", tmp_path / "named") == 0
    assert "Up is" not in capsys.readouterr().err
    for camera in load_cameras(tmp_path / "named/renders.json"):
        assert camera.c2w[1, 0].abs() < 1e-4


def show(folder: Path, name: str, monkeypatch, *words: object) -> dict:
    """Save the page of a splat, and return its content."""
    monkeypatch.setattr("gscompleter.apps.viewer.packages.load_libraries", lambda: NONE)
    page = folder / "page.html"
    asked = ("view", folder / name, "--save", page, "--overwrite", *words)
    assert run(monkeypatch, *asked) == 0
    return content_of(page.read_bytes())


def test_a_page_stands_upright(folder, monkeypatch, capsys):
    content = show(folder, "room.ply", monkeypatch)
    assert "Up is +z, from the splat's floor" in capsys.readouterr().out
    # The page turns y and z about.
    assert content["up"] == [0, 0, -1]
    pose = np.array(content["shots"][0]["pose"]).reshape(4, 4)
    assert np.allclose(pose[:3, 1], [0, 0, -1])
    named = show(folder, "room.ply", monkeypatch, "--up", 0, 2, 0)
    assert "Up is" not in capsys.readouterr().out
    assert named["up"] == [0, -2, 0]
    assert np.allclose(np.array(named["shots"][0]["pose"]).reshape(4, 4)[:3, 1], [0, -1, 0])


def test_no_direction_is_refused_by_the_page(folder, monkeypatch, capsys):
    monkeypatch.setattr("gscompleter.apps.viewer.packages.load_libraries", lambda: NONE)
    words = ("view", folder / "room.ply", "--save", folder / "a.html", "--up", 0, 0, 0)
    assert run(monkeypatch, *words) == 2
    assert "three numbers that are not all zero" in capsys.readouterr().err
