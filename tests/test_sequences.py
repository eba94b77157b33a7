"""Long sequences: each step begins with what the last one left, and all of it can be resumed."""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command import run
from gscompleter import InputError
from gscompleter.baselines.reggs import RegGSConfig
from gscompleter.data.datasets import Skipped
from gscompleter.data.photographs import PosedPhotographs
from gscompleter.io.image import read_pixels
from gscompleter.reports.sequence_tables import sequence_tables
from gscompleter.runs import methods, sequences, store
from gscompleter.runs.methods import Parts, Start, start_of
from gscompleter.runs.protocols import (
    SequenceCase,
    ViewByView,
    parse_protocol,
    sequences_of,
)
from gscompleter.runs.runner import RunConfig, Tally
from gscompleter.runs.sequences import (
    Course,
    anchor_of,
    complete_in_sequence,
    depth_scale,
    evaluate_sequences,
    metric_depth,
    scale_drift,
    start_here,
)
from gscompleter.runs.store import read_json
from gscompleter.stages.registration import slide
from gscompleter.types import View
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 32
ROOM = Room(boxes=(((-8.0, -1.5, -1.0), (8.0, 1.5, 5.0)),))
PLACES = ((-0.4, 0), (0.0, 0), (0.4, 0), (0.8, 0), (1.2, 0))
CAMERAS = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
METHOD_NAMES = ("context", "full", "reggs")
CONFIG = RunConfig(generator="oracle", baseline_iterations=1)
TABLES = ("sequences.md", "sequences.json")


@dataclass(frozen=True)
class Walk(PosedPhotographs):
    """A walk through the room, of which some frames cannot be read."""

    names = ()
    origin = np.zeros(3)
    name: str = "walk"
    num_frames: int = len(PLACES)
    broken: tuple[int, ...] = ()

    def __len__(self) -> int:
        return self.num_frames

    def views(self, frames: Sequence[int], resolution: tuple[int, int] | None = None) -> list[View]:
        for frame in frames:
            if frame in self.broken:
                raise InputError(f"The image of frame {frame} is damaged; download it again.")
        return [view_of(ROOM, CAMERAS[frame], frame) for frame in frames]

    def reason_to_skip(self, size: tuple[int, int] | None = None) -> str | None:
        return None


def walk(**settings) -> SequenceCase:
    return ViewByView(1).case(Walk(**settings))


SHORT = ViewByView(1, steps=2).case(Walk())
FOLDER = "walk-0+1-to-2..3"


@dataclass(frozen=True)
class FewClusters(RegGSConfig):
    """RegGS in little time."""

    components: int = 100


@pytest.fixture(scope="module", autouse=True)
def few_clusters():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(methods, "RegGSConfig", FewClusters)
        yield


@pytest.fixture(scope="module")
def begun() -> tuple[Start, list[View], Parts]:
    case = walk()
    targets = case.load(case.targets)
    parts = CONFIG.parts(*targets)
    return start_of(case.load(case.context), targets[0].camera, parts), targets, parts


@pytest.fixture(scope="module")
def ours(begun) -> Course:
    start, targets, parts = begun
    return complete_in_sequence(start, targets, "full", parts)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """An uninterrupted run and its tables."""
    out = tmp_path_factory.mktemp("runs") / "out"
    assert evaluate_sequences([SHORT], METHOD_NAMES, out, CONFIG) == Tally(3, 0, 0)
    sequence_tables(out)
    return out


def turned_away(view: View) -> View:
    """The same photograph as if taken by a camera that looks the other way."""
    back = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    return replace(view, camera=replace(view.camera, c2w=view.camera.c2w @ back))


def without_seconds(path: Path) -> bytes:
    """The row of a sequence, with the stages that were timed but not how long they took."""
    row = read_json(path)
    for step in row["steps"]:
        step["seconds"] = sorted(step["seconds"])
    row["seconds"] = None
    return json.dumps(row).encode()


def same_results(out: Path, other: Path) -> None:
    sequence_tables(out)
    rows = sorted(path.relative_to(other) for path in (other / "sequences").glob("*/*.json"))
    assert rows
    for row in rows:
        assert without_seconds(out / row) == without_seconds(other / row)
    for name in TABLES:
        assert (out / name).read_bytes() == (other / name).read_bytes()


# The protocol.


def test_a_sequence_begins_with_two_frames_and_goes_on_by_the_same_step():
    case = ViewByView(4).case(Walk("fox", 43), (24, 24))
    assert (case.context, case.targets) == ((0, 4), tuple(range(8, 41, 4)))
    assert case.name == "fox 0+4>8..40"
    assert ViewByView(4, steps=1).case(Walk("fox", 43)).name == "fox 0+4>8"
    assert len(ViewByView(1).case(Walk("long", 999)).targets) == 255


def test_too_short_clips_are_left_out_with_a_reason():
    skipped: list[Skipped] = []
    found = sequences_of(ViewByView(2), [Walk("short", 4), Walk("walk", 5)], skipped)
    assert [case.name for case in found] == ["walk 0+2>4"]
    assert skipped == [Skipped("short", "it has 4 frames, and sequence-2 needs 5")]


@pytest.mark.parametrize("text", ["sequence-4", "sequence-12-steps-6"])
def test_a_sequence_is_called_what_it_was_asked_for_as(text):
    assert parse_protocol(text).name == text


@pytest.mark.parametrize("text", ["sequence-0", "sequence-4-steps-0", "sequence-4-steps-256"])
def test_a_sequence_of_nothing_or_too_much_is_refused(text):
    with pytest.raises(InputError, match="impossible; give"):
        parse_protocol(text)


# Steps.


def test_ours_improves_every_view_of_a_sequence_and_stays_metric(begun, ours):
    start = begun[0]
    assert [step.frame for step in ours.steps] == [2, 3, 4]
    assert ours.error is None
    for step in ours.steps:
        assert step.psnr_after > step.psnr_before + 2
        assert step.psnr_end > step.psnr_after - 0.1
        assert step.depth_scale == pytest.approx(1.1, abs=0.1)
    assert scale_drift([step.depth_scale for step in ours.steps]) < 0.1
    assert ours.steps[-1].psnr_end == ours.steps[-1].psnr_after
    assert torch.equal(ours.scene.means[: len(start.context)], start.context.means)


def test_every_step_is_numbered_and_adds_to_the_scene_of_the_last(begun, ours):
    expected = len(begun[0].context)
    for number, step in enumerate(ours.steps, start=1):
        expected += step.added
        assert step.gaussians == expected
        assert (ours.scene.generated == number).sum() == step.added > 0
    assert len(ours.scene) == expected


def test_photographs_that_were_completed_become_anchors(begun):
    start, targets, parts = begun
    nearest = complete_in_sequence(start, targets, "no-sa", parts)
    assert [view.frame for view in nearest.views] == [0, 1, 2, 3, 4]
    assert [step.anchor for step in nearest.steps] == [1, 2, 3]


def test_the_baseline_may_choose_them_too(begun, finished):
    start, targets, parts = begun
    turned = replace(start, views=tuple(turned_away(view) for view in start.views))
    course = replace(Course(start.context, turned.views), views=(*turned.views, targets[0]))
    here = start_here(course, turned, targets[1].camera, parts.renderer)
    assert anchor_of("reggs", here, parts) == anchor_of("full", here, parts)
    assert here.views[anchor_of("reggs", here, parts).index].frame == 2
    steps = read_json(finished / "sequences" / FOLDER / "reggs.json")["steps"]
    assert [step["anchor"] for step in steps] == [0, 0]  # the widest of those not turned away


def test_the_baseline_adds_all_that_it_lifts_and_the_context_adds_nothing(finished):
    folder = finished / "sequences" / FOLDER
    reggs, context = (read_json(folder / f"{name}.json") for name in ("reggs", "context"))
    assert [step["added"] for step in reggs["steps"]] == [SIZE * SIZE] * 2
    for step in context["steps"]:
        assert step["psnr_before"] == step["psnr_after"] == step["psnr_end"]
        assert (step["anchor"], step["depth_scale"], step["added"]) == (None, None, 0)
    assert reggs["gaussians"]["after"] == context["gaussians"]["after"] + 2 * SIZE * SIZE
    assert [step["gaussians"] for step in reggs["steps"]] == [3 * SIZE**2, 4 * SIZE**2]


def test_the_depth_scale_is_how_much_too_far_what_fills_the_holes_stands(begun):
    view, renderer = begun[1][0], begun[2].renderer
    expected = metric_depth(view, view, begun[2])

    def scale(ratio, holes):
        moved = slide(gaussians_of(view), view.camera, ratio.flatten(), "constant")
        return depth_scale(moved, holes, view.camera, expected, renderer)

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
    start, targets, parts = begun
    blind = replace(targets[0], depth=None)
    depth = metric_depth(blind, start.views[0], parts)
    truth = targets[0].depth
    assert 0.2 < depth.valid.float().mean() < 1
    assert ((depth.depth - truth).abs() / truth)[depth.valid].median() < 0.05


def test_the_drift_is_that_between_the_largest_and_the_smallest_scale():
    assert scale_drift([1.0, None, 1.1, 0.9]) == pytest.approx(math.log(1.1 / 0.9))
    assert scale_drift([1.0, None]) is None


# Runs.


def test_a_stopped_sequence_goes_on_after_its_last_whole_step(finished, tmp_path, monkeypatch):
    out = tmp_path / "out"
    original = store.save_outcome

    def stopped(path, saved):
        original(path, saved)
        if (path.parent.name, path.stem) == (method, "step-002"):
            path.write_bytes(path.read_bytes()[:100])
            raise KeyboardInterrupt

    monkeypatch.setattr(store, "save_outcome", stopped)
    method = "full"
    with pytest.raises(KeyboardInterrupt):
        evaluate_sequences([SHORT], METHOD_NAMES, out, CONFIG)
    (out / "sequences" / FOLDER / "start.npz").write_bytes(b"half")
    method = "reggs"
    with pytest.raises(KeyboardInterrupt):
        evaluate_sequences([SHORT], METHOD_NAMES, out, CONFIG)
    saved = []

    def recorded(path, outcome):
        saved.append(f"{path.parent.name} {path.stem}")
        original(path, outcome)

    monkeypatch.setattr(store, "save_outcome", recorded)
    assert evaluate_sequences([SHORT], METHOD_NAMES, out, CONFIG) == Tally(1, 0, 2)
    assert saved == ["reggs step-002"]
    same_results(out, finished)
    assert evaluate_sequences([SHORT], METHOD_NAMES, out, CONFIG) == Tally(0, 0, 3)


def test_rows_that_are_lost_are_made_again_from_what_is_saved(finished, tmp_path, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    rows = [path.relative_to(out) for path in (out / "sequences").glob("*/*.json")]
    for row in rows:
        (out / row).unlink()
    monkeypatch.setattr(sequences, "METHODS", {})
    assert evaluate_sequences([SHORT], METHOD_NAMES, out, CONFIG) == Tally(3, 0, 0)
    for row in rows:
        assert (out / row).read_bytes() == (finished / row).read_bytes()


def test_a_picture_shows_what_the_camera_of_a_step_sees(finished):
    folder = finished / "sequences" / FOLDER
    truth = view_of(ROOM, CAMERAS[3]).image
    row = read_json(folder / "full.json")
    seen = torch.from_numpy(read_pixels(folder / "full" / "step-002.png")) / 255
    psnr = -10 * math.log10((seen - truth).square().mean().item())
    assert psnr == pytest.approx(row["steps"][1]["psnr_after"], abs=0.1)


def test_a_broken_frame_ends_a_sequence_and_keeps_the_steps_before(finished, tmp_path):
    out, (row_there,) = tmp_path / "out", (finished / "sequences").glob("*/full.json")
    broken, hopeless = walk(broken=(4,)), walk(name="lost", broken=(1,))
    assert evaluate_sequences([broken, hopeless], ["full"], out, CONFIG) == Tally(0, 2, 0)
    rows = {path.parent.name: read_json(path) for path in (out / "sequences").glob("*/*.json")}
    row, lost = rows["walk-0+1-to-2..4"], rows["lost-0+1-to-2..4"]
    assert row["error"] == "Frame 4: The image of frame 4 is damaged; download it again."
    whole = read_json(row_there)["steps"]
    assert [s["psnr_after"] for s in row["steps"]] == [s["psnr_after"] for s in whole[:2]]
    assert "frame 1 is damaged" in lost["error"]
    assert lost["steps"] == []
    sequence_tables(out)
    content = read_json(out / "sequences.json")
    assert (content["sequences"], content["common"]) == (2, [])
    assert [failure["steps"] for failure in content["failures"]] == [0, 2]
    assert "frame 4 is damaged" in (out / "sequences.md").read_text()


def test_a_step_that_fails_is_the_last(begun, monkeypatch):
    start, targets, parts = begun
    full = sequences.METHODS["full"]

    def defect(start, parts):
        if start.target.c2w.equal(targets[1].camera.c2w):
            raise RuntimeError("out of\nmemory")
        return full(start, parts)

    monkeypatch.setitem(sequences.METHODS, "full", defect)
    course = complete_in_sequence(start, targets, "full", parts)
    assert course.error == "Frame 3: RuntimeError: out of memory"
    (step,) = course.steps
    assert step.psnr_end == step.psnr_after > step.psnr_before


def test_methods_that_change_the_scene_are_refused(tmp_path):
    for method in ("densify-100", "distill"):
        with pytest.raises(InputError, match=f"'{method}' changes the scene .* choose of context"):
            evaluate_sequences([walk()], ["full", method], tmp_path / "out", CONFIG)
    assert not (tmp_path / "out").exists()


# Tables.


def test_the_tables_say_what_the_steps_say(finished):
    content = read_json(finished / "sequences.json")
    assert list(content["methods"]) == list(METHOD_NAMES)
    (steps,) = content["steps"].values()
    full = content["methods"]["full"]
    after = [step["psnr_after"] for step in steps["full"]]
    assert full["psnr_after"] == pytest.approx(sum(after) / 2)
    assert full["gain"] == pytest.approx(full["psnr_after"] - full["psnr_before"])
    assert full["scale_drift"] == scale_drift([step["depth_scale"] for step in steps["full"]])
    assert content["methods"]["context"]["gain"] == 0
    assert "seconds" not in json.dumps(content)
    timings = read_json(finished / "sequence_timings.json")
    totals = [step["total"] for step in timings["steps"]["walk 0+1>2..3"]["reggs"]]
    assert timings["methods"]["reggs"] == {
        "mean": pytest.approx(sum(totals) / 2),
        "longest": max(totals),
    }
    assert (finished / "sequences.md").read_text().count("| reggs |") == 3


def test_without_sequences_there_are_no_tables(tmp_path):
    sequence_tables(tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "sequences" / "walk").mkdir(parents=True)
    (tmp_path / "sequences" / "walk" / "full.json").write_text("[]")
    with pytest.raises(InputError, match="no row of a sequence"):
        sequence_tables(tmp_path)


# The command.


def test_the_command_runs_end_to_end(tmp_path, monkeypatch, capsys):
    for scene, count in (("long", 4), ("short", 2)):
        photographed(tmp_path / scene, CAMERAS[:count], ROOM)
    out = tmp_path / "out"
    by_steps = ["--protocol", "sequence-1", "--generator", "oracle", "--device", "cpu"]
    arguments = ["evaluate", tmp_path, "--out", out, *by_steps, "--methods"]
    assert run(monkeypatch, *arguments, "context", "full") == 0
    said = capsys.readouterr()
    assert "Left out short: it has 2 frames, and sequence-1 needs 3." in " ".join(said.err.split())
    assert len(list(out.glob("sequence_long*.png"))) == 1
    assert "Scored 2, failed 0" in said.err
    assert "1 of 1 sequences" in said.out
    scores = read_json(out / "sequences.json")["methods"]
    assert scores["full"]["psnr_after"] > scores["context"]["psnr_after"] + 0.5
    assert run(monkeypatch, *arguments, "context", "full", "--quiet") == 0
    assert capsys.readouterr().out == ""
    assert run(monkeypatch, *arguments, "distill") == 2
    assert "'distill' changes the scene" in " ".join(capsys.readouterr().err.split())
    index = ["index", tmp_path, "--protocol", "sequence-1", "--out", tmp_path / "index.json"]
    assert run(monkeypatch, *index) == 2
    assert "has no index" in capsys.readouterr().err
    short = ["evaluate", tmp_path / "short", "--out", tmp_path / "none", *by_steps]
    assert run(monkeypatch, *short, "--methods", "full") == 2
    assert "There is no case to run" in capsys.readouterr().err
