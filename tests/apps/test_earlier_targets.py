"""Targets of earlier commands, which are filled again where holes opened."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

from command import run
from gscompleter import load_ply, save_ply
from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.completing.refill import make_reopened
from gscompleter.apps.inputs.earlier_targets import EarlierTarget, read_earlier_targets
from gscompleter.apps.inputs.opening import open_scene
from gscompleter.apps.inputs.task import CompletionTask
from gscompleter.apps.requests.scene import PosesRequest, SceneRequest
from gscompleter.data.scene import describe_camera
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.splats.edits import EditDraft, Edits, read_edits, record_edit
from gscompleter.types import Camera
from scenes import camera_at, photographed, random_gaussians

CAMERAS = [camera_at(x=0.25 * k - 0.875, y=0.1 * (k % 3), size=64) for k in range(8)]
ASIDE = camera_at(yaw=-45, size=64)
"""Half of its image is in no photograph."""
FILES: dict[int | None, str] = {0: "a.jpg", 1: "b.jpg", None: "video.mp4"}
QUICK = ("--resolution", 64, "--far", 20)


def make_settings(camera: Camera, empty: float | None, names: tuple[str, ...] = ("a.jpg",)):
    settings: dict[str, Any] = {"cameras": [describe_camera(camera)], "photographs": list(names)}
    return settings if empty is None else {**settings, "empty": [empty]}


def record(folder: Path, settings: dict[str, Any], before: Path | None = None) -> Path:
    """Record one more edit of a splat, after that of the file `before`."""
    folder.mkdir()
    path = folder / "completed.ply"
    save_ply(path, random_gaussians(20))
    edits = Edits(folder) if before is None else read_edits(before)
    record_edit(folder, EditDraft("complete", settings), 20, [], before, edits, None)
    return path


def read(path: Path) -> tuple[EarlierTarget, ...]:
    return read_earlier_targets(read_edits(path), FILES, None, np.zeros(3))


def test_of_a_camera_that_was_completed_twice_the_later_edit_counts(tmp_path):
    first = record(tmp_path / "first", make_settings(CAMERAS[0], 0.1))
    second = record(tmp_path / "second", make_settings(CAMERAS[1], 0.0), first)
    third = record(tmp_path / "third", make_settings(CAMERAS[0], 0.2), second)
    found = read(third)
    assert [target.empty_share for target in found] == [0.0, 0.2]
    assert is_same_camera(found[1].camera, CAMERAS[0])


@pytest.mark.parametrize(
    "settings",
    [
        make_settings(CAMERAS[0], 0.1, ("elsewhere.jpg",)),  # in another frame
        make_settings(CAMERAS[0], 0.1, ()),  # without photographs
        make_settings(CAMERAS[0], None),  # by a version that did not tell what it left empty
    ],
)
def test_a_camera_in_another_frame_or_without_its_holes_is_no_earlier_target(tmp_path, settings):
    assert read(record(tmp_path / "first", settings)) == ()


@pytest.mark.parametrize(
    "changed",
    [
        {"cameras": None},
        {"empty": 0.1},
        {"cameras": [{"fl_x": 1}]},
        {"cameras": ["a"]},
        {"empty": ["much"]},
    ],
)
def test_a_record_that_somebody_changed_ends_no_completion(tmp_path, changed):
    settings = {**make_settings(CAMERAS[0], 0.1), **changed}
    assert read(record(tmp_path / "first", settings)) == ()


def test_a_splat_that_another_program_changed_has_no_earlier_targets(tmp_path):
    path = record(tmp_path / "first", make_settings(CAMERAS[0], 0.1))
    scene = load_ply(path)
    save_ply(path, replace(scene, means=scene.means + 1))
    assert read(path) == ()


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return photographed(tmp_path_factory.mktemp("scenes") / "room", CAMERAS)


@pytest.fixture
def opened(room, tmp_path, monkeypatch) -> Path:
    """Return a completed splat whose record says that nothing was empty at ASIDE."""
    out = tmp_path / "first"
    words = ("complete", room, "--context", 0, 1, "--target", 2, "--out", out, "--quiet")
    assert run(monkeypatch, *words, *QUICK) == 0
    content = json.loads((out / "edits.json").read_text())
    settings = content["edits"][0]["settings"]
    assert len(settings["empty"]) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert "reopened" not in summary
    content["edits"][0]["settings"] = {
        **settings,
        "cameras": [describe_camera(ASIDE)],
        "empty": [0.0],
    }
    (out / "edits.json").write_text(json.dumps(content))
    return out / "completed.ply"


def test_holes_that_opened_where_an_earlier_command_filled_them_are_filled_again(
    room, opened, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "second"
    words = ("complete", room, "--scene", opened, "--context", 0, 1, "--target", 3, *QUICK)
    assert run(monkeypatch, *words, "--out", out) == 0
    named, again = json.loads((out / "summary.json").read_text())["targets"]
    assert named["frame"] == 3
    assert named.get("reason") is None
    assert again["frame"] is None
    assert "an earlier command had filled" in again["reason"]
    assert again["added"] > 0
    assert "target 2: a given camera" in capsys.readouterr().out
    assert len(json.loads((out / "targets.json").read_text())["frames"]) == 2
    # The record tells what is left, so that the next command does not try in vain.
    last = json.loads((out / "edits.json").read_text())["edits"][-1]["settings"]
    assert len(last["cameras"]) == len(last["empty"]) == 2

    out = tmp_path / "forgotten"
    assert run(monkeypatch, *words, "--out", out, "--forget-edits", "--quiet") == 0
    assert len(json.loads((out / "summary.json").read_text())["targets"]) == 1


def test_an_update_invents_nothing_and_says_where_holes_opened(
    room, opened, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "second"
    words = ("update", room, "--scene", opened, "--context", 0, 1, *QUICK, "--out", out)
    assert run(monkeypatch, *words) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["reopened"] == 1
    assert summary["targets"] == []
    # A small copy of each other photograph was used, and the page shows each photograph once.
    page = (out / "report.html").read_text()
    assert page.count(", used in a small copy</h3>") == len(CAMERAS) - 2
    printed = capsys.readouterr()
    assert "Holes opened at 1 camera" in " ".join((printed.out + printed.err).split())


def test_a_photograph_at_an_earlier_target_scores_it(room, tmp_path):
    request = SceneRequest(room, resolution=(64, 64))
    opened = open_scene(request, PosesRequest(tmp_path), Console(quiet=True))
    task = Mock(spec=CompletionTask, taken_out=None)
    ready = Mock(spec=Prepared, opened=opened, task=task, cameras=dict(enumerate(CAMERAS)))
    target = make_reopened(ready, CAMERAS[5], 0.25)
    assert target.frame == 5
    assert target.photograph is not None
    assert "25.0 % of its image was empty" in target.reason
    assert make_reopened(ready, ASIDE, 0.25).frame is None
