"""Verdicts on completions: success is said only where photographs that were not used confirm it."""

from __future__ import annotations

import json
import random
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gscompleter as gsc
from command import run
from gscompleter.apps.batch.running import complete_job
from gscompleter.apps.commands.batch_rows import decide_row
from gscompleter.apps.completing import run_info
from gscompleter.apps.completing.printing import print_completion, print_plan
from gscompleter.apps.completing.run_info import read_held_out
from gscompleter.apps.inputs.task import CompletionTask, Opened, Target
from gscompleter.apps.report.page import render_completion_page
from gscompleter.apps.report.plain_words import list_facts, list_notes, list_shared_warnings
from gscompleter.apps.report.schema import read_summary
from gscompleter.apps.requests.completion import ResultsRequest
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation.verdict.outcome import (
    describe_gain,
    is_like,
    judge_completion,
    make_clause,
    round_count,
)
from gscompleter.evaluation.verdict.rows import HeldOutRow, OutcomeRow, ScoreRow
from gscompleter.system.errors import InputError
from gscompleter.system.jobs.jobs import Job
from knowing_models import KnowingReconstructor
from scenes import Room, camera_at, gaussians_of, photographed, view_of

PLACES = [(-0.9 + 0.3 * number, -12 + 4 * number) for number in range(7)]
CONTEXT, TARGET = (0, 2, 4), 6
SIZE = ("--resolution", 48, "--near", 0.5, "--far", 20)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Return a room photographed from seven places on a line."""
    cameras = [camera_at(x, yaw=yaw, size=64) for x, yaw in PLACES]
    return photographed(tmp_path_factory.mktemp("scene"), cameras)


def permute_poses(scene: Path, folder: Path) -> Path:
    """Copy a scene, with the poses of its photographs permuted."""
    content = json.loads((scene / "transforms.json").read_text())
    frames = content["frames"]
    poses = [frame["transform_matrix"] for frame in frames]
    random.Random(0).shuffle(poses)
    for frame, pose in zip(frames, poses, strict=True):
        frame["transform_matrix"] = pose
        frame["file_path"] = str(scene / frame["file_path"])
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def complete(scene: Path, out: Path, *more: object, target: tuple[int, ...] = (TARGET,)) -> list:
    return [
        *("complete", scene, "--context", *CONTEXT, "--target", *target),
        *("--out", out, *SIZE, *more),
    ]


def test_the_unused_photographs_nearest_to_the_target_are_held_out(tmp_path, monkeypatch):
    """Of nine, five stand where the target does, and one of these is damaged."""
    monkeypatch.setattr(run_info, "MAX_HELD_OUT", 4)
    cameras = [camera_at(x, size=16) for x in (-0.3, 0.1, *[0.7] * 6, 3.0)]
    folder = photographed(tmp_path / "scene", cameras)
    photographs = open_photographs(folder)
    request = SceneRequest(folder, resolution=None)
    opened = Opened(request, photographs, "nerfstudio", len(cameras))
    task = CompletionTask(
        photographs.views([0, 1]),
        [Target(cameras[2], frame=2)],
        frame=np.eye(4),
        origin=np.zeros(3),
        depths={},
        scene=gaussians_of(view_of(Room(), cameras[0])),
        check_views=photographs.views([5]),
    )
    (folder / "3.png").write_bytes(b"damaged")
    by_frame = dict(enumerate(cameras))
    rows = read_held_out(opened, task, by_frame)
    assert [(row.view.frame, row.is_check) for row in rows] == [(4, False), (5, True), (6, False)]
    (row,) = read_held_out(replace(opened, held_out=(8,)), task, by_frame)
    assert row.view.frame == 8
    # What a reconstructed scene was fitted to says nothing about it.
    fitted = read_held_out(opened, replace(task, scene=None), by_frame)
    assert [row.view.frame for row in fitted] == [4, 6, 7]


def outcome_of(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())["outcome"]


def test_a_scene_that_unused_photographs_confirm_is_a_success(scene, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert run(monkeypatch, *complete(scene, out)) == 0
    said, outcome = capsys.readouterr().out, outcome_of(out)
    assert outcome["status"] == "completed"
    assert said.startswith(outcome["headline"])
    assert "the 3 nearest unused photographs gain " in outcome["headline"]
    assert re.search(
        r" dB where the scene covers them \(.*\); [\d,]+ Gaussians invented\.$", said.split("\n")[0]
    )
    for row in json.loads((out / "summary.json").read_text())["held_out"]:
        assert row["above_photograph"] > 2
        assert 0.3 < row["covered_before"] <= row["covered_after"] <= 1


@pytest.mark.slow
def test_a_scene_of_wrong_poses_is_no_success(scene, tmp_path, monkeypatch, capsys):
    broken, out = permute_poses(scene, tmp_path / "broken"), tmp_path / "out"
    assert run(monkeypatch, *complete(broken, out)) == 1
    said, outcome = capsys.readouterr(), outcome_of(out)
    assert outcome["status"] == "not-reconstructed"
    assert outcome["headline"].startswith("The scene did not reconstruct: seen from the 3 ")
    assert said.out.startswith(outcome["headline"])
    page = (out / "report.html").read_text()
    assert page.index(outcome["headline"]) < page.index("<h1>")
    assert "not reconstructed</title>" in page
    assert (out / "completed.ply").is_file()  # to look at

    assert run(monkeypatch, *complete(broken, tmp_path / "quiet", "--quiet")) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"gscompleter: {outcome['headline']}\n"


@pytest.mark.slow
def test_python_gets_the_verdict_of_the_command(scene, tmp_path, monkeypatch):
    for folder in (scene, permute_poses(scene, tmp_path / "broken")):
        out = tmp_path / f"out-{folder.name}"
        run(monkeypatch, *complete(folder, out, "--quiet"))
        settings = {"resolution": SIZE[1], "near": 0.5, "far": 20.0}
        views = gsc.load_views(folder, frames=CONTEXT, **settings)
        target = gsc.load_camera(folder, frame=TARGET, **settings)
        completion = gsc.GSCompleter()(views, target)
        verdict = gsc.judge(completion, gsc.load_views(folder, frames=(1, 3, 5), **settings))
        assert {"status": verdict.status, "headline": verdict.headline} == outcome_of(out)
        untested = gsc.judge(completion).headline
        assert untested.startswith("The scene is completed; ") or folder != scene
    with pytest.raises(InputError, match="frame 0 is part of the context"):
        gsc.judge(completion, views)


@pytest.mark.slow
def test_a_job_of_a_batch_that_did_not_reconstruct_has_failed(scene, tmp_path):
    broken = permute_poses(scene, tmp_path / "broken")
    options = {"folder": str(broken), "context": list(CONTEXT), "target": [TARGET]}
    job = Job("broken", {**options, "resolution": 64, "near": 0.5, "far": 20})
    with pytest.raises(InputError, match="The scene did not reconstruct: seen from the 3"):
        complete_job(job, tmp_path / "jobs", decide_row)
    assert (tmp_path / "jobs" / "broken" / "report.html").is_file()


@pytest.mark.slow
def test_without_unused_photographs_shared_features_decide(scene, tmp_path, monkeypatch):
    broken = permute_poses(scene, tmp_path / "broken")
    folders = {scene: ("completed", 0), broken: ("not-reconstructed", 1)}
    for folder, (status, code) in folders.items():
        out = tmp_path / status
        words = complete(folder, out, "--quiet")
        words[3:6] = [number for number in range(7) if number != TARGET]
        assert run(monkeypatch, *words) == code
        assert outcome_of(out)["status"] == status
        assert json.loads((out / "summary.json").read_text())["held_out"] == []


def test_photographs_that_show_all_are_no_failure():
    views = [view_of(Room(), camera_at(x, size=32)) for x in (-0.3, 0.3)]
    done = gsc.GSCompleter(KnowingReconstructor())(views, views[0].camera)
    assert judge_completion(done, []).headline == (
        "Nothing had to be invented, because the scene is known at this camera already."
    )
    scene = done.scene
    given = gsc.GSCompleter(KnowingReconstructor())(views, views[0].camera, scene)
    assert judge_completion(given, []).headline.startswith("Nothing was gained, because the scene")


@pytest.mark.slow
def test_the_reason_for_no_gain_is_the_first_line_and_is_said_once(
    scene, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    assert run(monkeypatch, *complete(scene, out, target=CONTEXT)) == 0
    said, outcome = capsys.readouterr().out, outcome_of(out)
    assert outcome == {
        "status": "nothing-gained",
        "headline": (
            "Nothing had to be invented, because the scene is known at this camera already "
            "(3 of 3 targets)."
        ),
    }
    assert said.startswith(outcome["headline"])
    assert said.count("known at this camera") == 1
    page = (out / "report.html").read_text()
    assert page.index(outcome["headline"]) < page.index("<h1>")
    assert page.count("The scene is known at this camera") == 0
    assert page.count("Nothing was added here.") == 3


def test_warnings_of_several_targets_are_said_once(completed_room):
    summary = read_summary(completed_room)
    (row,) = summary.targets
    noted = replace(row, warnings=("It rained.", "It was dark."))
    other = replace(row, warnings=("It rained.",))
    three = replace(summary, targets=(noted, other, noted))
    assert list(list_shared_warnings(three)) == ["Targets 1 and 3: It rained. It was dark."]
    all_three = replace(summary, targets=(other, other, other))
    assert list(list_shared_warnings(all_three)) == ["All 3 targets: It rained."]
    assert list(list_shared_warnings(replace(summary, targets=(noted, other)))) == []
    nothing = OutcomeRow("nothing-gained", "Nothing was gained, because it rained.")
    assert list(list_shared_warnings(replace(all_three, outcome=nothing))) == []


def held_out(above_photograph: float, above_color: float) -> HeldOutRow:
    none = dict.fromkeys(("psnr_before", "psnr_after", "ssim_before", "ssim_after"))
    return HeldOutRow(5, **none, above_photograph=above_photograph, above_color=above_color)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([(3.0, 5.0)], True),
        ([(1.1, 2.0), (1.1, 2.0)], True),
        ([(0.9, 2.0), (0.9, 2.0)], False),
        ([(-4.0, 0.1), (-3.0, 0.2), (5.0, 6.0)], False),  # one by chance
        ([(0.2, 15.0), (-0.2, 14.0)], True),  # a camera that hardly moved
    ],
)
def test_a_scene_is_more_like_unused_photographs_than_used_ones_are(rows, expected):
    assert is_like([held_out(*row) for row in rows]) is expected


@pytest.mark.parametrize(
    ("before", "after", "ending"),
    [
        (
            20.0,
            21.0,
            "the unused photograph 5 gains 1.0 dB where the scene covers it (20.00 dB",
        ),
        (20.0, 19.0, "but it matches the unused photograph 5 worse than before: 20.00 dB"),
    ],
)
def test_a_loss_at_unused_photographs_is_in_the_headline(before, after, ending):
    row = replace(held_out(3.0, 5.0), psnr_before=before, psnr_after=after)
    assert ending in describe_gain("It is done", [row])
    checked = replace(row, is_check=True, psnr_before=after + 9)
    assert ending in describe_gain("It is done", [row, checked])  # it took part
    assert "the checking photograph 5" in describe_gain("It is done", [checked])
    unseen = replace(row, psnr_before=None, psnr_after=None)
    assert describe_gain("It is done", [unseen]) == "It is done; no unused photograph could test it"
    # Where there is none, nothing is said about it.
    assert describe_gain("It is done", []) == "It is done"


def test_sentences_become_clauses():
    assert make_clause("The target sees no hole of the scene: nothing to complete.") == (
        "the target sees no hole of the scene"
    )
    assert make_clause("Only 3% agree.") == "only 3% agree"


def context_row(before: float | None, after: float | None) -> ScoreRow:
    return ScoreRow(1, before, after, None, None)


def test_a_splat_gains_at_its_photographs_where_no_other_one_tests_it():
    """Photographs that stay as they were do not dilute it, and renders gain nothing."""
    context = [context_row(20.0, 26.0), context_row(21.0, 25.0), context_row(30.0, 30.1)]
    assert describe_gain("Done", [], context) == "Done: 2 photographs gain 5.0 dB, to 25.5 dB"
    assert describe_gain("Done", [], context[:1]) == "Done: 1 photograph gains 6.0 dB, to 26.0 dB"
    other = describe_gain("Done", [], [context_row(11.0, 18.0)])
    assert other == (
        "Done: 1 photograph gains 7.0 dB, to 18.0 dB only, as the splat shows something else there "
        "and what was given stays"
    )
    # Where a scene is made anew of more photographs, some of the first ones lose.
    losing = [*context, context_row(33.0, 31.5)]
    told = "Done: 2 photographs gain 5.0 dB, to 25.5 dB, and 1 loses 1.5 dB"
    assert describe_gain("Done", [], losing) == told
    renders = [context_row(float("inf"), 40.0), context_row(None, None), context_row(50.0, 45.0)]
    assert describe_gain("Done", [], renders) == "Done"
    checked = replace(held_out(3.0, 5.0), psnr_before=20.0, psnr_after=20.0, is_check=True)
    assert "2 photographs gain 5.0 dB" in describe_gain("Done", [checked], context)
    unused = replace(checked, is_check=False)
    assert "the unused photograph 5 stays as it was" in describe_gain("Done", [unused], context)


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0"), (7, "7"), (163, "160"), (9_412, "9,400"), (1_249_999, "1,200,000")],
)
def test_a_number_of_gaussians_has_two_digits_that_count(count, text):
    assert round_count(count) == text


def test_facts_are_no_warnings_and_each_is_said_once(completed_room):
    """The first lines of a usual completion ask a person to do nothing."""
    summary = read_summary(completed_room)
    assert [note for note in list_notes(summary) if note.is_warning] == []
    (row,) = summary.targets
    noted = replace(row, notes=("It rained.", "It was dark."), warnings=("It was dark.",))
    opened = replace(summary.scene, notes=("2 photographs are missing.",))
    facts = list_facts(replace(summary, targets=(noted,), scene=opened))
    assert facts[0] == ("opening", "2 photographs are missing.")
    assert ("target 1", "It rained.") in facts
    assert all(text != "It was dark." for _, text in facts)
    texts = [text for _, text in facts]
    assert len(texts) == len(set(texts))


def test_bad_poses_are_a_warning_that_says_what_to_do(completed_room):
    summary = read_summary(completed_room)
    rows = tuple(replace(row, pose_error=7.0) for row in summary.context)
    (note,) = [note for note in list_notes(replace(summary, context=rows)) if note.is_warning]
    assert note.text.startswith("The poses of photographs ")
    assert "by up to 7.0 pixels" in note.text
    alone = replace(summary, context=(rows[0], *summary.context[1:]))
    (note,) = [note for note in list_notes(alone) if note.is_warning]
    assert note.text.startswith(f"The pose of photograph {rows[0].photograph} contradicts the ")
    assert "leave it out" in note.text
    assert "gscompleter poses" in note.text


def test_the_terminal_has_no_facts_and_the_page_folds_them(
    completed_room, tmp_path, capsys, monkeypatch
):
    out = Path(shutil.copytree(completed_room, tmp_path / "out"))
    summary = json.loads((out / "summary.json").read_text())
    summary["targets"][0]["notes"] = ["It rained."]
    summary["scene"]["notes"] = ["2 photographs are missing."]
    summary["context"][0]["given_depth"] = 0.1
    (out / "summary.json").write_text(json.dumps(summary))
    monkeypatch.setenv("COLUMNS", "300")
    print_completion(ResultsRequest(out=out))
    said = capsys.readouterr().out.splitlines()
    assert said[0] == summary["outcome"]["headline"]
    # The headline, the head of the table in two lines, its three rows, and the results.
    assert [line.split()[0] for line in said[-3:]] == ["Added", "The", "Report:"]
    assert len(said) == 9

    page = render_completion_page(out)
    header = page[page.index("<header>") : page.index("</header>")]
    folded = header[header.index('<details id="facts">') :]
    assert folded.rstrip().endswith("</details>")
    for text in ("It rained.", "2 photographs are missing.", "depth, which decides"):
        assert page.count(text) == folded.count(text) == 1
    assert 'class="notes"' not in header


def test_targets_have_the_numbers_that_sentences_name(completed_room, tmp_path, capsys):
    out = Path(shutil.copytree(completed_room, tmp_path / "out"))
    summary = json.loads((out / "summary.json").read_text())
    given = {**summary["targets"][0], "frame": None, "file": None}
    rows = [{**given, "warnings": [warning]} for warning in ("It rained.", "It was dark.")]
    (out / "summary.json").write_text(json.dumps({**summary, "targets": rows}))
    print_completion(ResultsRequest(out=out))
    said = capsys.readouterr().out
    assert said.index("target 1: a given camera") < said.index("target 2: a given camera")
    assert "Target 1: It rained." in said
    assert "Target 2: It was dark." in said


@pytest.mark.parametrize("is_found", [False, True])
def test_a_plan_names_a_photograph_beside_a_camera_that_was_found(tmp_path, capsys, is_found):
    """That of a camera which the user named is not written."""
    folder = photographed(tmp_path / "scene", [camera_at(x, size=16) for x in (0.0, 0.2)])
    photographs = open_photographs(folder)
    opened = Opened(SceneRequest(folder), photographs, "nerfstudio", 2)
    target = Target(camera_at(0.5, size=16), derived_from=1 if is_found else None)
    print_plan(tmp_path / "out", opened, [target], [0.25])
    said = capsys.readouterr().out
    assert "25.0 %" in said
    assert ("the photograph beside it" in " ".join(said.split())) == is_found
