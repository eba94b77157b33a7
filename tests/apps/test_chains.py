"""Chains of commands on a splat: what one did, the next one knows, and strip takes off."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import Tensor

from command import run
from gscompleter import load_camera, load_ply, save_ply
from gscompleter.apps.commands.live import decide_live
from gscompleter.apps.inputs.earlier_work import mark_earlier_work
from gscompleter.apps.inputs.taken_out import describe_taken_out
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile
from gscompleter.apps.live import saving
from gscompleter.apps.live.session import SessionStep, apply_step
from gscompleter.cli import parse_command
from gscompleter.render.loading import load_renderer
from gscompleter.splats.edits import read_edits
from gscompleter.splats.row_kinds import count_row_kinds
from gscompleter.splats.undo import strip_edits
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import write_image
from gscompleter.types import Gaussians, merge
from scenes import Room, camera_at, cast, gaussians_of, photographed, view_of

SIZE = 128
WORKING_SIZE = 64
CAMERAS = [camera_at(x=0.25 * i - 0.875, y=0.1 * (i % 3), size=SIZE) for i in range(8)]
TARGET = camera_at(0.0, 0.05, size=SIZE)
ROOM = Room()
ASIDE = camera_at(1.1, 0.1, yaw=14, size=SIZE)
"""A camera that sees what no photograph shows, to their right."""
EMPTY = Room((ROOM.boxes[0], ROOM.boxes[2]))
"""The room without the box in its middle."""
FEW = ("--context", 0, 4, 7)
"""The photographs that the splat was made of, for commands that would take all."""
PHOTOGRAPHS = 255
"""Label of what photographs show, and of pieces of what was cut."""
TASK = CompletionTask((), (), np.eye(4), np.zeros(3), {})
CRATE = (-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """Write photographs of the room, a splat of what they show, and a camera of its middle."""
    folder = photographed(tmp_path_factory.mktemp("chain") / "room", CAMERAS)
    save_ply(
        folder / "splat.ply", merge([gaussians_of(view_of(ROOM, CAMERAS[i])) for i in (0, 4, 7)])
    )
    photographed(folder.parent / "aside", [ASIDE])
    shown = cast(ROOM, TARGET)[1] < cast(EMPTY, TARGET)[1] - 0.01
    write_image(folder.parent / "mask.png", shown)
    return folder


def run_on(
    room: Path, name: str, splat: Path, out: Path, *others: object, size: int = WORKING_SIZE
) -> Path:
    """Run a command on a splat with the photographs of the room, and return its result."""
    options = ("--resolution", size, "--far", 20, "--quiet")
    words = (name, room, "--scene", splat, "--out", out, *options, *others)
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, *words) == 0
    return out / "completed.ply"


def run_live(words: tuple[object, ...], out: Path, *steps: SessionStep) -> Path:
    """Do steps in a session of `live`, save it, and return its result."""
    quiet = Console(quiet=True)
    options = parse_command(["live", *map(str, words), "--out", str(out), "--quiet"])
    ready = saving.prepare_session(decide_live(options).session, quiet)
    session = saving.begin_session(ready)
    for step in steps:
        session, _ = apply_step(session, step)
    assert len(session.steps) == len(steps)
    saving.save_session(ready, session)
    return out / "completed.ply"


def strip_last(splat: Path, out: Path) -> bytes:
    """Take the last edit off, and return the bytes of the splat before it."""
    with pytest.MonkeyPatch.context() as patch:
        words = ("strip", splat, "--last", "--out", out, "--overwrite", "--quiet")
        assert run(patch, *words) == 0
    return out.read_bytes()


def check_counts(before: Path, after: Path) -> None:
    """Check that the summary of a command counts what its file holds."""
    counts = json.loads((after.parent / "summary.json").read_text())["gaussians"]
    given, scene = load_ply(before), load_ply(after)
    assert counts["context"] == len(given)
    num_gone = counts.get("removed", 0) + counts.get("replaced", 0)
    assert len(scene) == len(given) - num_gone + counts["added"]
    # What a command appends, and what it recoloured, has labels of its own.
    old = set(given.generated.tolist())
    new = [label for label in set(scene.generated.tolist()) - old if label != PHOTOGRAPHS]
    num_invented = sum(int((scene.generated == label).sum()) for label in new)
    made = counts["added"] - counts.get("from_photographs", 0) - counts.get("pieces", 0)
    num_recolored = counts.get("recolored", 0)
    assert made <= num_invented <= made + num_recolored
    added = set(map(bytes, scene.means.numpy())) - set(map(bytes, given.means.numpy()))
    assert len(added) <= counts["added"]


@pytest.fixture(scope="module")
def camera(tmp_path_factory) -> Path:
    return photographed(tmp_path_factory.mktemp("camera"), [TARGET]) / "transforms.json"


@pytest.fixture(scope="module")
def small_room(tmp_path_factory) -> Path:
    """Write three small photographs of the room, and a splat of what they show."""
    cameras = [
        camera_at(x=x, y=y, size=WORKING_SIZE) for x, y in ((-0.875, 0), (0.1, 0.1), (0.875, 0.1))
    ]
    folder = photographed(tmp_path_factory.mktemp("small") / "room", cameras)
    save_ply(folder / "splat.ply", merge([gaussians_of(view_of(ROOM, c)) for c in cameras]))
    return folder


@pytest.fixture(scope="module")
def small_without_crate(small_room, camera) -> Path:
    words = ("--box", *CRATE, "--target", camera)
    return run_on(small_room, "remove", small_room / "splat.ply", small_room.parent / "out", *words)


@pytest.fixture(scope="module")
def without_crate(room, camera) -> Path:
    out = room.parent / "removed"
    return run_on(room, "remove", room / "splat.ply", out, "--box", *CRATE, "--target", camera)


def make_floaters(scene: Gaussians) -> Gaussians:
    """Make dark blobs between the cameras and the room."""
    generator = torch.Generator().manual_seed(0)
    blobs = scene[torch.arange(20)]
    places = torch.rand((20, 3), generator=generator) * torch.tensor([1.6, 0.8, 0.4])
    return replace(
        blobs,
        means=places + torch.tensor([-0.8, -0.4, 1.0]),
        scales=torch.full((20, 3), 0.05),
        opacities=torch.full((20,), 0.9),
        sh=torch.full_like(blobs.sh, -1.2),
    )


def count_floaters(splat: Path) -> int:
    """Count the Gaussians between the cameras and the room."""
    z = load_ply(splat).means[:, 2]
    return int(((z > 0.95) & (z < 1.45)).sum())


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


@pytest.mark.parametrize("name", [pytest.param("complete", marks=pytest.mark.slow), "update"])
def test_what_was_removed_stays_out(name, small_room, camera, small_without_crate, tmp_path):
    targets = ("--target", camera) if name == "complete" else ()
    again = run_on(small_room, name, small_without_crate, tmp_path / "again", *targets)
    assert abs(measure_emptiness(again) - measure_emptiness(small_without_crate)) < 0.3
    summary = json.loads((again.parent / "summary.json").read_text())
    assert any(row["ignored"] > 0.02 for row in summary["context"])
    assert list_commands(again) == ["remove", name]


@pytest.mark.slow
def test_what_was_removed_comes_back_if_that_is_asked_for(room, without_crate, tmp_path):
    words = ("--forget-edits",)
    again = run_on(room, "update", without_crate, tmp_path / "again", *words)
    assert measure_emptiness(again) < measure_emptiness(without_crate) - 2


def test_lines_say_what_is_kept_and_what_is_not_known(small_without_crate, tmp_path):
    (line,) = describe_taken_out(InputSplatFile(small_without_crate), forgets=False)
    assert line.startswith("1 removal of this splat is kept: photographs are ignored where they")
    (line,) = describe_taken_out(InputSplatFile(small_without_crate), forgets=True)
    assert "forgotten" in line
    alone = tmp_path / "alone.ply"
    alone.write_bytes(small_without_crate.read_bytes())
    (line,) = describe_taken_out(InputSplatFile(alone), forgets=False)
    assert "What was removed is not known" in line


@pytest.mark.slow
def test_photographs_replace_what_was_invented_before(room, tmp_path):
    """Complete -> update -> strip: photographs come of what the first command invented."""
    left = photographed(tmp_path / "left", CAMERAS[:2])
    splat, aside = tmp_path / "left.ply", room.parent / "aside" / "transforms.json"
    save_ply(splat, merge([gaussians_of(view_of(ROOM, camera)) for camera in CAMERAS[:2]]))
    completed = run_on(left, "complete", splat, tmp_path / "completed", "--target", aside)
    check_counts(splat, completed)
    num_invented = int((load_ply(completed).generated == 1).sum())
    assert num_invented > 100

    words = ("--context", 4, 7)
    updated = run_on(room, "update", completed, tmp_path / "updated", *words)
    check_counts(completed, updated)
    summary = json.loads((updated.parent / "summary.json").read_text())
    num_replaced = summary["gaussians"]["replaced"]
    # Most is farther to the right than any photograph shows.
    assert num_replaced > 0.05 * num_invented
    assert num_replaced == num_invented - int((load_ply(updated).generated == 1).sum())
    told = f"{num_replaced:,} Gaussians of earlier commands gave way to what photographs show"
    assert told in (updated.parent / "report.html").read_text()
    for row in summary["context"]:
        assert row["psnr_after"] > row["psnr_before"] + 3
    # What was given stays, bit for bit, also where the first command recoloured it.
    given, kept = (scene[scene.generated == 0] for scene in map(load_ply, (completed, updated)))
    assert torch.equal(given.means, kept.means)
    kinds = [count_row_kinds(p, read_edits(p), len(load_ply(p))) for p in (completed, updated)]
    assert kinds[0]["recolored"] == kinds[1]["recolored"] > 0
    # Each state comes back.
    assert strip_last(updated, tmp_path / "before.ply") == completed.read_bytes()
    out = tmp_path / "first.ply"
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, "strip", updated, "--out", out, "--quiet") == 0
    assert out.read_bytes() == splat.read_bytes()

    # A label alone does not tell what was invented, so that without the record nothing goes.
    alone = tmp_path / "alone.ply"
    alone.write_bytes(completed.read_bytes())
    task = replace(TASK, scene=load_ply(alone), splat_file=InputSplatFile(alone))
    task, (line,) = mark_earlier_work(task)
    assert task.earlier.invented is None
    assert line.endswith("that stays, also where photographs show something else.")


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


def test_a_splat_that_another_program_changed_keeps_its_removals(
    small_room, small_without_crate, tmp_path
):
    shutil.copytree(small_without_crate.parent, tmp_path / "copy")
    changed = tmp_path / "copy" / "completed.ply"
    save_ply(changed, load_ply(changed)[:-5], provenance=True)
    again = run_on(small_room, "clean", changed, tmp_path / "again")
    first, second = read_edits(again).edits
    assert (first.can_be_undone, second.can_be_undone) == (False, True)
    assert first.taken_out is not None
    with pytest.raises(InputError, match="changed by another program"):
        strip_edits(again, tmp_path / "x.ply", [1])


@pytest.mark.slow
def test_a_session_between_complete_and_update_is_kept_by_both(room, tmp_path):
    """Complete -> live (a stroke) -> update: the marked crate stays out."""
    splat, aside = room / "splat.ply", room.parent / "aside" / "transforms.json"
    completed = run_on(room, "complete", splat, tmp_path / "completed", "--target", aside)
    check_counts(splat, completed)
    assert json.loads((completed.parent / "summary.json").read_text())["gaussians"]["added"] > 50

    size = ("--resolution", WORKING_SIZE, WORKING_SIZE, "--far", 20)
    words = (room, "--scene", completed, *size)
    stroke = SessionStep("repair", TARGET, (room.parent / "mask.png").read_bytes())
    painted = run_live(words, tmp_path / "live", stroke)
    check_counts(completed, painted)
    assert measure_emptiness(painted) > measure_emptiness(completed) + 1

    updated = run_on(room, "update", painted, tmp_path / "updated", *FEW)
    check_counts(painted, updated)
    assert list_commands(updated) == ["complete", "live", "update"]
    assert abs(measure_emptiness(updated) - measure_emptiness(painted)) < 0.3
    states = [splat, completed, painted, updated]
    for before, after in pairwise(states):
        assert strip_last(after, tmp_path / "before.ply") == before.read_bytes()


@pytest.mark.slow
def test_a_splat_is_cleaned_completed_and_cleaned_again(room, tmp_path):
    """Floaters go once, and what the completion added is not taken for one."""
    given = load_ply(room / "splat.ply")
    splat = tmp_path / "floaters.ply"
    save_ply(splat, merge([given, make_floaters(given)]))
    aside = room.parent / "aside" / "transforms.json"

    cleaned = run_on(room, "clean", splat, tmp_path / "cleaned")
    assert count_floaters(splat) > 0
    assert count_floaters(cleaned) < count_floaters(splat) // 2
    completed = run_on(room, "complete", cleaned, tmp_path / "completed", "--target", aside)
    check_counts(cleaned, completed)
    assert count_floaters(completed) <= count_floaters(cleaned)
    again = run_on(room, "clean", completed, tmp_path / "again")
    assert list_commands(again) == ["clean", "complete", "clean"]
    made = load_ply(completed).generated
    assert torch.equal(load_ply(again).generated[-50:], made[-50:])
    assert int((load_ply(again).generated > 0).sum()) == int((made > 0).sum())
    counts = json.loads((again.parent / "summary.json").read_text())["gaussians"]
    assert counts["kept"] == len(load_ply(again))

    states = [splat, cleaned, completed, again]
    for before, after in pairwise(states):
        assert strip_last(after, tmp_path / "before.ply") == before.read_bytes()


@pytest.mark.slow
def test_what_an_update_added_can_be_removed_and_comes_back(room, camera, tmp_path):
    """Update -> remove -> strip."""
    scene = load_ply(room / "splat.ply")
    low, high = torch.tensor(CRATE).split(3)
    is_crate = ((scene.means > low) & (scene.means < high)).all(dim=-1)
    splat = tmp_path / "splat.ply"
    save_ply(splat, scene[~is_crate])
    # Smaller photographs differ from the splat everywhere, and show no crate before its wall.
    updated = run_on(room, "update", splat, tmp_path / "updated", *FEW, size=SIZE)
    check_counts(splat, updated)

    # What the update shows stands in the place of the crate.
    words = ("--box", *CRATE, "--target", camera)
    without = run_on(room, "remove", updated, tmp_path / "without", *words, size=SIZE)
    check_counts(updated, without)
    assert list_commands(without) == ["update", "remove"]
    assert measure_emptiness(without) > measure_emptiness(updated) + 1
    assert strip_last(without, tmp_path / "before.ply") == updated.read_bytes()
    assert strip_last(updated, tmp_path / "before.ply") == splat.read_bytes()
    out = tmp_path / "first.ply"
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, "strip", without, "--out", out, "--quiet") == 0
    assert out.read_bytes() == splat.read_bytes()


# ------------------------------------------------------------------------------------- the fox

FOX_PHOTOGRAPHS = (1, 12, 21, 30, 42)
FOX_BOX = (0.221, -3.331, 1.068, 3.621, 2.619, 4.318, 1.44, -0.987, 3.908, 4.54, 2.613, 4.098)
FOX_ROTATION = (-0.3356, -0.0044, 0.9419, -0.0123)
"""Boxes around the head and its shield, in the frame of the splat."""
SEEN = "0021.jpg"
"""The photograph at which the fox is looked at."""


@pytest.fixture
def fox(shared, tmp_path) -> Path:
    """Name a few photographs of the fox, and the splat of another trainer, in one folder."""
    source, folder = shared / "splats" / "fox", tmp_path / "fox"
    if not source.is_dir():
        pytest.skip(f"needs the splat of another trainer, and there is no folder {source}")
    (folder / "images").mkdir(parents=True)
    names = ["sparse", *(f"images/{number:04}.jpg" for number in FOX_PHOTOGRAPHS)]
    for name in names:
        (folder / name).symlink_to(source / name)
    shutil.copyfile(source / "splat.ply", folder / "splat.ply")
    return folder


def look_at_fox(folder: Path, splat: Path) -> Tensor:
    """Render a splat of the fox at a photograph of it."""
    camera = load_camera(folder, SEEN, resolution=96)
    return load_renderer("cpu").render(load_ply(splat), camera).image


def run_on_fox(folder: Path, name: str, splat: Path, out: Path, *others: object) -> Path:
    """Run a command on a splat of the fox with its photographs, and return the result."""
    words = (name, folder, "--scene", splat, "--out", out, "--resolution", 96, "--quiet", *others)
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, *words) == 0
    return out / "completed.ply"


@pytest.mark.slow
def test_a_repair_of_the_fox_is_kept_by_an_update_and_both_come_off(fox, tmp_path):
    """Repair -> update -> strip --last -> strip, byte for byte."""
    splat = fox / "splat.ply"
    given = look_at_fox(fox, splat)
    marked = torch.zeros(given.shape[:2], dtype=torch.bool)
    rows, columns = (slice(size // 2 - 8, size // 2 + 8) for size in marked.shape)
    marked[rows, columns] = True
    write_image(tmp_path / "mask.png", marked)

    marks = ("--target", SEEN, "--mask", tmp_path / "mask.png")
    repaired = run_on_fox(fox, "repair", splat, tmp_path / "repaired", *marks)
    check_counts(splat, repaired)
    updated = run_on_fox(fox, "update", repaired, tmp_path / "updated")
    check_counts(repaired, updated)
    assert list_commands(updated) == ["repair", "update"]

    # What was marked as wrong does not come back with the photographs that show it.
    was, now = look_at_fox(fox, repaired)[marked], look_at_fox(fox, updated)[marked]
    changed = (was - given[marked]).abs().mean()
    assert changed > 0.02 * given.max()
    assert (now - was).abs().mean() < 0.2 * changed

    assert strip_last(updated, tmp_path / "before.ply") == repaired.read_bytes()
    assert strip_last(repaired, tmp_path / "before.ply") == splat.read_bytes()
    out = tmp_path / "first.ply"
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, "strip", updated, "--out", out, "--quiet") == 0
    assert out.read_bytes() == splat.read_bytes()


@pytest.mark.slow
def test_a_fox_that_was_removed_stays_out_of_a_completion(fox, tmp_path):
    """Remove -> complete."""
    splat = fox / "splat.ply"
    boxes = ("--box", *FOX_BOX, "--box-rotation", *FOX_ROTATION)
    without = run_on_fox(fox, "remove", splat, tmp_path / "without", *boxes, "--auto", 1)
    check_counts(splat, without)
    completed = run_on_fox(fox, "complete", without, tmp_path / "completed", "--auto", 1)
    check_counts(without, completed)
    assert list_commands(completed) == ["remove", "complete"]
    summary = json.loads((completed.parent / "summary.json").read_text())
    assert max(row["ignored"] for row in summary["context"]) > 0.1

    given, was, now = (look_at_fox(fox, file) for file in (splat, without, completed))
    taken = (was - given).abs().amax(dim=-1) > 0.2 * given.max()
    assert taken.float().mean() > 0.1
    removed = (was - given)[taken].abs().mean()
    assert (now - was)[taken].abs().mean() < 0.25 * removed
    assert strip_last(completed, tmp_path / "before.ply") == without.read_bytes()
    assert strip_last(without, tmp_path / "before.ply") == splat.read_bytes()
