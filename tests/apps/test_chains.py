"""Chains of commands on a splat: what one did, the next one knows, and strip takes off."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from command import run
from gscompleter import load_ply, save_ply
from gscompleter.apps.inputs.taken_out import describe_taken_out
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.render.loading import load_renderer
from gscompleter.splats.edits import read_edits
from gscompleter.splats.undo import strip_edits
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import write_image
from gscompleter.types import merge
from scenes import Room, camera_at, cast, gaussians_of, photographed, view_of

SIZE = 128
WORKING_SIZE = 64
CAMERAS = [camera_at(x=0.25 * i - 0.875, y=0.1 * (i % 3), size=SIZE) for i in range(8)]
TARGET = camera_at(0.0, 0.05, size=SIZE)
ROOM = Room()
EMPTY = Room((ROOM.boxes[0], ROOM.boxes[2]))
"""The room without the box in its middle."""
CRATE = (-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """Write photographs of the room, a splat of what they show, and a camera of its middle."""
    folder = photographed(tmp_path_factory.mktemp("chain") / "room", CAMERAS)
    save_ply(
        folder / "splat.ply", merge([gaussians_of(view_of(ROOM, CAMERAS[i])) for i in (0, 4, 7)])
    )
    photographed(folder.parent / "camera", [TARGET])
    shown = cast(ROOM, TARGET)[1] < cast(EMPTY, TARGET)[1] - 0.01
    write_image(folder.parent / "mask.png", shown)
    return folder


def run_on(room: Path, name: str, splat: Path, out: Path, *others: object) -> Path:
    """Run a command on a splat with the photographs of the room, and return its result."""
    size = ("--resolution", WORKING_SIZE, "--far", 20, "--quiet")
    words = (name, room, "--scene", splat, "--out", out, *size, *others)
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, *words) == 0
    return out / "completed.ply"


@pytest.fixture(scope="module")
def camera(room) -> Path:
    return room.parent / "camera" / "transforms.json"


@pytest.fixture(scope="module")
def without_crate(room, camera) -> Path:
    out = room.parent / "removed"
    return run_on(room, "remove", room / "splat.ply", out, "--box", *CRATE, "--target", camera)


def list_commands(splat: Path) -> list[str]:
    edits = read_edits(splat)
    assert edits.is_unchanged
    return [edit.command for edit in edits.edits]


def measure_emptiness(splat: Path) -> float:
    """Compute the PSNR of the place of the crate against the room without it."""
    shown = torch.as_tensor(cast(ROOM, TARGET)[1] < cast(EMPTY, TARGET)[1] - 0.01)
    image = load_renderer("cpu").render(load_ply(splat), TARGET).image
    error = (image - view_of(EMPTY, TARGET).image)[shown]
    return -10 * error.square().mean().log10().item()


@pytest.mark.parametrize("name", ["complete", "update"])
def test_what_was_removed_stays_out(name, room, camera, without_crate, tmp_path):
    targets = ("--target", camera) if name == "complete" else ()
    again = run_on(room, name, without_crate, tmp_path / "again", *targets)
    assert abs(measure_emptiness(again) - measure_emptiness(without_crate)) < 0.3
    summary = json.loads((again.parent / "summary.json").read_text())
    assert any(row["ignored"] > 0.02 for row in summary["context"])
    assert list_commands(again) == ["remove", name]


@pytest.mark.slow
def test_what_was_removed_comes_back_if_that_is_asked_for(room, without_crate, tmp_path):
    words = ("--forget-edits",)
    again = run_on(room, "update", without_crate, tmp_path / "again", *words)
    assert measure_emptiness(again) < measure_emptiness(without_crate) - 2


def test_lines_say_what_is_kept_and_what_is_not_known(without_crate, tmp_path):
    (line,) = describe_taken_out(InputSplatFile(without_crate), forgets=False)
    assert line.startswith("1 removal of this splat is kept: photographs are ignored where they")
    (line,) = describe_taken_out(InputSplatFile(without_crate), forgets=True)
    assert "forgotten" in line
    alone = tmp_path / "alone.ply"
    alone.write_bytes(without_crate.read_bytes())
    (line,) = describe_taken_out(InputSplatFile(alone), forgets=False)
    assert "What was removed is not known" in line


@pytest.mark.slow
def test_strip_gives_each_earlier_state_back(
    room, camera, without_crate, tmp_path, monkeypatch, capsys
):
    marks = ("--target", camera, "--mask", room.parent / "mask.png")
    repaired = run_on(room, "complete", without_crate, tmp_path / "repaired", *marks)
    cleaned = run_on(room, "clean", repaired, tmp_path / "cleaned")
    updated = run_on(room, "update", cleaned, tmp_path / "updated")
    states = [room / "splat.ply", without_crate, repaired, cleaned, updated]
    assert list_commands(updated) == ["remove", "repair", "clean", "update"]
    for number in (4, 3, 2, 1):
        out = tmp_path / f"before{number}.ply"
        assert run(monkeypatch, "strip", states[number], "--last", "--out", out) == 0
        assert out.read_bytes() == states[number - 1].read_bytes()
        assert "byte for byte" in capsys.readouterr().out
    out = tmp_path / "first.ply"
    assert run(monkeypatch, "strip", updated, "--out", out) == 0
    assert out.read_bytes() == states[0].read_bytes()

    # One from the middle: the crate is back, and what came later stays.
    out = tmp_path / "without_first.ply"
    assert run(monkeypatch, "strip", updated, "--edit", 1, "--out", out) == 0
    assert measure_emptiness(out) < measure_emptiness(updated) - 1
    assert run(monkeypatch, "strip", updated, "--edit", 5, "--out", out, "--overwrite") == 2
    assert "numbered from 1 to 4" in capsys.readouterr().err


def test_a_splat_that_another_program_changed_keeps_its_removals(room, without_crate, tmp_path):
    shutil.copytree(without_crate.parent, tmp_path / "copy")
    changed = tmp_path / "copy" / "completed.ply"
    save_ply(changed, load_ply(changed)[:-5], provenance=True)
    again = run_on(room, "clean", changed, tmp_path / "again")
    first, second = read_edits(again).edits
    assert (first.can_be_undone, second.can_be_undone) == (False, True)
    assert first.taken_out is not None
    with pytest.raises(InputError, match="changed by another program"):
        strip_edits(again, tmp_path / "x.ply", [1])
