"""`repair` of a splat: what masks mark goes, and its place is filled."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter import load_ply, load_renderer, save_ply
from gscompleter.data.scene import write_cameras
from gscompleter.numerics.geometry import look_up
from gscompleter.system.files.image import write_image
from gscompleter.types import Camera
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 64
RENDERER = load_renderer("cpu")
SPOT = (slice(26, 38), slice(30, 44))
"""Rows and columns of the image that the masks mark."""


def make_camera(x: float) -> Camera:
    return replace(camera_at(x, size=SIZE), near=None, far=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a splat of one photograph, with two cameras, two masks and two photographs."""
    folder = tmp_path_factory.mktemp("repair")
    save_ply(folder / "splat.ply", gaussians_of(view_of(Room(), camera_at(size=SIZE))))
    write_cameras(folder / "one.json", [make_camera(0.02)])
    write_cameras(folder / "two.json", [make_camera(0.02), make_camera(-0.02)])
    photographed(folder / "photographs", [make_camera(x) for x in (-0.2, 0.2)])
    for name, columns in (("first", SPOT[1]), ("second", slice(8, 20))):
        mask = torch.zeros(SIZE, SIZE, 3)
        mask[SPOT[0], columns] = 1.0
        write_image(folder / f"{name}.png", mask)
    write_image(folder / "nothing.png", torch.zeros(SIZE, SIZE, 3))
    # The splat ends within the image of a camera that is turned away from it.
    write_cameras(folder / "turned.json", [replace(camera_at(yaw=30, size=SIZE), near=None)])
    beside = torch.zeros(SIZE, SIZE, 3)
    beside[:, -8:] = 1.0
    write_image(folder / "beside.png", beside)
    return folder


def read_summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


@pytest.fixture(scope="module")
def repaired(folder, tmp_path_factory) -> Path:
    """Return the output of a repair of what one mask marks."""
    out = tmp_path_factory.mktemp("repaired") / "out"
    words = ("--target", folder / "one.json", "--mask", folder / "first.png", "--quiet")
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, "repair", folder / "splat.ply", *words, "--out", out) == 0
    return out


def test_what_is_marked_is_filled_with_what_continues_it(folder, repaired, tmp_path, monkeypatch):
    splat, out = folder / "splat.ply", repaired
    completed = load_ply(out / "completed.ply")
    given = load_ply(splat)
    camera = camera_at(0.02, size=SIZE)
    before = RENDERER.render(given, camera).image
    cut = RENDERER.render(completed[completed.generated == 0], camera).image
    after = RENDERER.render(completed, camera).image
    # The wall continues: what fills the place looks like what was there. Of a random texture only
    # the tone can be continued; 0.13 was measured.
    lost = (cut - before)[SPOT].square().mean()
    assert (after - before)[SPOT].square().mean() < 0.25 * lost
    is_elsewhere = torch.ones(SIZE, SIZE, dtype=torch.bool)
    is_elsewhere[20:44, 24:50] = False
    assert (after - before)[is_elsewhere].abs().mean() < 0.01

    # What stays is as it was, bit for bit, and the rest comes back.
    kept = completed[completed.generated == 0]
    rows = {row.numpy().tobytes() for row in given.means}
    assert all(row.numpy().tobytes() in rows for row in kept.means)
    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == splat.read_bytes()


# The test before looks at the result of `repair`.
@pytest.mark.slow
def test_it_is_a_completion_of_what_masks_mark(folder, repaired, tmp_path, monkeypatch):
    splat = folder / "splat.ply"
    mask = ("--mask", folder / "first.png", "--quiet")
    completed = tmp_path / "completed"
    words = ("complete", splat, "--target", folder / "one.json")
    assert run(monkeypatch, *words, *mask, "--out", completed) == 0
    assert (repaired / "completed.ply").read_bytes() == (completed / "completed.ply").read_bytes()


# The next test has photographs and one mask.
@pytest.mark.slow
def test_several_masks_are_repaired_with_photographs(folder, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = ("repair", folder / "photographs", "--scene", folder / "splat.ply", "--quiet")
    masks = ("--mask", folder / "first.png", folder / "second.png")
    assert run(monkeypatch, *words, "--target", folder / "two.json", *masks, "--out", out) == 0
    summary = read_summary(out)
    assert summary["scene"]["renders_from"] is None
    assert len(summary["context"]) == 2
    # Both cameras see both places, so that the first one already fills them.
    first, second = summary["targets"]
    assert first["added"] > 40
    assert first["hole_fraction"] > 0.05 > second["hole_fraction"]
    assert summary["settings"]["mask"] == [str(folder / "first.png"), str(folder / "second.png")]


def test_a_mask_of_a_photograph_is_repaired_at_its_number(folder, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = ("repair", folder / "photographs", "--scene", folder / "splat.ply", "--target", 1)
    assert run(monkeypatch, *words, "--mask", folder / "first.png", "--out", out, "--quiet") == 0
    (target,) = read_summary(out)["targets"]
    assert target["frame"] == 1
    assert target["hole_fraction"] > 0.03
    assert target["added"] > 20


@pytest.fixture(scope="module")
def selected(folder) -> Path:
    """Return the Gaussians that the first mask shows, as another program saves a selection."""
    given = load_ply(folder / "splat.ply")
    mark = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mark[SPOT] = True
    save_ply(folder / "selected.ply", given[look_up(mark, given, camera_at(size=SIZE))])
    return folder / "selected.ply"


@pytest.mark.slow
def test_a_selection_is_repaired_as_what_a_mask_marks(folder, selected, tmp_path, monkeypatch):
    splat, out = folder / "splat.ply", tmp_path / "out"
    words = ("--target", folder / "one.json", "--select", selected, "--quiet")
    assert run(monkeypatch, "repair", splat, *words, "--out", out) == 0
    summary = read_summary(out)
    assert summary["settings"]["select"] == str(selected)
    (target,) = summary["targets"]
    assert target["added"] > 0.5 * len(load_ply(selected))

    # The selection goes, and with it hardly more than what comes to light behind its border. Its
    # place is filled with what continues the wall.
    completed = load_ply(out / "completed.ply")
    given = load_ply(splat)
    kept = {row.numpy().tobytes() for row in completed[completed.generated == 0].means}
    chosen = {row.numpy().tobytes() for row in load_ply(selected).means}
    assert not kept & chosen
    rows = {row.numpy().tobytes() for row in given.means}
    assert kept <= rows
    assert len(rows - chosen - kept) < 0.2 * len(chosen)
    camera = camera_at(0.02, size=SIZE)
    before = RENDERER.render(given, camera).image
    cut = RENDERER.render(completed[completed.generated == 0], camera).image
    after = RENDERER.render(completed, camera).image
    lost = (cut - before)[SPOT].square().mean()
    assert (after - before)[SPOT].square().mean() < 0.25 * lost
    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == splat.read_bytes()


# Tests above repair a selection in a splat alone, and a mask with photographs.
@pytest.mark.slow
def test_a_selection_is_repaired_with_photographs(folder, selected, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = ("repair", folder / "photographs", "--scene", folder / "splat.ply", "--quiet")
    marks = ("--target", folder / "one.json", "--select", selected)
    assert run(monkeypatch, *words, *marks, "--out", out) == 0
    summary = read_summary(out)
    assert summary["scene"]["renders_from"] is None
    assert summary["targets"][0]["hole_fraction"] > 0.03


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--select", "selected.ply"), "name the camera, or let `gscompleter remove --select`"),
        (("--target", "one.json", "--select", "one.json"), "one.json"),
        (
            ("--target", "one.json", "--select", "selected.ply", "--mask", "first.png"),
            "Masks and a selection both say what goes",
        ),
        (("--strokes", "strokes.json", "--select", "selected.ply"), "leave --target, --mask and"),
        (("--target", "one.json"), "the selected Gaussians with --select"),
        (
            ("--target", "one.json", "--select", "selected.ply", "--invert-masks"),
            "no photographs whose masks could be read",
        ),
    ],
)
def test_wrong_selections_are_refused_with_a_sentence(
    folder, selected, tmp_path, monkeypatch, capsys, words, sentence
):
    paths = [folder / word if "." in word else word for word in words]
    out = tmp_path / "out"
    assert run(monkeypatch, "repair", folder / "splat.ply", *paths, "--out", out, "--quiet") == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--mask", "first.png", "second.png"), "2 masks and 1 target cameras"),
        (("--mask", "nothing.png"), "nothing.png is black everywhere, and what masks show white"),
        (("--mask", "gone.png"), "gone.png"),
    ],
)
def test_wrong_masks_are_refused_with_a_sentence(
    folder, tmp_path, monkeypatch, capsys, words, sentence
):
    paths = [folder / word if word.endswith(".png") else word for word in words]
    out = tmp_path / "out"
    given = ("repair", folder / "splat.ply", "--target", folder / "one.json", *paths)
    assert run(monkeypatch, *given, "--out", out, "--quiet") == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_a_mask_where_nothing_is_seen_is_refused_with_what_fills_holes(
    folder, tmp_path, monkeypatch, capsys
):
    words = ("repair", folder / "photographs", "--scene", folder / "splat.ply", "--quiet")
    marks = ("--target", folder / "turned.json", "--mask", folder / "beside.png")
    out = tmp_path / "out"
    assert run(monkeypatch, *words, *marks, "--out", out) == 2
    said = capsys.readouterr().err
    assert "show no Gaussian of the splat" in said
    # `repair` itself takes no target without a mask.
    assert "`gscompleter complete` without --mask" in said
