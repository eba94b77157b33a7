"""Runs of methods over tasks: files, resumed runs, and refused input."""

import copy
import itertools
import json
import mmap
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

import pytest
import torch

from chunk_files import as_tensor, example, save_chunk
from command import run
from gscompleter import GSCompleter, InputError
from gscompleter.apps.commands.evaluate import EvaluateOptions
from gscompleter.evaluation import methods as runs_methods
from gscompleter.evaluation import runner
from gscompleter.evaluation.baselines.reggs import RegGSConfig
from gscompleter.evaluation.cases import Case
from gscompleter.evaluation.columns import COLUMN_GROUPS
from gscompleter.evaluation.memory import measure_peak_memory
from gscompleter.evaluation.methods import (
    BASELINES,
    METHODS,
    check_methods,
    expand_methods,
    synthesize_reference,
)
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.evaluation.protocols import Task, make_case_task, read_evaluation_index
from gscompleter.evaluation.run_facts import RunFacts
from gscompleter.evaluation.runner import RowCounts, RunConfig, evaluate
from gscompleter.evaluation.store import (
    get_step_path,
    get_task_folder,
    load_prediction,
    load_values,
    read_run_file,
)
from gscompleter.evaluation.tables import (
    format_score_latex,
    format_score_markdown,
    summarize_run,
    write_tables,
)
from gscompleter.system import memory
from gscompleter.system.files.image import read_image
from gscompleter.system.timing import STAGES
from scenes import Room, camera_at, photographed

SIZE = 32
METHOD_NAMES = ("context", "full", "densify-100")
CONFIG = RunConfig(baseline_iterations=6)
TABLES = ("tables.md", "tables.tex", "tables.json")
ROOMS = {"box": Room(), "wide": Room(boxes=(((-4.0, -1.5, -1.0), (4.0, 1.5, 6.0)),))}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    """Write two rooms with four views each; frames 2 and 3 see more than 0 and 1."""
    root = tmp_path_factory.mktemp("rooms")
    places = ((-0.3, 0), (0.1, 0), (0.7, 12), (0.8, 14))
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in places]
    for scene, room in ROOMS.items():
        photographed(root / scene, cameras, room)
    rows = [
        {
            "scene": scene,
            "context": [0, 1],
            "target": 2,
            "neighbours": [3],
            "near": 0.5,
            "far": 20.0,
        }
        for scene in ROOMS
    ]
    (root / "cases.json").write_text(json.dumps({"resolution": [SIZE, SIZE], "cases": rows}))
    return root


def room(folder: Path, context: tuple[int, ...] = (0, 1)) -> Task:
    return make_case_task(Case(folder, context, 2, (3,), (SIZE, SIZE), 0.5, 20.0))


@pytest.fixture(scope="module")
def tasks(scenes) -> list[Task]:
    return [room(scenes / scene) for scene in ROOMS]


@pytest.fixture(scope="module")
def finished(tasks, tmp_path_factory) -> Path:
    """Return an uninterrupted run and its tables."""
    out = tmp_path_factory.mktemp("runs") / "out"
    assert evaluate(tasks, METHOD_NAMES, out, CONFIG) == RowCounts(6, 0, 0)
    write_tables(out)
    return out


def same_tables(out: Path, other: Path) -> None:
    write_tables(out)
    for name in TABLES:
        assert (out / name).read_bytes() == (other / name).read_bytes(), name


def test_each_case_and_method_has_a_row_and_full_beats_the_context(finished):
    content = read_run_file(finished / "tables.json")
    assert list(content["methods"]) == list(METHOD_NAMES)
    assert (content["cases"], len(content["common"]), content["failures"]) == (2, 2, [])
    scores = {name: row["psnr"]["value"] for name, row in content["methods"].items()}
    gains = {name: row["gain"]["value"] for name, row in content["methods"].items()}
    assert gains["context"] == 0
    assert gains["full"] > 1
    for name, score in scores.items():
        assert score - gains[name] == pytest.approx(scores["context"])
    assert content["methods"]["context"]["context_change"]["value"] == 0
    without = content["methods"]["full"]["lpips_vgg"]["value"] is None
    assert ("LPIPS: not available" in (finished / "tables.md").read_text()) == without
    full, before = (content["methods"][name] for name in ("full", "context"))
    assert full["hole_haarpsi"]["value"] > before["hole_haarpsi"]["value"]
    assert 0 < full["hole_gradients"]["value"] < 10
    assert "### Perceptual quality" in (finished / "tables.md").read_text()
    assert "seconds" not in json.dumps(content)
    timings = (finished / "timings.md").read_text()
    assert all(f"| {name} | " in timings for name in METHOD_NAMES)


def test_flip_sees_that_holes_are_filled(finished):
    pytest.importorskip("flip_evaluator", reason="needs gscompleter[evaluation]")
    methods = read_run_file(finished / "tables.json")["methods"]
    full, before = (methods[name]["hole_flip"]["value"] for name in ("full", "context"))
    assert full < 0.8 * before


def scores_of(out: Path, method: str) -> list[dict]:
    """Return the scores of a method in each task of one step."""
    rows = [read_run_file(path) for path in sorted((out / "tasks").glob(f"*/{method}.json"))]
    return [row["steps"][0]["scores"] for row in rows]


def test_what_was_added_and_all_that_was_lifted_are_compared_with_the_context(finished, tasks):
    for task, scores in zip(tasks, scores_of(finished, "full"), strict=True):
        folder = get_task_folder(finished, task.name)
        context = load_values(folder / "context.pt", "cpu")["gaussians"]
        prediction = load_prediction(get_step_path(folder, "full", 1), context)
        assert len(prediction.registered) > len(prediction.added) > 0
        added, registered = scores["added"], scores["registered"]
        assert added["f_score"] > 0.15
        assert registered["f_score"] > 0.9
        assert registered["abs_rel"] < 0.1
        assert registered["pixels"] > 1.5 * added["pixels"] > 0
    for method in ("context", "densify-100"):
        for scores in scores_of(finished, method):
            assert scores["seam_step"] is scores["added"] is scores["registered"] is None


def test_geometry_of_few_pixels_is_left_out(finished):
    rows = [read_run_file(path) for path in sorted((finished / "tasks").glob("*/full.json"))]
    rows = [copy.deepcopy(rows[i % 2]) for i in range(4)]
    for number, row in enumerate(rows):
        row["task"]["name"] = str(number)
        row["steps"][0]["scores"].update(
            depth_hole={
                "abs_rel": (0.1, 0.2, 0.6, 9.0)[number],
                "pixels": (500, 900, 700, 499)[number],
            }
        )
    summary = summarize_run(rows)
    hole, median = (
        summary.compute_cell("full", column)
        for column in COLUMN_GROUPS["Geometry"]
        if column.key.startswith("depth_hole")
    )
    assert hole == (pytest.approx(0.3), 3)
    assert median == (0.2, 3)
    assert "at least 500 pixels" in " ".join(summary.notes)


def test_tables_are_plain_latex_and_blame_no_package_for_what_was_not_to_measure():
    facts = RunFacts("plane-sweep", "warp-inpaint", 0, 0, ())
    scores = {"target_before": {"psnr": 20.0}, "target_after": {"psnr": 21.0}}
    row = {"task": {"name": "a", "targets": [1]}, "method": "full", "error": None}
    summary = summarize_run([{**row, "steps": [{"scores": scores}]}])
    latex = format_score_latex(summary, facts)
    assert latex.isascii()
    assert r"min $\Delta$PSNR" in latex

    # FLIP is installed here, and there is no hole.
    markdown = format_score_markdown(summary, "not requested.", facts)
    assert "FLIP: not available. It needs a hole" in markdown
    failed = summarize_run([{**row, "error": "broken", "steps": []}])
    assert "not available" not in format_score_markdown(failed, "not requested.", facts)


# `test_steps.py` makes the rows of a sequence again.
@pytest.mark.slow
def test_rows_that_are_lost_are_made_again_from_what_is_saved(finished, tasks, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    for path in (out / "tasks").glob("*/*.json"):
        path.unlink()
    saved = {path: path.read_bytes() for path in (out / "tasks").rglob("*.pt")}
    assert evaluate(tasks, METHOD_NAMES, out, CONFIG) == RowCounts(6, 0, 0)
    assert saved == {path: path.read_bytes() for path in (out / "tasks").rglob("*.pt")}
    for path in (out / "tasks").glob("*/*.json"):
        assert path.read_bytes() == (finished / path.relative_to(out)).read_bytes()
    same_tables(out, finished)


LIFE = """
import os, signal, sys, threading, time
from pathlib import Path
from gscompleter.evaluation.cases import read_cases
from gscompleter.evaluation.runner import RunConfig, evaluate
from gscompleter.evaluation.protocols import make_case_task

cases, out, methods, iterations, *delays = sys.argv[1:]

def written():
    return {path for path in Path(out).rglob("*") if path.suffix in (".pt", ".json")}

def die(before, delay):
    while written() == before:
        time.sleep(0.005)
    time.sleep(float(delay))
    os.kill(os.getpid(), signal.SIGKILL)

def live(delay):
    if delay != "never":
        threading.Thread(target=die, args=(written(), delay), daemon=True).start()
    config = RunConfig(baseline_iterations=int(iterations))
    evaluate(list(map(make_case_task, read_cases(Path(cases)))), methods.split(), Path(out), config)
    os._exit(0)

for delay in delays:
    child = os.fork()
    if child == 0:
        live(delay)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Program of runs in sequence, each killed seconds after it wrote something new, or never."""


@pytest.mark.slow
@pytest.mark.linux
@pytest.mark.skipif(os.name != "posix", reason="forks, and kills with a POSIX signal")
def test_a_run_killed_five_times_ends_as_one_that_was_not(scenes, finished, tmp_path):
    """Each run is its own process, as for a user."""

    def live(*delays: float | str) -> list[int]:
        words = [scenes / "cases.json", out, " ".join(METHOD_NAMES), 6, *delays]
        command = [sys.executable, "-c", LIFE, *map(str, words)]
        lives = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        return [int(code) for code in lives.stdout.split()]

    out, random = tmp_path / "out", Random(0)
    assert live(*(random.uniform(0, 0.05) for _ in range(5))) == [-signal.SIGKILL] * 5
    assert 0 < len(list((out / "tasks").glob("*/*.json"))) < 6
    assert live("never") == [0]
    same_tables(out, finished)


@pytest.mark.slow
def test_failures_and_scores_can_be_done_again(tasks, tmp_path, monkeypatch):
    out, original = tmp_path / "out", METHODS["no-rc"]

    def defect(state, target, models):
        raise RuntimeError("a bad day")

    monkeypatch.setitem(METHODS, "no-rc", defect)
    methods = ("context", "no-rc")
    assert evaluate(tasks[:1], methods, out, CONFIG) == RowCounts(1, 1, 0)
    assert evaluate(tasks[:1], methods, out, CONFIG) == RowCounts(0, 0, 2)
    monkeypatch.setitem(METHODS, "no-rc", original)
    assert evaluate(tasks[:1], methods, out, CONFIG, rerun="failures") == RowCounts(1, 0, 1)

    monkeypatch.setitem(
        METHODS, "no-rc", defect
    )  # saved predictions are scored without running a method
    assert evaluate(tasks[:1], methods, out, CONFIG, rerun="scores") == RowCounts(2, 0, 0)


def test_pictures_are_saved(finished):
    (box,) = (finished / "tasks").glob("box*")
    names = ("full/before-001", "full/step-001", "truth-001")
    before, after, truth = (read_image(box / f"{name}.png") for name in names)
    assert psnr(after, truth) > psnr(before, truth)
    assert read_image(box / "context" / "step-001.png").equal(before)


def test_time_and_memory_are_told_apart_from_scores(finished):
    summary = write_tables(finished)
    full = summary.compute_seconds("full")
    assert list(full) == ["reconstruct", *STAGES, "total"]
    assert 0.5 * full["total"] < sum(full[stage] for stage in STAGES) <= 1.01 * full["total"]
    assert list(summary.compute_seconds("densify-100"))[1:] == ["generate", "optimize", "total"]
    if sys.platform == "linux":
        assert all(summary.find_peak_bytes(method) > 2**26 for method in METHOD_NAMES)


def test_fid_is_a_number_or_a_reason(finished, monkeypatch):
    write_tables(finished, with_fid=True)
    text = (finished / "tables.md").read_text()
    reason = read_run_file(finished / "tables.json")["fid"]["reason"]
    if reason is None:
        assert "### FID" in text
    else:
        assert "FID: FID is not available (" in text
    calls = []

    def stand_in(images, truths):
        calls.append([image.shape for image in images])
        return float(len(calls))

    monkeypatch.setattr("gscompleter.evaluation.tables.compute_fid", stand_in)
    write_tables(finished, with_fid=True)
    assert calls == [[(SIZE, SIZE, 3)] * 2] * len(METHOD_NAMES)
    assert "| full | 2.00 |" in (finished / "tables.md").read_text()
    write_tables(finished)
    assert "FID: not requested" in (finished / "tables.md").read_text()


def test_groups_of_methods():
    assert expand_methods(["full", "baselines", "reggs"])[0] == "full"
    assert expand_methods(["full", "baselines"])[1:] == tuple(BASELINES)
    everything = expand_methods(["all"])
    assert {"context", "full", "paper", "unconstrained", "no-sa", *BASELINES} <= set(everything)
    assert set(everything) <= set(METHODS)


def test_peak_memory_sees_what_was_let_go_of():
    # Fresh pages: memory released by earlier tests could be reused.
    with measure_peak_memory() as much, mmap.mmap(-1, 2**28) as pages:
        for page in range(0, 2**28, mmap.PAGESIZE):
            pages[page] = 1
    with measure_peak_memory() as nothing:
        pass
    if sys.platform == "linux":
        assert much.bytes - nothing.bytes > 2**27


@pytest.mark.slow
def test_a_run_goes_on_where_it_was_stopped(finished, tasks, tmp_path, monkeypatch):
    out = tmp_path / "out"
    original = runner.write_json

    def stopped(path, content, keep_existing=False):
        if path.parent.name.startswith("wide") and path.name == "full.json":
            raise KeyboardInterrupt
        original(path, content, keep_existing)

    monkeypatch.setattr(runner, "write_json", stopped)
    with pytest.raises(KeyboardInterrupt):
        evaluate(tasks, METHOD_NAMES, out, CONFIG)
    monkeypatch.setattr(runner, "write_json", original)
    (wide,) = (out / "tasks").glob("wide*")
    (wide / "context.pt").write_bytes(b"half")
    (wide / "full" / "step-001.pt").unlink()
    assert evaluate(tasks, METHOD_NAMES, out, CONFIG) == RowCounts(2, 0, 4)
    same_tables(out, finished)
    assert evaluate(tasks, METHOD_NAMES, out, CONFIG) == RowCounts(0, 0, 6)


def test_a_broken_case_is_a_row_with_its_reason(scenes, tasks, tmp_path, monkeypatch):
    broken = room(scenes / "box", (0, 9))
    out = tmp_path / "out"

    def defect(state, target, models):
        raise RuntimeError("out of\nmemory")

    monkeypatch.setitem(METHODS, "no-rc", defect)
    methods = ("context", "no-rc")
    assert evaluate([broken, tasks[0]], methods, out, CONFIG) == RowCounts(1, 3, 0)
    summary = write_tables(out)
    reasons = {(task, method): reason for task, method, reason in summary.failures}
    assert "no frame 9" in reasons[broken.name, "context"]
    assert reasons[tasks[0].name, "no-rc"] == "Frame 2: RuntimeError: out of memory"
    assert (len(summary.tasks), summary.common_tasks) == (2, ())
    assert "RuntimeError" in (out / "tables.md").read_text()


@dataclass(frozen=True)
class CoarseRegGS(RegGSConfig):
    """RegGS with few clusters, because its time is quadratic in them."""

    components: int = 50


# `test_baselines.py` runs both on one scene.
@pytest.mark.slow
def test_baselines_run(tasks, tmp_path, monkeypatch):
    monkeypatch.setattr(runs_methods, "RegGSConfig", CoarseRegGS)
    out = tmp_path / "out"
    config = RunConfig(baseline_iterations=2)
    assert evaluate(tasks[:1], ("distill", "reggs"), out, config) == RowCounts(2, 0, 0)
    rows = {path.stem: read_run_file(path) for path in (out / "tasks").glob("*/*.json")}
    (distill,), (reggs,) = (rows[method]["steps"] for method in ("distill", "reggs"))
    assert (distill["added"], distill["anchor"], distill["scores"]["seam_step"]) == (0, None, None)
    assert (reggs["added"], reggs["anchor"]) == (SIZE * SIZE, 0)
    assert reggs["scores"]["registered"]["pixels"] > 500
    write_tables(out)
    (note,) = (n for n in read_run_file(out / "tables.json")["notes"] if n.startswith("reggs"))
    for name in ("tables.md", "tables.tex"):
        assert note in (out / name).read_text()


def test_wrong_runs_are_refused(finished, tasks, tmp_path):
    with pytest.raises(
        InputError, match="no method 'nope'; choose one of ablations, baselines, all, context, full"
    ):
        check_methods(["context", "nope"])
    with pytest.raises(InputError, match="no such shard"):
        evaluate(tasks, ["context"], tmp_path / "out", CONFIG, (2, 2))
    with pytest.raises(InputError, match="Two cases are called box"):
        evaluate([tasks[0]] * 2, ["context"], tmp_path / "out", CONFIG)
    with pytest.raises(InputError, match="no case to run"):
        evaluate([], ["context"], tmp_path / "out", CONFIG)
    with pytest.raises(InputError, match="no generator"):
        evaluate(tasks, ["context"], tmp_path / "out", RunConfig(generator="dall-e"))
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="seed 0, and this run has 1"):
        evaluate(tasks, ["context"], finished, RunConfig(seed=1, baseline_iterations=6))
    # A file of cases whose resolution or depth was changed: names of cases do not tell it.
    for name, value in (("resolution", (48, 48)), ("near", 0.6), ("neighbours", ())):
        changed = replace(tasks[0], **{name: value})
        with pytest.raises(InputError, match=rf"the case box .* with {name} .*; name another"):
            evaluate([changed], ["no-rc"], finished, CONFIG)
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="something other than a run"):
        evaluate(tasks, ["context"], tmp_path, CONFIG)
    with pytest.raises(InputError, match="holds no run"):
        write_tables(tmp_path)


def test_the_commands_run_end_to_end(scenes, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    arguments = ["evaluate", scenes / "cases.json", "--methods", "context", "--device", "cpu"]
    assert run(monkeypatch, *arguments, "--out", out, "--shard", "0/2") == 0
    assert run(monkeypatch, *arguments, "--out", out, "--shard", "1/2") == 0
    assert "Over 2 of 2 cases" in capsys.readouterr().out
    assert run(monkeypatch, "tables", out, "--quiet") == 0
    assert capsys.readouterr().out == ""

    index = tmp_path / "n-1.json"
    assert run(monkeypatch, "index", scenes / "box", "--protocol", "n-1", "--out", index) == 0
    assert "2 cases in 1 scenes" in capsys.readouterr().out
    assert list(read_evaluation_index(index).scenes) == ["box"]
    by_index = ["evaluate", scenes / "box", "--protocol", index, "--methods", "context"]
    more = ["--out", tmp_path / "more", "--limit", 1, "--quiet", "--device", "cpu"]
    assert run(monkeypatch, *by_index, *more, "--resolution", 24, 24) == 0
    (row,) = (tmp_path / "more" / "tasks").glob("*/context.json")
    assert read_run_file(row)["error"] is None


@pytest.mark.parametrize(("broken", "code"), [((0, 1), 1), ((1,), 3)])
def test_cases_that_fail_are_no_success_and_the_first_are_named(
    scenes, tmp_path, monkeypatch, capsys, broken, code
):
    attempt, numbers = runner.attempt, itertools.count()

    def attempt_or_fail(make):
        return "The photograph is damaged." if next(numbers) in broken else attempt(make)

    monkeypatch.setattr(runner, "attempt", attempt_or_fail)
    words = ["evaluate", scenes / "cases.json", "--methods", "context", "--device", "cpu"]
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == code
    said = capsys.readouterr().err
    assert said.count("Failed: ") == len(broken)
    assert "context: The photograph is damaged." in said
    done = 2 - len(broken)
    assert f"Scored {done}, failed {len(broken)}, done earlier 0, of 2 cases by 1 methods." in said
    assert "evaluating case 1 of 2" in said
    # A quiet run says it, too, in one line: nobody should have to guess at an exit code.
    assert run(monkeypatch, *words, "--out", tmp_path / "out", "--quiet") == code
    said = capsys.readouterr().err
    assert said.startswith(f"gscompleter: {len(broken)} of 2 cases failed; the first: ")
    assert said.count("\n") == 1


@pytest.mark.parametrize("more", [("--table", "rotation"), ("--figure", "qualitative"), ()])
def test_what_is_refused_leaves_no_folder(tmp_path, monkeypatch, capsys, more):
    assert run(monkeypatch, "evaluate", tmp_path / "no", "--out", tmp_path / "out", *more) == 2
    assert "is no cases.json" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []


def test_an_index_without_a_case_is_not_written(scenes, tmp_path, monkeypatch, capsys):
    words = ("index", scenes / "box", "--protocol", "stress", "--out", tmp_path / "i.json")
    assert run(monkeypatch, *words) == 2
    assert "chooses no case in the 1 scene(s)" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []


# `test_the_commands_run_end_to_end` has other data, and
# `test_a_broken_case_is_a_row_with_its_reason` a broken case.
@pytest.mark.slow
def test_chunks_run_end_to_end_and_a_broken_image_costs_its_own_cases(
    tmp_path, monkeypatch, capsys
):
    broken = {**example("broken"), "key": "broken"}
    broken["images"][4] = as_tensor(b"no image")
    wide = {**example("wide"), "key": "wide"}
    wide["cameras"][0, 0] = 0.1
    chunk = save_chunk(tmp_path / "data" / "000000.torch", example("whole"), broken, wide)
    out = tmp_path / "out"
    arguments = ["evaluate", chunk.parent, "--protocol", "n-1", "n-2", "--out", out]
    assert run(monkeypatch, *arguments, "--methods", "context", "--device", "cpu") == 3
    errors = " ".join(capsys.readouterr().err.split())
    assert "Skipped wide: frame 0: its opening angle" in errors
    rows = [read_run_file(path) for path in (out / "tasks").glob("*/*.json")]
    reasons = {row["task"]["name"]: row["error"] for row in rows}
    assert len(reasons) == 8
    for name, reason in reasons.items():
        needs = name.startswith("broken") and "4" in name
        assert ("Frame 4 of the scene broken" in reason) if needs else (reason is None)


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--methods", "nope"), "no method 'nope'"),
        (("--shard", "1"), "i/n"),
        (("--shard", "3/2"), "no such shard"),
        (("--protocol", "m-1"), "no protocol 'm-1'"),
        (("--protocol", "m" * 5000), "no protocol 'mmm"),
        (("--protocol", "stress"), "chooses none of its"),
        (("--limit", "0"), "--limit"),
        (("--generator", "dall-e"), "no generator"),
        (("--generator", "warp-inpaint", "painted"), "needs painted images"),
        (("--outlines",), "There is no figure to apply this to"),
        (("--crops", "--table", "rotation"), "There is no figure to apply this to"),
        (("--figure-cases", "box"), "There is no figure to apply this to"),
        (("--table", "rotation", "--methods", "context"), "have methods of their own"),
        (("--preset", "re10k", "--methods", "context"), "have methods of their own"),
        (("--depth-weights", "no.onnx"), "No monocular depth is chosen that could take no.onnx"),
        (("--workers", "2"), "is for --engine local or ray or submitit"),
        (("--gpus", "1", "--engine", "local"), "is for --engine ray or submitit"),
        (("--address", "auto", "--engine", "submitit"), "is for --engine ray;"),
        (("--slurm", "time=1", "--engine", "ray"), "is for --engine submitit;"),
        (("--depth", "none", "moge-2", "--generator", "oracle", "lama"), "one after the other"),
        (("--depth", "none", "moge-2", "--preset", "re10k"), "leave --preset, --table and"),
    ],
)
def test_wrong_options_are_refused(scenes, tmp_path, monkeypatch, capsys, more, sentence):
    out = tmp_path / "out"
    data = scenes / ("box" if "stress" in more else "cases.json")
    assert run(monkeypatch, "evaluate", data, "--out", out, *more) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("option", ["weights", "depth-weights"])
@pytest.mark.parametrize("prefix", ["", "{}="])
def test_weights_in_the_output_are_refused_however_they_are_named(
    tmp_path, monkeypatch, capsys, option, prefix
):
    out = tmp_path / "out"
    out.mkdir()
    (out / "own.ckpt").touch()
    named = prefix.format({"weights": "mvsplat-re10k", "depth-weights": "moge-2"}[option])
    models = ("--reconstructor", "mvsplat-re10k", "--depth", "moge-2")
    given = (f"--{option}", f"{named}{out / 'own.ckpt'}")
    assert run(monkeypatch, "evaluate", tmp_path / "no", "--out", out, *models, *given) == 2
    assert "holds the input" in capsys.readouterr().err


def test_threads_are_limited_before_anything_reads_their_number(tmp_path, monkeypatch):
    """The check of the output imports torch, which reads it once."""
    seen = []
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(
        EvaluateOptions, "check_overlap", lambda self: seen.append(os.environ["OMP_NUM_THREADS"])
    )
    words = ("evaluate", tmp_path / "no", "--threads", 1, "--out", tmp_path / "out")
    assert run(monkeypatch, *words) == 2
    assert seen == ["1"]


def test_scenes_need_a_protocol_and_an_index_is_kept(scenes, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, "evaluate", scenes / "box", "--out", tmp_path / "out") == 2
    assert "--protocol" in capsys.readouterr().err
    file = tmp_path / "mine.json"
    file.write_text("precious")
    assert run(monkeypatch, "index", scenes, "--protocol", "n-1", "--out", file) == 2
    assert file.read_text() == "precious"
    assert run(monkeypatch, "tables", tmp_path) == 2


def test_an_index_is_of_the_scenes_that_a_file_names(scenes, tmp_path, monkeypatch):
    file = tmp_path / "scenes.json"
    file.write_text(json.dumps({"scenes": [str(scenes / "box")], "apart": ["box"]}))
    index = tmp_path / "n-1.json"
    assert run(monkeypatch, "index", file, "--protocol", "n-1", "--out", index) == 0
    assert list(read_evaluation_index(index).scenes) == ["box"]


@pytest.mark.parametrize(
    ("name", "words"),
    [("cases.json", ()), ("scenes.json", ("--protocol", "n-1"))],
)
def test_results_never_lie_in_a_scene_that_a_file_names(
    scenes, tmp_path, monkeypatch, capsys, name, words
):
    box = shutil.copytree(scenes / "box", tmp_path / "box")
    case = {"scene": "box", "context": [0, 1], "target": 2}
    (tmp_path / "scenes.json").write_text('{"scenes": ["box"]}')
    (tmp_path / "cases.json").write_text(json.dumps({"resolution": [24, 24], "cases": [case]}))
    before = sorted(os.listdir(box))
    given = ("evaluate", tmp_path / name, *words, "--methods", "context")
    assert run(monkeypatch, *given, "--out", box / "out") == 2
    assert f"lies in the input {box}" in capsys.readouterr().err
    cameras = (box / "transforms.json").read_bytes()
    index = ("index", tmp_path / "scenes.json", "--protocol", "n-1", "--overwrite")
    for out in (box / "transforms.json", tmp_path / "scenes.json"):
        assert run(monkeypatch, *index, "--out", out) == 2
    assert (box / "transforms.json").read_bytes() == cameras
    assert sorted(os.listdir(box)) == before


@pytest.mark.slow
def test_one_case_per_scene_is_the_first(scenes, tmp_path, monkeypatch, capsys):
    def names(out: Path, *words: object) -> set[str]:
        options = ("--methods", "context", "--device", "cpu", "--quiet", "--out", out)
        assert run(monkeypatch, "evaluate", *words, *options) == 0
        return {read_run_file(path)["task"]["name"] for path in out.glob("tasks/*/context.json")}

    clips = (scenes / "box", scenes / "wide", "--resolution", 24, 24, "--protocol", "n-1")
    assert len(names(tmp_path / "all", *clips)) == 4
    once = names(tmp_path / "once", *clips, "--one-per-scene")
    assert once == {"box 0+1>2", "wide 0+1>2"}
    assert read_run_file(tmp_path / "once" / "run.json")["source"]["one_per_scene"] is True

    content = read_run_file(scenes / "cases.json")
    turned = {**content["cases"][0], "context": [1, 0]}
    content["cases"] = [*content["cases"], turned]
    file = scenes / "three.json"
    file.write_text(json.dumps(content))
    assert len(names(tmp_path / "three", file)) == 3
    assert names(tmp_path / "first", file, "--one-per-scene") == {"box 0+1>2", "wide 0+1>2"}

    options = ("--methods", "context", "--device", "cpu", "--out", tmp_path / "three")
    assert run(monkeypatch, "evaluate", file, *options, "--one-per-scene") == 2
    assert "one_per_scene" in capsys.readouterr().err


@pytest.mark.slow
def test_full_is_what_the_completer_does_by_itself(tasks):
    task = tasks[0]
    views, (target,) = task.load(task.context), task.load(task.targets)
    models = RunConfig().load_models([target])
    state = models.make_completer().begin(views)
    alone = GSCompleter()(views, target.camera)
    predicted = METHODS["full"](state, target.camera, models)
    assert torch.equal(predicted.scene.means, alone.scene.means)
    assert torch.equal(predicted.scene.opacities, alone.scene.opacities)
    reference = synthesize_reference(state, target.camera, models)
    assert torch.equal(reference.image, alone.targets[0].reference.image)


def test_a_task_beyond_the_memory_is_a_row_that_says_so(tasks, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "read_memory_bytes", lambda: 10**8)
    assert evaluate(tasks[:1], ("full",), tmp_path / "out", CONFIG) == RowCounts(0, 1, 0)
    (row,) = (tmp_path / "out" / "tasks").glob("*/full.json")
    assert "of memory, and there are 1 GB; choose a smaller" in read_run_file(row)["error"]
