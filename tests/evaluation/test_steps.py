"""Long sequences: each step starts from the last scene, and runs can be resumed."""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command import run
from gscompleter import InputError, completer
from gscompleter.data.frame import Frame
from gscompleter.data.photographs import Photographs
from gscompleter.evaluation import methods, steps, store
from gscompleter.evaluation.baselines.reggs import RegGSConfig
from gscompleter.evaluation.columns import COLUMN_GROUPS
from gscompleter.evaluation.methods import METHODS
from gscompleter.evaluation.metrics import scores
from gscompleter.evaluation.metrics.scores import compute_depth_scale
from gscompleter.evaluation.protocols import Task, make_tasks, parse_protocol
from gscompleter.evaluation.runner import RowCounts, RunConfig, evaluate, prepare_task
from gscompleter.evaluation.steps import (
    PreparedTask,
    TaskProgress,
    complete_task,
    compute_scale_drift,
    find_expected_depth,
)
from gscompleter.evaluation.store import read_run_file
from gscompleter.evaluation.tables import write_tables
from gscompleter.numerics.geometry import slide
from gscompleter.system.files.image import read_pixels
from gscompleter.types import View
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 32
ROOM = Room(boxes=(((-8.0, -1.5, -1.0), (8.0, 1.5, 5.0)),))
PLACES = ((-0.4, 0), (0.0, 0), (0.4, 0), (0.8, 0), (1.2, 0))
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
METHOD_NAMES = ("context", "full", "reggs")
CONFIG = RunConfig(generator="oracle", baseline_iterations=1)
TABLES = ("tables.md", "tables.tex", "tables.json")


@dataclass(frozen=True)
class Walk(Photographs):
    """A walk through the room with unreadable frames."""

    names = ()
    name: str = "walk"
    title: str = "walk"
    frames: tuple[Frame, ...] = ()
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    num_frames: int = len(PLACES)
    broken: tuple[int, ...] = ()

    def __len__(self) -> int:
        return self.num_frames

    def views(self, frames: Sequence[int], resolution: tuple[int, int] | None = None) -> list[View]:
        for frame in frames:
            if frame in self.broken:
                raise InputError(f"The image of frame {frame} is damaged; download it again.")
        return [view_of(ROOM, CAMERAS[frame], frame) for frame in frames]

    def find_skip_reason(self) -> str | None:
        return None


def walk(protocol: str = "sequence-1", **settings) -> Task:
    (task,) = make_tasks(parse_protocol(protocol), Walk(**settings))
    return task


SHORT = walk("sequence-1-steps-2")
FOLDER = "walk-0+1-to-2..3"


@dataclass(frozen=True)
class FewClusters(RegGSConfig):
    """Fast RegGS with few clusters."""

    components: int = 100


@pytest.fixture(scope="module", autouse=True)
def few_clusters():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "RegGSConfig", FewClusters)
        yield


@pytest.fixture(scope="module", autouse=True)
def small_holes():
    """Accept the small holes of this room, of about 45 to 60 pixels.

    In an image of 32 pixels the hole of the next target is a thin gap beside the one before, which
    would close it.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scores, "MIN_DEPTH_PIXELS", 40)
        patch.setattr(completer, "are_worth_closing", lambda gaps: False)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Return an uninterrupted run and its tables."""
    out = tmp_path_factory.mktemp("runs") / "out"
    assert evaluate([SHORT], METHOD_NAMES, out, CONFIG) == RowCounts(3, 0, 0)
    write_tables(out)
    return out


@pytest.fixture(scope="module")
def begun(finished) -> PreparedTask:
    return prepare_task(SHORT, finished / "tasks" / FOLDER, CONFIG)


@pytest.fixture(scope="module")
def ours(begun, finished) -> TaskProgress:
    """Return the steps of our method, of which the finished run has saved the predictions."""
    return complete_task(begun, "full", finished / "tasks" / FOLDER)


def turned_away(view: View) -> View:
    """Return the same photograph with a camera that faces the other way."""
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    return replace(view, camera=replace(view.camera, c2w=view.camera.c2w @ back))


def without_cost(path: Path) -> bytes:
    """Drop times and memory from a row, but keep the names of stages."""
    row = read_run_file(path)
    for step in row["steps"]:
        step["seconds"], step["peak_bytes"] = sorted(step["seconds"]), None
    row["reconstruct_seconds"] = None
    return json.dumps(row).encode()


def same_results(out: Path, other: Path) -> None:
    write_tables(out)
    rows = sorted(path.relative_to(other) for path in (other / "tasks").glob("*/*.json"))
    assert rows
    for row in rows:
        assert without_cost(out / row) == without_cost(other / row)
    for name in TABLES:
        assert (out / name).read_bytes() == (other / name).read_bytes()


def psnr_of(step: dict, when: str = "after") -> float:
    return step["scores"][f"target_{when}"]["psnr"]


# The protocol


def test_a_sequence_begins_with_two_frames_and_goes_on_by_the_same_step():
    task = walk("sequence-4", name="fox", num_frames=43)
    assert (task.context, task.targets) == ((0, 4), tuple(range(8, 41, 4)))
    assert task.name == "fox 0+4>8..40"
    assert walk("sequence-4-steps-1", name="fox", num_frames=43).name == "fox 0+4>8"
    assert len(walk(name="long", num_frames=999).targets) == 254


def test_a_sequence_needs_a_target_after_its_context():
    protocol = parse_protocol("sequence-2")
    assert make_tasks(protocol, Walk("short", num_frames=4)) == []
    assert [task.name for task in make_tasks(protocol, Walk("walk", num_frames=5))] == [
        "walk 0+2>4"
    ]


@pytest.mark.parametrize("text", ["sequence-4", "sequence-12-steps-6"])
def test_a_sequence_is_called_what_it_was_asked_for_as(text):
    assert parse_protocol(text).name == text


@pytest.mark.parametrize("text", ["sequence-0", "sequence-4-steps-0", "sequence-4-steps-255"])
def test_a_sequence_of_nothing_or_too_much_is_refused(text):
    with pytest.raises(InputError, match="is impossible"):
        parse_protocol(text)


# Steps


# `test_a_step_that_fails_is_the_last` takes steps as well.
@pytest.mark.slow
def test_ours_improves_every_view_of_a_sequence_and_stays_metric(begun, ours):
    assert [step.frame for step in ours.steps] == [2, 3]
    assert ours.error is None
    scales = [step.depth_scale for step in ours.steps if step.depth_scale is not None]
    # What is left of the hole at a later step may be too little to compare.
    assert scales
    for step in ours.steps:
        assert step.scores.target_after.psnr > step.scores.target_before.psnr + 2
        assert step.psnr_end > step.scores.target_after.psnr - 0.1
        # The median of some 50 pixels at the rim of the hole, where free space moves additions
        # behind the objects that hide them: more than 1.
        assert step.depth_scale is None or step.depth_scale == pytest.approx(1.2, abs=0.2)
    assert max(scales) / min(scales) < 1.15
    assert ours.steps[-1].psnr_end == ours.steps[-1].scores.target_after.psnr
    assert torch.equal(ours.scene.means[: len(begun.context)], begun.context.means)


def test_every_step_is_numbered_and_adds_to_the_scene_of_the_last(begun, ours):
    expected = len(begun.context)
    for number, step in enumerate(ours.steps, start=1):
        expected += step.added
        assert step.gaussians == expected
        assert (ours.scene.generated == number).sum() == step.added > 0
    assert len(ours.scene) == expected


def test_a_step_counts_every_photograph_that_is_known_by_then(ours):
    assert [len(step.scores.context_psnr) for step in ours.steps] == [2, 3]


@pytest.mark.slow
def test_photographs_that_were_completed_become_anchors(begun, tmp_path):
    nearest = complete_task(begun, "no-sa", tmp_path)
    assert [view.frame for view in nearest.views] == [0, 1, 2, 3]
    assert [step.anchor for step in nearest.steps] == [1, 2]


@pytest.mark.slow
def test_the_baseline_may_choose_them_too(begun, finished):
    turned = tuple(turned_away(view) for view in begun.views)
    state = begun.models.make_completer().begin((*turned, begun.targets[0]), begun.context)
    away = begun.models.make_completer().begin(turned, begun.context)
    for method in ("reggs", "full"):
        predicted = METHODS[method](state, begun.targets[1].camera, begun.models)
        assert state.views[predicted.anchor].frame == 2
        assert not predicted.anchor_fallback
        assert METHODS[method](away, begun.targets[0].camera, begun.models).anchor_fallback
    steps = read_run_file(finished / "tasks" / FOLDER / "reggs.json")["steps"]
    assert [step["anchor"] for step in steps] == [
        0,
        0,
    ]  # the widest baseline of those not rotated away
    assert [step["anchor_fallback"] for step in steps] == [False, False]


@pytest.mark.slow
def test_the_baseline_adds_all_that_it_lifts_and_the_context_adds_nothing(finished):
    folder = finished / "tasks" / FOLDER
    reggs, context = (read_run_file(folder / f"{name}.json") for name in ("reggs", "context"))
    assert [step["added"] for step in reggs["steps"]] == [SIZE * SIZE] * 2
    for step in context["steps"]:
        assert psnr_of(step, "before") == psnr_of(step) == step["psnr_end"]
        assert (step["anchor"], step["depth_scale"], step["added"]) == (None, None, 0)
    assert [step["gaussians"] for step in context["steps"]] == [2 * SIZE**2] * 2
    assert [step["gaussians"] for step in reggs["steps"]] == [3 * SIZE**2, 4 * SIZE**2]


def test_the_depth_scale_is_how_much_too_far_what_fills_the_holes_stands(begun):
    view, renderer = begun.targets[0], begun.models.renderer
    expected = find_expected_depth(view, view, begun.models)

    def scale(ratio, holes):
        moved = slide(gaussians_of(view), view.camera, ratio.flatten(), "constant")
        return compute_depth_scale(moved, holes, view.camera, expected, renderer)

    everywhere = torch.ones(SIZE, SIZE, dtype=torch.bool)
    true = scale(torch.ones(SIZE, SIZE), everywhere)
    assert true == pytest.approx(1, abs=0.03)
    assert scale(torch.full((SIZE, SIZE), 1.3), everywhere) == pytest.approx(1.3 * true, rel=1e-4)

    right = everywhere & (torch.arange(SIZE) >= SIZE // 2)
    ratio = torch.where(right, 1.3, 1.0)
    assert scale(ratio, right) == pytest.approx(1.3, abs=0.04)
    assert scale(ratio, ~right) == pytest.approx(1, abs=0.04)
    assert scale(ratio, right & (torch.arange(SIZE) < SIZE // 2 + 1)) is None


def test_without_measured_depth_the_scale_is_relative_to_the_model(begun):
    truth = begun.targets[0].depth
    blind = replace(begun.targets[0], depth=None)
    depth = find_expected_depth(blind, begun.views[0], begun.models)
    assert 0.2 < depth.valid.float().mean() < 1
    assert ((depth.depth - truth).abs() / truth)[depth.valid].median() < 0.05


def test_a_vehicle_in_the_photograph_is_no_surface_that_was_to_be_filled(begun):
    """A detected vehicle joins the mask of a view, and keeps its measured depth."""
    below = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    below[-8:] = True
    target = replace(begun.targets[0], ignore_mask=below)
    expected = find_expected_depth(target, target, begun.models)
    assert not expected.valid[below].any()
    assert torch.equal(expected.valid[~below], (target.depth > 0)[~below])


def test_the_drift_is_that_between_the_largest_and_the_smallest_scale():
    assert compute_scale_drift([1.0, 1.1, 0.9]) == pytest.approx(math.log(1.1 / 0.9))
    assert compute_scale_drift([1.0]) is None
    drift = next(column for column in COLUMN_GROUPS["Sequences"] if column.key == "scale_drift")
    row = {"steps": [{"depth_scale": scale} for scale in (1.0, None, 2.0)]}
    assert drift.compute_row(row) == pytest.approx(math.log(2))


# Runs


@pytest.mark.slow
def test_a_stopped_sequence_goes_on_after_its_last_whole_step(finished, tmp_path, monkeypatch):
    out = tmp_path / "out"
    original = store.save_prediction

    def stopped(path, prediction):
        original(path, prediction)
        if (path.parent.name, path.stem) == (method, "step-002"):
            path.write_bytes(path.read_bytes()[:100])
            raise KeyboardInterrupt

    monkeypatch.setattr(store, "save_prediction", stopped)
    method = "full"
    with pytest.raises(KeyboardInterrupt):
        evaluate([SHORT], METHOD_NAMES, out, CONFIG)
    (out / "tasks" / FOLDER / "context.pt").write_bytes(b"half")
    method = "reggs"
    with pytest.raises(KeyboardInterrupt):
        evaluate([SHORT], METHOD_NAMES, out, CONFIG)
    saved = []

    def recorded(path, prediction):
        saved.append(f"{path.parent.name} {path.stem}")
        original(path, prediction)

    monkeypatch.setattr(store, "save_prediction", recorded)
    assert evaluate([SHORT], METHOD_NAMES, out, CONFIG) == RowCounts(1, 0, 2)
    assert saved == ["reggs step-002"]
    same_results(out, finished)
    assert evaluate([SHORT], METHOD_NAMES, out, CONFIG) == RowCounts(0, 0, 3)


@pytest.mark.slow
def test_rows_that_are_lost_are_made_again_from_what_is_saved(finished, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    rows = [path.relative_to(out) for path in (out / "tasks").glob("*/*.json")]
    for row in rows:
        (out / row).unlink()
    monkeypatch.setattr(steps, "METHODS", {})
    assert evaluate([SHORT], METHOD_NAMES, out, CONFIG) == RowCounts(3, 0, 0)
    for row in rows:
        assert (out / row).read_bytes() == (finished / row).read_bytes()


def test_a_picture_shows_what_the_camera_of_a_step_sees(finished):
    folder = finished / "tasks" / FOLDER
    truth = view_of(ROOM, CAMERAS[3]).image
    row = read_run_file(folder / "full.json")
    seen = torch.from_numpy(read_pixels(folder / "full" / "step-002.png")) / 255
    psnr = -10 * math.log10((seen - truth).square().mean().item())
    assert psnr == pytest.approx(psnr_of(row["steps"][1]), abs=0.1)


def test_a_broken_frame_costs_its_sequence(tmp_path):
    out = tmp_path / "out"
    assert evaluate([walk(broken=(4,))], ["full"], out, CONFIG) == RowCounts(0, 1, 0)
    (row,) = map(read_run_file, (out / "tasks").glob("*/*.json"))
    assert row["error"] == "The image of frame 4 is damaged; download it again."
    assert row["steps"] == []
    write_tables(out)
    content = read_run_file(out / "tables.json")
    assert (content["cases"], content["common"]) == (1, [])
    assert "frame 4 is damaged" in (out / "tables.md").read_text()


def test_a_step_that_fails_is_the_last(begun, tmp_path, monkeypatch):
    full = METHODS["full"]

    def defect(state, target, models):
        if target.c2w.equal(begun.targets[1].camera.c2w):
            raise RuntimeError("out of\nmemory")
        return full(state, target, models)

    monkeypatch.setitem(METHODS, "full", defect)
    progress = complete_task(begun, "full", tmp_path)
    assert progress.error == "Frame 3: RuntimeError: out of memory"
    (step,) = progress.steps
    assert step.psnr_end == step.scores.target_after.psnr > step.scores.target_before.psnr


def test_methods_that_change_the_scene_are_refused(tmp_path):
    for method in ("densify-100", "distill"):
        with pytest.raises(
            InputError, match=f"'{method}' changes existing Gaussians, .* choose one of context"
        ):
            evaluate([walk()], ["full", method], tmp_path / "out", CONFIG)
    assert not (tmp_path / "out").exists()


# Tables


def test_the_tables_say_what_the_steps_say(finished):
    content = read_run_file(finished / "tables.json")
    assert list(content["methods"]) == list(METHOD_NAMES)
    steps = read_run_file(finished / "tasks" / FOLDER / "full.json")["steps"]
    full = {key: cell for key, cell in content["methods"]["full"].items() if key != "finished"}
    full = {key: cell["value"] for key, cell in full.items()}
    assert full["psnr"] == pytest.approx(sum(map(psnr_of, steps)) / 2)
    assert full["gain"] == pytest.approx(full["psnr"] - full["psnr_before"])
    assert full["psnr_end"] == sum(step["psnr_end"] for step in steps) / 2
    assert full["scale_drift"] == compute_scale_drift(
        [s["depth_scale"] for s in steps if s["depth_scale"] is not None]
    )
    assert content["methods"]["context"]["gain"]["value"] == 0
    assert "seconds" not in json.dumps(content)
    seconds = write_tables(finished).compute_seconds("full")
    totals = [step["seconds"]["total"] for step in steps]
    assert seconds["total"] == pytest.approx(sum(totals) / 2)
    assert (finished / "tables.md").read_text().count("| reggs |") == 9


def test_a_damaged_row_is_named(finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    (row,) = (out / "tasks").glob("*/full.json")
    row.write_text("[]")
    with pytest.raises(InputError, match=r"full.json is no row of scores; delete it"):
        write_tables(out)


# The command


# tests/evaluation/test_runs.py runs the command with other protocols.
@pytest.mark.slow
def test_the_command_runs_end_to_end(tmp_path, monkeypatch, capsys):
    for scene, count in (("long", 4), ("short", 2)):
        photographed(tmp_path / scene, CAMERAS[:count], ROOM)
    out = tmp_path / "out"
    by_steps = ["--protocol", "sequence-1", "--generator", "oracle", "--device", "cpu"]
    arguments = ["evaluate", tmp_path, "--out", out, *by_steps, "--methods"]
    assert run(monkeypatch, *arguments, "context", "full") == 0
    captured = capsys.readouterr()
    assert "Skipped short: sequence-1 chooses none of its 2 frames." in " ".join(
        captured.err.split()
    )
    assert "Scored 2, failed 0" in captured.err
    assert "1 of 1 cases" in captured.out
    assert "PSNR at the end" in captured.out
    scores = read_run_file(out / "tables.json")["methods"]
    assert scores["full"]["psnr"]["value"] > scores["context"]["psnr"]["value"] + 0.5
    assert run(monkeypatch, *arguments, "context", "full", "--quiet") == 0
    assert capsys.readouterr().out == ""
    assert run(monkeypatch, *arguments, "distill") == 2
    assert "'distill' changes existing Gaussians" in " ".join(capsys.readouterr().err.split())
    index = ["index", tmp_path, "--protocol", "sequence-1", "--out", tmp_path / "index.json"]
    assert run(monkeypatch, *index) == 2
    assert "has no index" in capsys.readouterr().err
    short = ["evaluate", tmp_path / "short", "--out", tmp_path / "none", *by_steps]
    assert run(monkeypatch, *short, "--methods", "full") == 2
    assert "There is no case to run" in capsys.readouterr().err
