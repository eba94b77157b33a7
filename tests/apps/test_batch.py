"""Batches: jobs run once even if processes are killed, and a page with all of them."""

import errno
import json
import multiprocessing
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from batch_jobs import Writing, engine_named, open_here, plain_jobs, run_all
from command import run
from gscompleter import InputError
from gscompleter.apps.batch import engine as batch_engine
from gscompleter.apps.batch.manifest import list_results, read_manifest
from gscompleter.apps.commands.batch_rows import parse_batch_row
from gscompleter.apps.report.page import render_batch_page
from gscompleter.system.errors import FullDiskError, OutputError, WorkerError
from gscompleter.system.files.writing import replace_file
from gscompleter.system.jobs import engines
from gscompleter.system.jobs import jobs as batch
from gscompleter.system.jobs.engines import connect_to_ray, open_ray, open_submitit
from gscompleter.system.jobs.jobs import (
    Job,
    Pool,
    WorkerShare,
    find_missing_jobs,
    parse_shard,
    run_job,
    run_jobs,
)
from paths import SUPPORT
from scenes import camera_at, photographed
from simulate_batch import Fleet, Replay, replay

TESTS = SUPPORT
SAME = ("completed.ply", "context.ply", "generated.ply", "targets.json")
"""Entries that do not depend on process or time; images/ do not either."""


def until(condition, seconds: float = 120.0) -> None:
    """Wait for a condition, and fail if it does not hold in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "what was waited for never came"
        time.sleep(0.02)


def row_of(out: Path, name: str) -> dict:
    """Read the row of a job."""
    return json.loads((out / "rows" / f"{name}.json").read_text())


def lines(folder: Path) -> dict[str, list[str]]:
    """Read the lines of all files in a folder, by name."""
    return {path.name: path.read_text().split() for path in sorted(folder.glob("*"))}


def started(engine: str, out: Path, count: int, seconds: float, workers: int) -> subprocess.Popen:
    words = [sys.executable, TESTS / "batch_jobs.py", engine, out, count, seconds, workers]
    path = os.pathsep.join(p for p in sys.path if p)
    return subprocess.Popen(list(map(str, words)), env={**os.environ, "PYTHONPATH": path})


def killed_and_started_again(engine: str, out: Path, count: int, seconds: float) -> None:
    """Kill a worker during a job, then the driver, and start it again."""
    driver = started(engine, out, count, seconds, 2)
    until(lambda: len(lines(out / "ended")) >= count // 4)
    until(lambda: set(lines(out / "begun")) - set(lines(out / "ended")))
    going = set(lines(out / "begun")) - set(lines(out / "ended"))
    victims = [lines(out / "begun")[name][-1] for name in sorted(going)]
    os.kill(int(victims[0]), signal.SIGKILL)
    until(lambda: len(lines(out / "ended")) >= count // 2)
    driver.kill()
    driver.wait()
    until(lambda: not any(map(is_alive, lines(out / "begun").values())))
    recorded = {path.stem for path in (out / "rows").glob("*.json")}
    assert recorded
    assert started(engine, out, count, seconds, 2).wait() == 0
    ended = lines(out / "ended")
    assert sorted(ended) == [job.name for job in plain_jobs(count, seconds)]
    # Only a job that was killed between its end and its row runs again.
    assert [name for name in recorded if len(ended[name]) > 1] == []
    assert len(list((out / "rows").glob("*.json"))) == count
    assert max(len(pids) for pids in lines(out / "begun").values()) > 1  # a worker was killed


def is_alive(pids: list[str]) -> bool:
    """Return True if the last process that began a job still exists."""
    status = Path(f"/proc/{pids[-1]}/status")
    try:
        return "State:\tZ" not in status.read_text()
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.linux
def test_what_is_killed_goes_on_and_every_job_is_done_once(tmp_path):
    killed_and_started_again("local", tmp_path, 8, 0.4)


@pytest.mark.linux
@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_of_two_hundred_jobs_each_is_done_once_whatever_is_killed(engine, tmp_path):
    if engine == "ray":
        pytest.importorskip("ray", reason="needs gscompleter[ray]")
    killed_and_started_again(engine, tmp_path, 200, 0.2)


def test_a_job_ends_as_a_row_with_its_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "RETRY_SECONDS", 0.0)
    ends = ("sentence", "defect", "defect once", None)
    jobs = [Job(str(end), {"ends": end}) for end in ends]
    perform = Writing(tmp_path, retries=2)
    for job in jobs:
        perform(job)
    rows = {job.name: row_of(tmp_path, job.name) for job in jobs}
    states = {name: (row["state"], row["reason"], row["attempts"]) for name, row in rows.items()}
    assert states == {
        "sentence": ("failed", "The scene is broken; mend it.", 1),
        "defect": ("failed", "KeyError: 'a defect'", 3),
        "defect once": ("done", None, 2),
        "None": ("done", None, 1),
    }


def test_a_job_that_kills_its_worker_is_given_up_and_the_others_are_done(tmp_path):
    jobs = [Job("bad", {"ends": "always killed"}), Job("shy", {"ends": "killed once"}), Job("good")]
    assert sorted(run_all(tmp_path, jobs, engine_named("local", 1), retries=1)) == [
        "bad",
        "good",
        "shy",
    ]
    found = {job.name: row_of(tmp_path, job.name) for job in jobs}
    assert [found[name]["state"] for name in ("bad", "shy", "good")] == ["failed", "done", "done"]
    assert "killed 2 times" in found["bad"]["reason"]
    assert len(lines(tmp_path / "begun")["bad"]) == 2


@dataclass(frozen=True)
class Full:
    """Runs a job on a full disk."""

    def __call__(self, job: Job) -> None:
        raise OutputError("Cannot write it: there is no space left.")


# `test_a_full_disk_ends_the_run_and_loses_nothing` has the error in this process.
@pytest.mark.slow
def test_an_error_of_a_worker_ends_the_run(tmp_path):
    with pytest.raises(OutputError, match="no space left"):
        list(run_jobs([Job("one")], Full(), lambda job: False, engine_named("local", 1)))


@dataclass(frozen=True)
class Deadly:
    """Kills its process with every job, even a given-up one."""

    def __call__(self, job: Job) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.linux
def test_workers_that_cannot_even_list_a_failure_end_the_run_with_a_sentence():
    with pytest.raises(WorkerError, match="Processes of the engine cannot start, or end at once"):
        list(run_jobs([Job("one")], Deadly(), lambda job: False, engine_named("local", 1)))


def test_workers_that_cannot_start_are_a_sentence_and_no_fault_of_the_input(
    tmp_path, monkeypatch, capsys
):
    @contextmanager
    def open_broken(workers: int) -> Iterator[Pool]:
        def start(share: WorkerShare) -> Future[Exception | None]:
            future: Future[Exception | None] = Future()
            future.set_exception(BrokenProcessPool("A process was terminated abruptly"))
            return future

        yield Pool(workers, start)

    monkeypatch.setattr(batch_engine, "open_local", open_broken)
    (tmp_path / "m.csv").write_text("folder\nroom\n")
    assert run(monkeypatch, "batch", tmp_path / "m.csv", "--out", tmp_path / "out", "--quiet") == 1
    errors = capsys.readouterr().err
    assert "cannot start, or end at once (BrokenProcessPool: A process was terminated" in errors
    assert errors.count("\n") == 1


@pytest.mark.linux
def test_an_interrupt_stops_the_workers_and_leaves_nothing_unfinished(tmp_path):
    driver = started("local", tmp_path, 4, 60.0, 2)
    until(lambda: len([*filter(None, lines(tmp_path / "begun").values())]) == 2)
    driver.send_signal(signal.SIGINT)
    assert driver.wait(timeout=30) != 0
    assert not any(map(is_alive, lines(tmp_path / "begun").values()))
    assert os.listdir(tmp_path) == ["begun"]


def test_shards_add_up_and_each_job_is_done_once(tmp_path):
    jobs = plain_jobs(5, 0.0)
    for number in (1, 0):
        run_all(tmp_path, jobs[number::2], None)
    assert {name: len(pids) for name, pids in lines(tmp_path / "ended").items()} == {
        job.name: 1 for job in jobs
    }
    assert find_missing_jobs(jobs, tmp_path, False) == []


def test_a_disk_that_fails_for_a_moment_is_written_again(tmp_path, monkeypatch):
    monkeypatch.setattr("gscompleter.system.jobs.jobs.RETRY_SECONDS", 0.0)
    failures = [OSError(errno.EIO, "Input/output error")] * 2
    sync = os.fsync

    def fail_at_first(file: int) -> None:
        if failures:
            raise failures.pop()
        sync(file)

    # The first write is that of the work, and the second that of the row.
    monkeypatch.setattr(os, "fsync", fail_at_first)
    calls = []

    def write() -> dict[str, int]:
        calls.append(len(failures))
        if len(calls) == 1:
            with replace_file(tmp_path / "result") as file:
                file.write(b"content")
        return {"size": 7}

    run_job(Job("one"), tmp_path, write, retries=1)
    assert calls == [2, 1]
    assert row_of(tmp_path, "one")["attempts"] == 2
    failures += [OSError(errno.EIO, "Input/output error")] * 3
    with pytest.raises(OutputError, match="Input/output error"):
        run_job(Job("two"), tmp_path, lambda: {"size": 7}, retries=1)
    assert not (tmp_path / "rows" / "two.json").exists()


def test_a_full_disk_ends_the_run_and_loses_nothing(tmp_path, monkeypatch):
    run_job(Job("first"), tmp_path, lambda: {"size": 1}, retries=2)

    def full() -> dict[str, int]:
        raise FullDiskError("Cannot write it: there is no space left.")

    with pytest.raises(OutputError, match="no space left"):
        run_job(Job("second"), tmp_path, full, retries=2)
    assert [
        job.name for job in find_missing_jobs([Job("first"), Job("second")], tmp_path, False)
    ] == ["second"]
    run_job(Job("second"), tmp_path, lambda: {"size": 1}, retries=2)
    assert row_of(tmp_path, "second")["state"] == "done"


def test_done_with_other_options_is_refused_and_failed_is_done_again(tmp_path):
    perform = Writing(tmp_path)
    perform(Job("good"))
    perform(Job("bad", {"ends": "sentence"}))
    with pytest.raises(InputError, match="job good done with other options"):
        find_missing_jobs([Job("good", {"seconds": 1})], tmp_path, False)
    assert find_missing_jobs([Job("bad", {"ends": "sentence"})], tmp_path, False) == []
    assert len(find_missing_jobs([Job("bad", {"ends": "sentence"})], tmp_path, True)) == 1
    perform(Job("bad", {"ends": "sentence"}))
    mended = Job("bad", {})
    assert find_missing_jobs([mended], tmp_path, False) == [mended]
    perform(mended)
    assert row_of(tmp_path, "bad")["state"] == "done"


@pytest.mark.parametrize(
    ("text", "array", "shard"),
    [
        (None, {}, (0, 1)),
        ("1/3", {}, (1, 3)),
        ("auto", {"ID": "7", "MIN": "4", "COUNT": "5"}, (3, 5)),
    ],
)
def test_a_shard_is_told_or_found_in_an_array(text, array, shard):
    environment = {f"SLURM_ARRAY_TASK_{name}": value for name, value in array.items()}
    assert parse_shard(text, environment) == shard


def test_an_array_that_is_none_is_a_sentence():
    with pytest.raises(InputError, match="SLURM_ARRAY_TASK_ID and .*_COUNT are not set to a num"):
        parse_shard("auto", {})
    array = {"SLURM_ARRAY_TASK_ID": "2", "SLURM_ARRAY_TASK_COUNT": "3"}
    with pytest.raises(InputError, match="^SLURM_ARRAY_TASK_MIN is not set to a number"):
        parse_shard("auto", array)


@pytest.mark.parametrize("text", ["{}", "[]", "null", '"a"', '{"state": "done"}'])
def test_a_row_of_other_content_is_a_sentence(tmp_path, text):
    (tmp_path / "rows").mkdir()
    (tmp_path / "rows" / "one.json").write_text(text)
    with pytest.raises(InputError, match=r"one\.json is no row of a job; delete it and run again"):
        find_missing_jobs([Job("one")], tmp_path, rerun_failed=False)


def test_a_single_loss_is_told_as_one(tmp_path):
    run_job(Job("one", lost=1), tmp_path, dict, retries=0)
    assert row_of(tmp_path, "one")["reason"].startswith("its process was killed once, perhaps")


def test_manifests_of_all_kinds_name_the_same_jobs(tmp_path):
    for name in ("one", "two scenes"):
        (tmp_path / "scenes" / name).mkdir(parents=True)
    (tmp_path / "m.csv").write_text(
        "folder,target,video,config.holes.max_alpha\nscenes/one,4 6,yes,0.4\nscenes/two scenes,,,\n"
    )
    (tmp_path / "m.jsonl").write_text(
        '{"folder": "scenes/one", "target": [4, 6], "video": true, "config": {"holes": '
        '{"max_alpha": 0.4}}}\n{"folder": "scenes/two scenes"}\n'
    )
    by_csv = read_manifest(tmp_path / "m.csv", {})
    by_json = read_manifest(tmp_path / "m.jsonl", {})
    by_folder = read_manifest(tmp_path / "scenes", {})
    for jobs in (by_csv, by_json, by_folder):
        assert [job.name for job in jobs] == ["one", "two-scenes"]
    options = [
        [parse_batch_row(j.options, tmp_path / "o") for j in jobs] for jobs in (by_csv, by_json)
    ]
    assert options[0] == options[1]
    assert options[0][0].target == ("4", "6")
    assert options[0][0].video
    assert options[0][0].config.changes == {"holes": {"max_alpha": 0.4}}
    assert options[0][1] == parse_batch_row(by_folder[1].options, tmp_path / "o")


def test_all_that_a_row_names_lies_beside_its_manifest(tmp_path):
    """Also what may be a word: weights, and functions of the user's own."""
    (tmp_path / "weights").mkdir()
    row = {
        "folder": "room",
        "reconstructor": "own.py:reconstruct",
        "depth": "moge-2",
        "generator": "own.py:paint",
        "generator_weights": "weights",
        "generator_depth": "user/depth",
    }
    (tmp_path / "m.jsonl").write_text(json.dumps(row))
    (job,) = read_manifest(tmp_path / "m.jsonl", {})
    assert job.options == {
        "folder": str(tmp_path / "room"),
        "reconstructor": str(tmp_path / "own.py:reconstruct"),
        "depth": "moge-2",
        "generator": str(tmp_path / "own.py:paint"),
        "generator_weights": str(tmp_path / "weights"),
        "generator_depth": "user/depth",
    }


def test_options_have_one_name_in_both_spellings(tmp_path):
    manifest = tmp_path / "m.csv"
    manifest.write_text("folder,depth-weights\nroom,depth.pth\n")
    (job,) = read_manifest(manifest, {"depth-weights": "other.pth"})
    assert job.options == {
        "folder": str(tmp_path / "room"),
        "depth_weights": str(tmp_path / "depth.pth"),
    }
    manifest.write_text("folder,no-masks,no_masks\nroom,no,yes\n")
    with pytest.raises(InputError, match="no_masks in two spellings"):
        read_manifest(manifest, {})


def test_nested_settings_add_to_those_of_all_rows(tmp_path):
    manifest = tmp_path / "m.jsonl"
    manifest.write_text('{"folder": "room", "config": {"holes": {"dilation": 5}}}')
    (job,) = read_manifest(manifest, {"config": "paper", "config.holes.dilation": "3"})
    options = parse_batch_row(job.options, tmp_path / "out")
    assert options.config.name == "paper"
    assert options.config.changes == {"holes": {"dilation": 5}}
    row = {"folder": "room", "config": {"margin": 0.1}, "config.margin": 0.2}
    manifest.write_text(json.dumps(row))
    with pytest.raises(InputError, match=r"config\.margin in two spellings"):
        read_manifest(manifest, {})
    manifest.write_text('{"folder": "room", "config": {"holes": {"candidate_radius": null}}}')
    with pytest.raises(InputError, match=r"null at config\.holes\.candidate_radius"):
        read_manifest(manifest, {})


@pytest.mark.parametrize("ending", ["jsonl", "csv"])
@pytest.mark.parametrize(
    ("column", "words", "paths"),
    [
        ("target", ["one.json", "4"], [0]),
        ("target", ["two cameras.json"], [0]),
        ("target", ["photo.jpg", "5"], []),
        ("config.guards", ["psnr", "own.py:Guard"], [1]),
    ],
)
def test_each_of_several_words_that_is_a_file_lies_beside_the_manifest(
    column, words, paths, ending, tmp_path
):
    for name in ("one.json", "two cameras.json", "photo.jpg", "own.py"):
        (tmp_path / name).touch()
    manifest = tmp_path / f"m.{ending}"
    if ending == "csv":
        manifest.write_text(f"folder,{column}\nroom,{shlex.join(words)}\n")
    else:
        manifest.write_text(json.dumps({"folder": "room", column: words}))
    (job,) = read_manifest(manifest, {})
    expected = [str(tmp_path / w) if n in paths else w for n, w in enumerate(words)]
    assert job.options[column] == expected


def test_nothing_of_a_manifest_is_lost(tmp_path):
    """Spaces after commas, empty cells beyond the header, and line breaks of Unicode in JSON."""
    (tmp_path / "m.CSV").write_text("folder, target ,\nroom, 4 ,,,\n")
    (job,) = read_manifest(tmp_path / "m.CSV", {})
    assert job.options == {"folder": str(tmp_path / "room"), "target": ["4"]}
    row = {"folder": "a\u2028room", "name": None}
    (tmp_path / "m.jsonl").write_text(json.dumps(row, ensure_ascii=False), encoding="utf-8")
    (job,) = read_manifest(tmp_path / "m.jsonl", {})
    assert job == Job("a-room", {"folder": str(tmp_path / "a\u2028room")})


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("m.csv", "folder,seed,seed\nroom,1,2\n", "it has the column seed twice"),
        ("m.jsonl", '\n{"folder": "room", "seed": 1, "seed": 2}', "line 2 has seed twice"),
    ],
)
def test_an_option_that_is_there_twice_is_refused(name, text, sentence, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_manifest(tmp_path / name, {})


def test_a_cell_names_a_mask_for_each_target(tmp_path):
    (tmp_path / "one mask.png").touch()
    manifest = tmp_path / "m.csv"
    for cell, names in {
        "a.png b.png": ["a.png", "b.png"],
        "one mask.png": ["one mask.png"],
        "'one mask.png' b.png": ["one mask.png", "b.png"],
        "it's.png": ["it's.png"],
    }.items():
        manifest.write_text(f"folder,mask\nroom,{cell}\n")
        (job,) = read_manifest(manifest, {})
        assert job.options["mask"] == [str(tmp_path / name) for name in names]


def test_cells_set_what_stands_in_groups_of_options(tmp_path):
    """Flags of a generator, and settings that are true or false or have several values."""
    row = {
        "folder": "room",
        "generator_offload": "true",
        "config.ego_mask": "yes",
        "config.add_observed": "no",
        "config.guards": "psnr free-space",
    }
    options = parse_batch_row(row, tmp_path / "out")
    assert options.synthesis.generator_offload
    assert options.config.changes == {
        "ego_mask": True,
        "add_observed": False,
        "guards": ("psnr", "free-space"),
    }
    assert not parse_batch_row(
        {**row, "generator_offload": 0}, tmp_path
    ).synthesis.generator_offload


@pytest.mark.parametrize(
    ("option", "example"), [("--slurm", "partition=gpu"), ("--each", "resolution=256")]
)
def test_a_word_that_is_no_pair_is_refused_with_an_example(
    option, example, tmp_path, monkeypatch, capsys
):
    words = ("batch", tmp_path, "--out", tmp_path / "out", "--engine", "submitit", option, "cpu")
    assert run(monkeypatch, *words) == 2
    assert f"'cpu' is not NAME=VALUE, as in {example} ({option})" in capsys.readouterr().err


def test_rows_of_one_scene_need_names(tmp_path):
    manifest = tmp_path / "m.jsonl"
    rows = [{"folder": "room"}, {"folder": "room", "seed": 1, "name": "a/b"}]
    manifest.write_text("\n".join(map(json.dumps, rows)))
    assert [j.name for j in read_manifest(manifest, {})] == ["room", "a-b"]
    manifest.write_text("\n".join(map(json.dumps, [{"folder": "room"}, {"folder": "room"}])))
    with pytest.raises(InputError, match="Two jobs have the name room"):
        read_manifest(manifest, {})


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ({"targt": 2}, "options: --targt"),
        ({"resolution": "wide"}, "resolution"),
        ({"out": "elsewhere"}, "cannot set 'out'"),
        ({"video": "perhaps"}, "must be true or false"),
        ({"format": "--overwrite"}, "begins with a dash"),
        ({"seed": -1}, "seed must be greater than or equal to 0"),
        ({"folder": None}, "no folder"),
        ({"help": True}, "all rows of a batch are alike"),
        ({"target": "it's.jpg"}, "target is 'it's.jpg', which has an unmatched"),
        ({"config.ego_mask": "perhaps"}, "config.ego-mask is perhaps"),
    ],
)
def test_a_wrong_row_is_a_sentence(row, sentence, tmp_path):
    with pytest.raises(InputError, match=sentence):
        parse_batch_row({"folder": "room", **row}, tmp_path / "out")


def test_a_path_that_is_no_text_fails_its_row_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(batch_engine, "open_local", open_here)
    rows = [{"folder": ["a"], "name": "one"}, {"folder": "a", "scene": ["b"], "name": "two"}]
    (tmp_path / "m.jsonl").write_text("\n".join(map(json.dumps, rows)))
    assert run(monkeypatch, "batch", tmp_path / "m.jsonl", "--out", tmp_path / "out") == 1
    said = capsys.readouterr().err
    assert "Failed: one: The row has no folder" in said
    assert "Done 0, failed 2" in said


@pytest.fixture(scope="module")
def manifest(tmp_path_factory) -> Path:
    """Write a manifest with two rooms, a missing folder, and a wrong option."""
    root = tmp_path_factory.mktemp("rooms")
    for number in range(2):
        places = ((-0.3 + 0.1 * number, 0), (0.1, 0), (0.7, 12))
        photographed(root / f"room-{number}", [camera_at(x, yaw=yaw, size=48) for x, yaw in places])
    common = {"context": [0, 1], "target": [2], "near": 0.5, "far": 20, "resolution": 48}
    rows = [{"folder": f"room-{number}", **common} for number in range(2)]
    rows += [{"folder": "nowhere", **common}, {"folder": "room-0", "name": "typo", "targt": 2}]
    (root / "m.jsonl").write_text("\n".join(map(json.dumps, rows)))
    return root / "m.jsonl"


def same_results(out: Path, other: Path, name: str) -> None:
    one, two = out / "jobs" / name, other / name
    files = [*SAME, *(f"images/{p.name}" for p in (one / "images").iterdir())]
    for file in files:
        assert (one / file).read_bytes() == (two / file).read_bytes(), file


# `test_json.py` runs a batch with a broken scene; `test_requests.py` compares a row with its
# command line.
@pytest.mark.slow
def test_a_batch_does_what_complete_does_and_tells_of_what_is_broken(
    manifest, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    words = ("batch", manifest, "--out", out, "--workers", 1, "--threads", 1, "--quiet")
    assert run(monkeypatch, *words) == 3
    alone = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20, "--resolution", 48)
    room = manifest.parent / "room-1"
    words_alone = ("complete", room, *alone, "--out", tmp_path / "room-1", "--quiet")
    assert run(monkeypatch, *words_alone) == 0
    same_results(out, tmp_path, "room-1")
    rows = {p.stem: json.loads(p.read_text()) for p in (out / "rows").iterdir()}
    assert {n: r["state"] for n, r in rows.items()} == {
        "room-0": "done",
        "room-1": "done",
        "nowhere": "failed",
        "typo": "failed",
    }
    assert "There is no " in rows["nowhere"]["reason"]
    assert "--targt" in rows["typo"]["reason"]
    assert rows["room-0"]["psnr_after"] > rows["room-0"]["psnr_before"]
    for cost in ("seconds", "cpu_seconds", "result_bytes"):
        assert rows["room-0"][cost] > 0
    table = (out / "table.csv").read_text().splitlines()
    assert len(table) == 5
    page = (out / "index.html").read_text()
    assert 'href="jobs/room-0/report.html"' in page
    assert (out / "jobs" / "room-0" / "report.html").is_file()
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.ply")}
    capsys.readouterr()
    assert run(monkeypatch, *words[:-1]) == 3
    errors = capsys.readouterr().err
    assert "Failed: nowhere: There is no " in errors
    assert "Done 0, failed 0, done earlier 4, 2 of them failed (--rerun failures repeats" in errors
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*.ply")} == before


@pytest.mark.slow
def test_every_scene_failing_is_no_success_and_the_first_are_named(tmp_path, monkeypatch, capsys):
    """A script sees it by the exit code, and a person the reasons."""
    for number in range(7):
        (tmp_path / "scenes" / f"empty-{number}").mkdir(parents=True)
    out = tmp_path / "scenes" / "out"
    words = ("batch", tmp_path / "scenes", "--out", out, "--workers", 1, "--threads", 1)
    assert run(monkeypatch, *words) == 1
    errors = capsys.readouterr().err
    assert errors.count("Failed: empty-") == 5
    assert "... and 2 more failed." in errors
    assert "Done 0, failed 7, done earlier 0." in errors
    assert run(monkeypatch, *words) == 1  # the output folder is no scene now, either
    errors = capsys.readouterr().err
    assert "Left out, as results and no scenes: out." in errors
    assert "Done 0, failed 0, done earlier 7, 7 of them failed" in errors


def test_results_in_a_folder_of_scenes_are_no_scenes(tmp_path):
    scenes, out = tmp_path / "scenes", tmp_path / "scenes" / "out"
    for name, files in {
        "room": {},
        "colmap": {"summary.json": {"command": "poses", "files": ["summary.json"]}},
        "completed": {"summary.json": {"command": "complete", "files": ["summary.json"]}},
        "theirs": {"summary.json": {"command": "complete"}},
        "earlier": {"batch.json": {}},
        "scores": {"run.json": {}},
        "out": {},
    }.items():
        (scenes / name).mkdir(parents=True)
        for file, content in files.items():
            (scenes / name / file).write_text(json.dumps(content))
    assert [job.name for job in read_manifest(scenes, {}, out)] == ["colmap", "room", "theirs"]
    assert [p.name for p in list_results(scenes, out)] == ["completed", "earlier", "out", "scores"]


def test_the_results_of_a_batch_never_lie_in_a_scene(tmp_path, monkeypatch, capsys):
    room = tmp_path / "room"
    room.mkdir()
    (tmp_path / "m.csv").write_text("folder\nroom\n")
    for out in (room, room / "out", tmp_path):
        assert run(monkeypatch, "batch", tmp_path / "m.csv", "--out", out, "--quiet") == 2
        assert "the input" in capsys.readouterr().err
    assert sorted(os.listdir(tmp_path)) == ["m.csv", "room"]


def test_without_shared_memory_nothing_is_begun(tmp_path, monkeypatch, capsys):
    def refuse(*_: object) -> None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))

    (tmp_path / "m.csv").write_text("folder\nroom\n")
    monkeypatch.setattr(multiprocessing.context.SpawnContext, "Lock", refuse)
    assert run(monkeypatch, "batch", tmp_path / "m.csv", "--out", tmp_path / "out", "--quiet") == 2
    assert "shared memory in /dev/shm" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["m.csv"]


def test_a_folder_of_something_else_is_refused(tmp_path, manifest, monkeypatch, capsys):
    (tmp_path / "mine").write_text("")
    assert run(monkeypatch, "batch", manifest, "--out", tmp_path, "--quiet") == 2
    assert "holds something other than a batch" in capsys.readouterr().err
    assert os.listdir(tmp_path) == ["mine"]


@pytest.mark.slow
def test_ray_does_what_is_told_and_tells_of_lost_workers(tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="needs gscompleter[ray]")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
    # Ray would import from the working folder.
    (tmp_path / "photographs").mkdir()
    for name in ("numpy", "json"):
        (tmp_path / "photographs" / f"{name}.py").write_text(
            f"open({str(tmp_path / 'ran')!r}, 'w')"
        )
    monkeypatch.chdir(tmp_path / "photographs")
    jobs = [Job("bad", {"ends": "always killed"}), *plain_jobs(3, 0.0)]
    names = run_all(tmp_path, jobs, engine_named("ray", 1), 0)
    assert not (tmp_path / "ran").exists()
    found = {name: row_of(tmp_path, name)["state"] for name in names}
    assert found == {"bad": "failed", "job-000": "done", "job-001": "done", "job-002": "done"}


@pytest.mark.slow
def test_slurm_gives_no_part_of_a_gpu(tmp_path):
    with (
        pytest.raises(InputError, match="whole GPUs, and 0.5 was asked for"),
        open_submitit(1, 1, 0.5, tmp_path, {}),
    ):
        pass


@pytest.mark.parametrize("error", [ConnectionError, Exception])
@pytest.mark.parametrize(
    ("address", "sentence", "option"),
    [
        (None, "Ray cannot start on this machine", "engine"),
        ("far:1", "Ray at far:1", "address"),
    ],
)
def test_ray_that_does_not_answer_is_a_sentence(address, sentence, option, error):
    class Ray:
        @staticmethod
        def init(**options):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            raise error("no answer")

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(InputError, match=f"{sentence}: no answer") as raised:
        connect_to_ray(Ray, address, 1)
    assert raised.value.argument == option
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(
    ("threads", "gpus", "sentence"),
    [(64, 0.0, "CPU cores .*: 2, too few .* 64"), (1, 0.5, "GPUs .*: 0, too few .* 0.5")],
)
def test_ray_refuses_workers_that_this_machine_cannot_hold(threads, gpus, sentence, monkeypatch):
    """Its tasks would wait without end, and without a word."""
    ended = []
    task = SimpleNamespace(options=lambda **_: None)
    ray = SimpleNamespace(
        init=lambda **_: None,
        remote=lambda _: task,
        cluster_resources=lambda: {"CPU": 2.0},
        shutdown=lambda: ended.append(True),
    )
    monkeypatch.setattr(engines, "import_engine", lambda *_: ray)
    with pytest.raises(InputError, match=sentence) as raised, open_ray(None, threads, gpus):
        pass
    assert raised.value.argument == ("threads" if threads > 1 else "gpus")
    assert ended == [True]
    with open_ray(None, threads, gpus, "far:1") as pool:  # it may get further machines
        assert pool.size == (1 if threads > 1 else 2)


class RefusedError(RuntimeError):
    """A job that SLURM did not take."""


def stand_in_submitit(cluster: str) -> SimpleNamespace:
    """Make a submitit whose SLURM takes no job."""

    def submit(task):
        raise RefusedError("sbatch: error: invalid partition specified: gpux")

    executor = SimpleNamespace(
        cluster=cluster, submit=submit, update_parameters=lambda **parameters: None
    )
    errors = SimpleNamespace(utils=SimpleNamespace(FailedJobError=RefusedError))
    return SimpleNamespace(AutoExecutor=lambda folder: executor, core=errors)


def test_a_job_that_slurm_refuses_is_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "import_engine", lambda *_: stand_in_submitit("slurm"))
    with (
        open_submitit(1, 1, 0.0, tmp_path, {"partition": "gpux"}) as pool,
        pytest.raises(InputError, match="SLURM took no job: .* invalid partition"),
    ):
        pool.start(lambda: None)


def test_parameters_of_slurm_are_not_dropped_where_there_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(engines, "import_engine", lambda *_: stand_in_submitit("local"))
    with (
        pytest.raises(InputError, match="SLURM, which this machine does not have") as raised,
        open_submitit(1, 1, 0.0, tmp_path, {"partition": "gpu"}),
    ):
        pass
    assert raised.value.argument == "slurm"


def test_submitit_does_the_shares_and_a_lost_one_is_done_again(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason="needs gscompleter[slurm]")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
    jobs = [Job("shy", {"ends": "killed once"}), *plain_jobs(4, 0.0)]
    engine = partial(open_submitit, 2, 1, 0.0, tmp_path / "submitit", {})
    names = run_all(tmp_path, jobs, engine, retries=1)
    found = {name: row_of(tmp_path, name)["state"] for name in names}
    assert found == dict.fromkeys((job.name for job in jobs), "done")
    assert {name: len(pids) for name, pids in lines(tmp_path / "ended").items()} == {
        job.name: 1 for job in jobs
    }


def test_a_simulation_counts_what_it_replays():
    found = replay([1.0] * 10, Fleet(workers=2, start_seconds=3.0, lost_per_hour=0.0))
    assert found == Replay(hours=8.0 / 3600, busy=10 / 16, repeated=0, given_up=0)
    hard = replay([3600.0] * 50, Fleet(4, 0.0, lost_per_hour=1.0, retries=2))
    assert hard.repeated > 20
    assert hard.given_up > 0
    assert hard.busy < 0.8


@pytest.fixture
def broken_scenes(tmp_path) -> Path:
    """Return scenes whose photographs are missing, damaged, and of both kinds."""
    scenes = tmp_path / "scenes"
    for name, missing, damaged in (
        ("gone", (0, 1, 2), ()),
        ("cut", (), (0, 1, 2)),
        ("both", (0,), (1, 2)),
    ):
        folder = photographed(scenes / name, [camera_at(x, size=32) for x in (-0.2, 0.0, 0.2)])
        for number in missing:
            (folder / f"{number}.png").unlink()
        for number in damaged:
            (folder / f"{number}.png").write_bytes(b"no image")
    return scenes


def test_a_job_says_what_is_wrong_with_its_photographs_and_each_is_counted(
    broken_scenes, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(batch_engine, "open_local", open_here)
    out = tmp_path / "out"
    assert run(monkeypatch, "batch", broken_scenes, "--out", out) == 1
    reasons = {p.stem: json.loads(p.read_text())["reason"] for p in (out / "rows").iterdir()}
    of_all = "None of the 3 photographs of the context can be used: "
    assert reasons["gone"].startswith(f"{of_all}3 are missing (0.png); copy")
    assert reasons["cut"].startswith(f"{of_all}3 cannot be read (The image ")
    assert reasons["both"].startswith(f"{of_all}1 is missing (0.png) and 2 cannot be read (The ")
    lines = capsys.readouterr().err.splitlines()
    counted = [line for line in lines if " of 3: " in line]
    assert [line.split(":")[0] for line in counted] == [f"{n} of 3" for n in (1, 2, 3)]
    assert all(line.endswith(", failed") for line in counted)


def test_the_page_of_a_batch_leads_with_outcomes_and_not_with_seconds(tmp_path):
    """Rows of an earlier version have no outcomes and no unused photographs."""
    scores = {"targets": 1, "hole_fraction": 0.1, "coverage_before": 0.8, "coverage_after": 0.9}
    cost = {"attempts": 1, "seconds": 43.27, "cpu_seconds": 50.0, "added": 5}
    done = {"state": "done", **scores, **cost, "psnr_before": None, "psnr_after": None}
    rows = [
        {**done, "job": "old"},
        {
            **done,
            "job": "room",
            "outcome": "completed",
            "headline": "The scene is completed; it gained.",
            "unused_before": 20.0,
            "unused_after": 23.0,
        },
        {**done, "job": "wall", "outcome": "nothing-gained", "headline": "Nothing was gained."},
        {"job": "gone", "state": "failed", "reason": "3 are missing."},
    ]
    page = render_batch_page(tmp_path, rows)
    header = page[page.index("<header>") : page.index("</header>")]
    facts = re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", header)
    assert facts == [
        ("completed", "2"),
        ("nothing gained", "1"),
        ("failed", "1"),
        ("median gain at unused photographs", "3.0 dB"),
    ]
    assert "The scene is completed; it gained." in page
    assert "20.0 → 23.0" in page
    assert "43.27" not in page
    assert "A job that is done took 43 s (median)" in page
