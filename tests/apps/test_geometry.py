"""`complete --geometry`: what it says, what it writes, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest

from command import run
from gscompleter import InputError, load_geometry, save_ply
from gscompleter.apps.commands.complete import decide_completion
from gscompleter.apps.commands.live import decide_live
from gscompleter.apps.commands.remove import decide_removal
from gscompleter.apps.commands.repair import decide_repair
from gscompleter.apps.commands.update import decide_update
from gscompleter.apps.completing import preparation
from gscompleter.cli import parse_command
from room_mesh import OTHER_ROOM, mesh_of, write_obj, write_ply_mesh
from scenes import Room, camera_at, gaussians_of, merge, photographed, view_of

CAMERAS = [camera_at(x, size=64) for x in (-0.3, 0.1)]
TARGET = camera_at(0.9, yaw=35, size=64)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of photographs, a splat of what two of them see, and meshes of the room."""
    folder = tmp_path_factory.mktemp("geometry")
    photographed(folder / "room", [*CAMERAS, TARGET])
    save_ply(folder / "splat.ply", merge([gaussians_of(view_of(Room(), c)) for c in CAMERAS]))
    vertices, quads = mesh_of()
    write_ply_mesh(folder / "scan.ply", (vertices, quads))
    turned = 0.2 * vertices[:, [2, 0, 1]] + [4.0, -20.0, 7.0]
    write_ply_mesh(folder / "moved.ply", (turned, quads))
    write_obj(folder / "lie.obj", mesh_of(OTHER_ROOM))
    return folder


def complete(folder, out, *more):
    scene = (folder / "room", "--scene", folder / "splat.ply")
    return ["complete", *scene, "--context", 0, 1, "--target", 2, "--out", out, *more]


@pytest.mark.slow
def test_the_summary_and_the_terminal_say_what_geometry_gave(folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert run(monkeypatch, *complete(folder, out, "--geometry", folder / "scan.ply")) == 0
    summary = json.loads((out / "summary.json").read_text())
    (row,) = summary["targets"]
    assert summary["settings"]["geometry"] == str(folder / "scan.ply")
    assert row["geometry"]["share"] > 0.9
    assert 0 < row["geometry"]["added"] <= row["added"]
    assert summary["gaussians"]["on_geometry"] == row["geometry"]["added"]
    share = f"{100 * row['geometry']['share']:.0f} %"
    assert any(note.startswith(f"scan.ply gives the depth of {share}") for note in row["notes"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "scan.ply gives the depth of" in printed
    assert "Gaussians stand where it says, in generated colours." in printed
    page = (out / "report.html").read_text()
    assert "scan.ply gives the depth of" in page
    assert "have the depth of scan.ply" in page
    edits = json.loads((out / "edits.json").read_text())
    assert edits["edits"][-1]["settings"]["geometry"] == "scan.ply"


@pytest.mark.slow
def test_geometry_that_lies_is_refused_and_nothing_is_written(
    folder, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    assert run(monkeypatch, *complete(folder, out, "--geometry", folder / "lie.obj")) == 2
    said = capsys.readouterr().err
    assert "lie.obj is not what the scene shows, neither where it stands nor moved" in said
    assert not out.exists()


@pytest.mark.slow
def test_a_mesh_in_a_frame_of_its_own_is_moved_and_it_is_said(
    folder, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    assert run(monkeypatch, *complete(folder, out, "--geometry", folder / "moved.ply")) == 0
    summary = json.loads((out / "summary.json").read_text())
    placed = summary["placed_geometry"]
    assert placed["scale"] == pytest.approx(5, rel=0.01)
    # The axes in another order are a third of a turn about their diagonal.
    assert placed["degrees"] == pytest.approx(120, abs=1)
    assert placed["deviation"] < 0.01
    # The rest lies beside the mesh, or where it differs from what is seen.
    assert summary["targets"][0]["geometry"]["share"] > 0.8
    printed = " ".join(capsys.readouterr().out.split())
    moved = f"the scene shows the same: scaled by {placed['scale']:.4g}, "
    assert f"moved.ply was moved to where {moved}" in printed
    assert "moved.ply was moved to where the scene shows" in (out / "report.html").read_text()


def test_a_wrong_file_is_refused_before_the_photographs_are_read(
    folder, tmp_path, monkeypatch, capsys
):
    missing = folder / "missing.ply"
    command = ["complete", folder / "room", "--target", 2, "--out", tmp_path / "out"]
    assert run(monkeypatch, *command, "--geometry", missing) == 2
    assert "missing.ply" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "decide"),
    [
        (("complete", "room", "--target", 2), decide_completion),
        (("update", "room", "--scene", "splat.ply"), decide_update),
        (("repair", "splat.ply", "--target", "c.json", "--mask", "m.png"), decide_repair),
        (("remove", "room", "--scene", "splat.ply", "--sphere", 0, 0, 2, 1), decide_removal),
        (("live", "splat.ply"), decide_live),
    ],
)
def test_the_option_becomes_a_part_of_the_request(words, decide, folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    given = (*words, "--geometry", "scan.ply", "--out", tmp_path / "out")
    request = decide(parse_command([str(word) for word in given]))
    filling = getattr(getattr(request, "session", request), "completion", request)
    assert filling.work.geometry == Path("scan.ply")


def test_geometry_is_read_once_and_before_cameras_are_searched_for(folder, tmp_path, monkeypatch):
    """Photographs without cameras are the longest way."""
    events = []

    def read(path):
        events.append("geometry")
        return load_geometry(path)

    def search(*_, check, **__):
        check()
        events.append("cameras")
        raise InputError("There are none.")

    monkeypatch.setattr(preparation, "load_geometry", read)
    monkeypatch.setattr(preparation, "open_input", lambda *given: search(check=given[-1]))
    command = ["complete", folder / "room", "--target", 2, "--out", tmp_path / "out"]
    assert run(monkeypatch, *command, "--geometry", folder / "scan.ply") == 2
    assert events == ["geometry", "cameras"]


def test_geometry_of_a_map_is_read_relative_to_its_origin(folder, tmp_path):
    """Coordinates of maps are too large for float32, and so are those of their meshes."""
    vertices, quads = mesh_of()
    far = np.array([500_000.0, 5_400_000.0, 100.0])
    geometry = load_geometry(write_ply_mesh(tmp_path / "map.ply", (vertices + far, quads)))
    np.testing.assert_allclose(geometry.move(-far).vertices, vertices, atol=1e-8)
