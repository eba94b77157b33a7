"""Target cameras that the command finds."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter import load_cameras
from gscompleter.apps.command_line.words import insert_auto_count
from gscompleter.cli import parse_command
from gscompleter.data.formats import open_photographs
from gscompleter.numerics.geometry import measure_baseline
from gscompleter.system.files.image import read_image
from scenes import Room, camera_at, photographed, view_of

PLACES = ((-0.4, -4), (-0.2, 0), (0.0, 0), (0.3, 4), (0.5, 8))
QUICK = (
    "--resolution",
    32,
    "--near",
    0.5,
    "--far",
    20,
    "--config.next-best-view.image-size",
    32,
    "--quiet",
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    cameras = [camera_at(x, yaw=yaw, size=64) for x, yaw in PLACES]
    return photographed(tmp_path_factory.mktemp("auto"), cameras)


@pytest.fixture(scope="module")
def completed(scene, tmp_path_factory) -> Path:
    """Return the output without named targets, of which it finds one."""
    out = tmp_path_factory.mktemp("runs") / "out"
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, "complete", scene, "--out", out, "--auto", 1, *QUICK) == 0
    return out


def summary_of(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_without_a_target_cameras_are_found_and_completed(completed):
    summary = summary_of(completed)
    assert len(summary["targets"]) == 1
    for target in summary["targets"]:
        assert target["frame"] is None
        assert target["derived_from"] in range(len(PLACES))
        assert target["hole_fraction"] > 0.01
        assert target["psnr_after"] is None
    assert summary["gaussians"]["added"] > 0
    assert summary["settings"]["auto"] == 1
    assert 0 < summary["seconds"]["explore"] < summary["seconds"]["total"]


def test_the_scene_covers_more_from_around_the_photographs(completed):
    coverage = summary_of(completed)["coverage"]
    assert set(coverage) == {"before", "after", "cameras"}
    assert coverage["cameras"] == 32
    assert 0.5 < coverage["before"] < coverage["after"] <= 1
    for row in summary_of(completed)["context"]:
        assert row["psnr_after"] >= row["psnr_before"] - 0.05


def test_the_cameras_stand_beside_the_photographs_they_were_derived_from(scene, completed):
    photographs = open_photographs(scene)
    found = load_cameras(completed / "targets.json", 32)
    rows = summary_of(completed)["targets"]
    assert len(found) == len(rows)
    for camera, row in zip(found, rows, strict=True):
        assert (camera.width, camera.height) == (32, 32)
        assert measure_baseline(camera, photographs.camera(row["derived_from"], 32)) < 0.5


@pytest.mark.slow
def test_a_dry_run_writes_the_cameras_and_what_they_see(scene, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    said = [word for word in QUICK if word != "--quiet"]
    assert run(monkeypatch, "complete", scene, "--out", out, "--auto", 2, "--dry-run", *said) == 0
    names = sorted(path.name for path in out.iterdir())
    assert names == ["images", "summary.json", "targets.json"]
    cameras = load_cameras(out / "targets.json")
    # What each camera sees, and the photograph beside it, show where to stand.
    pictures = {path.name for path in (out / "images").iterdir()}
    assert pictures == {
        f"target{number + 1}_{what}.png"
        for number in range(len(cameras))
        for what in ("before", "beside")
    }
    shown = " ".join(capsys.readouterr().out.split())
    assert f"{len(cameras)}: near photograph " in shown
    assert f"Edit the cameras in {out / 'targets.json'}." in shown


@pytest.mark.slow
def test_a_plan_begins_as_the_completion_and_can_be_given_back(
    scene, completed, tmp_path, monkeypatch
):
    plan, out = tmp_path / "plan", tmp_path / "out"
    assert run(monkeypatch, "complete", scene, "--out", plan, "--auto", 1, "--dry-run", *QUICK) == 0
    targets = plan / "targets.json"
    (planned,) = load_cameras(targets)
    assert torch.equal(planned.c2w, load_cameras(completed / "targets.json")[0].c2w)
    words = ("complete", scene, "--out", out, "--target", targets, *QUICK)
    assert run(monkeypatch, *words) == 0
    (taken,) = load_cameras(out / "targets.json")
    assert torch.equal(planned.c2w, taken.c2w)
    summary = summary_of(out)
    assert summary["targets"][0]["derived_from"] is None
    assert summary["coverage"]["after"] > summary["coverage"]["before"]


def test_a_scene_that_was_brought_is_explored_with_its_doubts(
    scene, completed, tmp_path, monkeypatch, capsys
):
    """Trust is computed for the small images as well."""
    out = tmp_path / "out"
    given = ("--scene", completed / "context.ply", "--context", 0, 2, 4)
    said = [word for word in QUICK if word != "--quiet"]
    words = ("complete", scene, "--out", out, *given, "--auto", 1, "--dry-run", *said)
    assert run(monkeypatch, *words) == 0
    (camera,) = load_cameras(out / "targets.json")
    near = min(
        measure_baseline(camera, open_photographs(scene).camera(number))
        for number in range(len(PLACES))
    )
    assert near < 0.5
    shown = " ".join(capsys.readouterr().out.split())
    assert "1: near photograph " in shown


# The dry run before looks for cameras with doubts; `test_report.py` says such shares.
@pytest.mark.slow
def test_of_a_splat_the_trusted_share_is_said_and_written(
    scene, completed, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    given = ("--scene", completed / "context.ply", "--context", 0, 2, 4)
    said = [word for word in QUICK if word != "--quiet"]
    assert run(monkeypatch, "complete", scene, "--out", out, *given, "--auto", 1, *said) == 0
    coverage = summary_of(out)["coverage"]
    assert set(coverage) == {"before", "after", "cameras"}
    shares = f"{100 * coverage['before']:.1f} % before, {100 * coverage['after']:.1f} % after."
    assert f"Trusted around the photographs: {shares}" in (out / "report.html").read_text()


def test_a_dry_run_shows_what_named_targets_would_cost(scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = ("complete", scene, "--out", out, "--target", 4, "--dry-run", *QUICK)
    assert run(monkeypatch, *words) == 0
    (camera,) = load_cameras(out / "targets.json", 32)
    assert torch.allclose(camera.c2w, open_photographs(scene).camera(4, 32).c2w, atol=1e-6)


def test_a_dry_run_shows_targets_nearer_than_a_hundredth_of_a_unit(tmp_path, monkeypatch):
    """A room in kilometres, whose planes nobody gave."""
    places = (-0.3, 0.0, 0.3, 0.15)
    cameras = [replace(camera_at(x, size=64, unit=1e-3), near=None, far=None) for x in places]
    scene = photographed(tmp_path / "scene", cameras, Room(unit=1e-3))
    out = tmp_path / "out"
    words = ("complete", scene, "--context", 0, 1, 2, "--target", 3, "--dry-run", "--quiet")
    assert run(monkeypatch, *words, "--resolution", 64, "--out", out) == 0
    shown = read_image(out / "images" / "target1_before.png")
    assert (shown - view_of(Room(unit=1e-3), cameras[3]).image).abs().mean() < 0.05


def test_a_number_may_follow_auto_or_not():
    words = ["complete", "SCENE", "--out", "OUT"]
    assert parse_command(words).auto is None
    assert parse_command([*words, "--auto", "7"]).auto == 7
    assert parse_command([*words, "--auto"]).auto == 4
    assert parse_command(["complete", "SCENE", "--auto", "--out", "OUT"]).auto == 4
    for word in ("x", "room.5", "e3", "1e", ".", "3d", "1e1.5"):
        assert insert_auto_count(["complete", "--auto", word]) == ["complete", "--auto", "4", word]


@pytest.mark.parametrize(
    "number", ["5", "+5", "-5", "2.5", "5.", ".5", "-.5", "1e1", "1E+3", ".5e-2"]
)
def test_a_number_after_auto_is_its_own_however_it_is_written(number):
    words = ["complete", "--out", "OUT", "--auto", number]
    assert insert_auto_count(words) == words
