"""A splat that a first command made of photographs, in a second one with others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from command import run
from gscompleter import load_ply, save_ply
from gscompleter.apps.inputs.own_scene import (
    find_own_photographs,
    find_source_frames,
    join_photographs,
)
from gscompleter.apps.requests.completion import WorkRequest
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.apps.requests.splat import SplatRequest
from gscompleter.splats.edits import AppendedRows, EditDraft, Edits, read_edits, record_edit
from gscompleter.splats.row_kinds import count_row_kinds
from gscompleter.stages.add_observed import MAX_RECONSTRUCTED, MAX_STEREO_PHOTOS, MAX_STEREO_PIXELS
from scenes import camera_at, photographed, random_gaussians

CAMERAS = [camera_at(x=0.25 * k - 0.875, y=0.1 * (k % 3), size=128) for k in range(8)]
FILES: dict[int | None, str] = {0: "a.jpg", 1: "b.jpg", 2: "c.jpg", None: "video.mp4"}
SETTINGS = {"photographs": ["c.jpg", "a.jpg"], "reconstructor": "plane-sweep"}


def write_own(folder: Path, command: str = "complete", **settings: Any) -> Path:
    """Write a splat that a first command reconstructed, with its record."""
    scene = random_gaussians(20)
    save_ply(folder / "completed.ply", scene)
    draft = EditDraft(command, {**SETTINGS, **settings})
    record_edit(folder, draft, len(scene), [], None, Edits(folder), None)
    return folder / "completed.ply"


def find(splat: SplatRequest, psi: str = "plane-sweep") -> tuple[int, ...]:
    models = ModelRequest(reconstructor=psi)
    work = WorkRequest(splat=splat, models=models)
    return find_own_photographs(work, read_edits(splat.path), FILES)


def test_the_record_tells_the_photographs_of_a_scene(tmp_path):
    path = write_own(tmp_path)
    assert find(SplatRequest(path)) == (0, 2)
    assert find(SplatRequest(path, forget_edits=True)) == ()
    # A network makes a scene of few photographs.
    assert find(SplatRequest(path), "mvsplat-re10k") == ()


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        ("live", {}),  # what it took out is not known
        ("complete", {"photographs": ["a.jpg", "z.jpg"]}),  # not in this folder
        ("complete", {"reconstructor": "mvsplat-re10k"}),
    ],
)
def test_other_scenes_are_not_made_anew(tmp_path, command, settings):
    assert find(SplatRequest(write_own(tmp_path, command, **settings))) == ()


@pytest.mark.parametrize(
    ("command", "appended", "frames"),
    [
        ("remove", [], (0, 2)),
        # Photographs that show what is behind became Gaussians, and others only checked.
        ("repair", [AppendedRows("photographs", 3)], (0, 1, 2)),
        # No photograph shows what it took out, and it lifted none.
        ("clean", [], (0, 2)),
        ("live", [], ()),
    ],
)
def test_what_was_taken_out_since_is_told(tmp_path, command, appended, frames):
    path = write_own(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    save_ply(out / "completed.ply", load_ply(path))
    draft = EditDraft(command, {**SETTINGS, "photographs": ["b.jpg"]})
    taken_out = random_gaussians(2)
    record_edit(out, draft, 20, appended, path, read_edits(path), None, taken_out)
    assert find(SplatRequest(out / "completed.ply")) == frames


def test_neither_are_a_splat_of_a_user_and_one_that_another_program_changed(tmp_path):
    path = write_own(tmp_path)
    scene = load_ply(path)
    save_ply(path, replace(scene, means=scene.means + 0.01))
    assert find(SplatRequest(path)) == ()
    alone = tmp_path / "alone.ply"
    save_ply(alone, random_gaussians(20, seed=1))
    assert find(SplatRequest(alone)) == ()


def find_sources(path: Path) -> tuple[int, ...]:
    return find_source_frames(read_edits(path), FILES)


def test_the_record_tells_where_a_scene_of_ours_is_right_whatever_came_after(tmp_path):
    path = write_own(tmp_path, photographs=["c.jpg", "elsewhere.jpg"])
    assert find_sources(path) == (2,)
    out = tmp_path / "out"
    out.mkdir()
    save_ply(out / "completed.ply", load_ply(path))
    draft = EditDraft("clean")
    record_edit(out, draft, 20, [], path, read_edits(path), None, random_gaussians(2))
    assert find_sources(out / "completed.ply") == (2,)
    # Another program cut it, and it still lies beside its record.
    save_ply(path, load_ply(path)[:10])
    assert find_sources(path) == (2,)


def test_no_record_tells_what_a_splat_of_a_user_was_trained_on(tmp_path):
    given = tmp_path / "given.ply"
    scene = random_gaussians(20)
    save_ply(given, scene)
    assert find_sources(given) == ()
    save_ply(tmp_path / "completed.ply", scene)
    draft = EditDraft("complete", SETTINGS)
    record_edit(tmp_path, draft, 20, [], given, read_edits(given), None)
    assert find_sources(tmp_path / "completed.ply") == ()


def test_photographs_are_joined_if_they_are_not_too_many():
    assert join_photographs((0, 2), (1, 2), set(), 640 * 360) == (0, 1, 2)
    # One that is a target now is held back.
    assert join_photographs((0, 2), (1, 3), {2}, 640 * 360) == (0, 1, 3)
    assert join_photographs((0, 1, 2), (1, 2), set(), 640 * 360) == ()
    many = tuple(range(MAX_RECONSTRUCTED + 1))
    assert join_photographs((0,), many, set(), 1) == ()
    # Large ones are as many as a first command reconstructs.
    large = tuple(range(MAX_STEREO_PHOTOS))
    assert join_photographs((0,), large, set(), MAX_STEREO_PIXELS) == large
    assert join_photographs((0,), (*large, 8), set(), MAX_STEREO_PIXELS) == ()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("complete", ("--context", 4, 7, "--target", 5)),
        # It chooses photographs that show what the splat lacks.
        pytest.param("update", (), marks=pytest.mark.slow),
    ],
)
def test_a_second_command_makes_the_scene_anew_and_strip_gives_the_first_one_back(
    tmp_path, monkeypatch, capsys, command, words
):
    room = photographed(tmp_path / "room", CAMERAS)
    quick = ("--resolution", 64, "--far", 20)
    first = ("complete", room, "--context", 0, 1, "--target", 3, "--out", tmp_path / "first")
    assert run(monkeypatch, *first, *quick, "--quiet") == 0
    given = tmp_path / "first" / "completed.ply"
    named = ("--scene", given, *words, "--out", tmp_path / "second")
    assert run(monkeypatch, command, room, *named, *quick) == 0
    assert "it is reconstructed anew from those" in " ".join(capsys.readouterr().err.split())

    second = tmp_path / "second" / "completed.ply"
    summary = json.loads((second.parent / "summary.json").read_text())
    rows = {row["frame"]: row for row in summary["context"]}
    assert rows.keys() >= {0, 1, 4, 7}
    for frame in (4, 7):
        assert rows[frame]["psnr_after"] > rows[frame]["psnr_before"] + 3
    before = load_ply(given)
    after = load_ply(second)
    edits = read_edits(second)
    counts = count_row_kinds(second, edits, len(after))
    assert counts is not None
    # Of the first command at most what was invented is left.
    assert counts.get("given", 0) == 0
    assert counts["photographs"] > 64 * 64
    # One coordinate of two of them may be the same by chance.
    first_means = {tuple(mean) for mean in before.means[before.generated == 0].tolist()}
    assert first_means.isdisjoint(map(tuple, after.means.tolist()))

    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", second, "--last", "--out", back, "--quiet") == 0
    assert back.read_bytes() == given.read_bytes()
