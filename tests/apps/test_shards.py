"""Shards: processes that share one folder of results, and folders that are refused."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from command import run
from gscompleter import InputError
from gscompleter.apps.evaluating import tables as command
from gscompleter.evaluation.cases import read_cases
from gscompleter.evaluation.protocols import Task, make_case_task
from gscompleter.evaluation.runner import (
    RETRIES,
    RowCounts,
    RunConfig,
    TaskRunner,
    collect_settings,
    evaluate,
)
from gscompleter.evaluation.store import RUN_VERSION, claim, list_row_paths, read_run_file
from gscompleter.evaluation.tables import write_tables
from gscompleter.models.settings import PEFieldSettings
from gscompleter.system.jobs.jobs import Job, write_json
from scenes import Room, camera_at, photographed

SIZE = 32
METHOD_NAMES = ("context", "full")
TABLES = ("tables.md", "tables.tex", "tables.json")

CLAIM = """
import json, os, sys
from pathlib import Path
from gscompleter.system.errors import InputError
from gscompleter.evaluation.store import claim

out, count, kinds = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
hold, start = os.pipe()
children = []
for i in range(count):
    child = os.fork()
    if child == 0:
        os.close(start)
        os.read(hold, 1)  # returns for all of them at once
        try:
            claim(out, {"seed": i % kinds})
            os._exit(0)
        except InputError as error:
            os.write(2, f"{error}\\n".encode())
            os._exit(2)
    children.append(child)
os.close(start)
codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
print(json.dumps(codes))
"""
"""Program of processes that claim a folder at the same moment."""


def claimed(out: Path, count: int, kinds: int = 1) -> tuple[list[int], str]:
    """Return exit codes and stderr of `count` claims with `kinds` different settings."""
    words = [sys.executable, "-c", CLAIM, out, count, kinds]
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=True)
    return json.loads(done.stdout), done.stderr


@pytest.mark.slow
@pytest.mark.linux
def test_of_many_simultaneous_claims_none_is_refused(tmp_path):
    out = tmp_path / "out" / "deep"
    codes, refused = claimed(out, 60)
    assert codes == [0] * 60, refused
    assert os.listdir(out) == ["run.json"]
    assert read_run_file(out / "run.json") == {"version": RUN_VERSION, "seed": 0}


@pytest.mark.slow
@pytest.mark.linux
def test_of_simultaneous_claims_with_other_settings_one_kind_wins(tmp_path):
    codes, refused = claimed(tmp_path / "out", 40, kinds=2)
    seed = read_run_file(tmp_path / "out" / "run.json")["seed"]
    assert codes == [0 if i % 2 == seed else 2 for i in range(40)]
    sentence = f"holds a run with seed {seed}, and this run has {1 - seed}; name another folder."
    assert refused.count(sentence) == 20


def test_what_a_killed_process_left_unfinished_is_nobody_elses_content(tmp_path):
    (tmp_path / ".gscompleter-0123456789ab").write_bytes(b"half")
    claim(tmp_path, {"seed": 0})
    assert read_run_file(tmp_path / "run.json")["seed"] == 0


def test_without_hard_links_a_folder_is_claimed_too(tmp_path, monkeypatch):
    def refused(source, target):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    claim(tmp_path / "out", {"seed": 0})
    assert os.listdir(tmp_path / "out") == ["run.json"]


def test_a_file_that_another_process_made_first_stays(tmp_path):
    for content in ("first", "second"):
        write_json(tmp_path / "run.json", content, keep_existing=True)
    assert read_run_file(tmp_path / "run.json") == "first"
    assert os.listdir(tmp_path) == ["run.json"]


def test_a_folder_of_another_version_is_refused(tmp_path):
    (tmp_path / "run.json").write_text(json.dumps({"version": 2, "seed": 0}))
    sentence = "holds a run of version 2, and version 4 is needed; name another folder"
    for use in (lambda: claim(tmp_path, {"seed": 0}), lambda: write_tables(tmp_path)):
        with pytest.raises(InputError, match=sentence):
            use()


def test_a_folder_remembers_what_its_generator_was_told(tmp_path):
    def config(**settings) -> RunConfig:
        return RunConfig(generator="pe-field", generator_settings=PEFieldSettings(**settings))

    claim(tmp_path, collect_settings(config(steps=4)))
    claim(tmp_path, collect_settings(config(steps=4, offload=True)))  # which changes no number
    with pytest.raises(InputError, match="holds a run with generator_steps 4, and this run has 8"):
        claim(tmp_path, collect_settings(config(steps=8)))
    with pytest.raises(InputError, match=r"run with generator_\w+ \d, and this run has None"):
        claim(tmp_path, collect_settings(RunConfig(generator="pe-field")))
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(InputError, match=r"run.json is not JSON .* name another folder"):
        claim(tmp_path, collect_settings(config(steps=4)))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> Path:
    """Write three rooms with three views each."""
    root = tmp_path_factory.mktemp("rooms")
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    names = ("one", "two", "three")
    for far, name in enumerate(names, start=5):
        photographed(root / name, cameras, Room(boxes=(((-4.0, -1.5, -1.0), (4.0, 1.5, far)),)))
    rows = [{"scene": s, "context": [0, 1], "target": 2, "near": 0.5, "far": 20} for s in names]
    (root / "cases.json").write_text(json.dumps({"resolution": [SIZE, SIZE], "cases": rows}))
    return root


@pytest.fixture(scope="module")
def tasks(scenes) -> list[Task]:
    return [make_case_task(case) for case in read_cases(scenes / "cases.json")]


@pytest.fixture(scope="module")
def finished(scenes, tmp_path_factory) -> Path:
    """Return the results of a single process."""
    out = tmp_path_factory.mktemp("alone") / "out"
    words = ("evaluate", scenes / "cases.json", "--out", out, "--methods", *METHOD_NAMES)
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, *words, "--device", "cpu", "--quiet") == 0
    return out


def started(scenes: Path, out: Path, shard: str, *more: str) -> subprocess.Popen:
    code = "from gscompleter.cli import main; main()"
    words = [sys.executable, "-c", code, "evaluate", scenes / "cases.json", "--out", out]
    words += ["--methods", *METHOD_NAMES, "--device", "cpu", "--shard", shard, *more]
    return subprocess.Popen(list(map(str, words)), stdout=subprocess.DEVNULL)


def same_tables(out: Path, other: Path) -> None:
    for name in TABLES:
        assert (out / name).read_bytes() == (other / name).read_bytes(), name


def three_at_once(scenes: Path, out: Path, finished: Path) -> None:
    shards = [started(scenes, out, f"{number}/3") for number in range(3)]
    assert [shard.wait() for shard in shards] == [0, 0, 0]
    same_tables(out, finished)


@pytest.mark.slow
def test_three_shards_at_once_end_with_the_tables_of_one_run(scenes, finished, tmp_path):
    three_at_once(scenes, tmp_path / "out", finished)


@pytest.mark.slow
def test_three_shards_at_once_end_so_ten_times_out_of_ten(scenes, finished, tmp_path):
    for number in range(10):
        three_at_once(scenes, tmp_path / f"out-{number}", finished)


@pytest.mark.slow
def test_rows_that_come_while_tables_are_written_get_into_them(finished, tmp_path, monkeypatch):
    """Another shard ends after the rows are read and before tables are written."""
    out, late = tmp_path / "out", tmp_path / "late.json"
    shutil.copytree(finished, out)
    row = list_row_paths(out)[0]
    row.rename(late)
    written, write = [], command.tables.write_tables

    def write_before(*args):
        summary = write(*args)
        written.append(len(summary.common_tasks))
        if len(written) == 1:
            late.rename(row)
        return summary

    monkeypatch.setattr(command.tables, "write_tables", write_before)
    command.write_and_print_tables(out, quiet=True, num_rows=6)
    assert written == [2, 3]
    same_tables(out, finished)


@pytest.mark.slow
def test_a_shard_leaves_the_last_tables_to_the_others(finished, tmp_path, monkeypatch):
    """While rows are missing, another shard will write the tables after this one."""
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    list_row_paths(out)[0].unlink()
    calls, write = [], command.tables.write_tables

    def write_before(*args):
        calls.append(write(*args))
        list_row_paths(out)[0].touch()
        return calls[-1]

    monkeypatch.setattr(command.tables, "write_tables", write_before)
    command.write_and_print_tables(out, quiet=True, num_rows=6)
    assert len(calls) == 1


@pytest.mark.slow
def test_workers_end_with_the_tables_of_one_run(scenes, finished, tmp_path):
    more = ("--engine", "local", "--workers", "2")
    assert started(scenes, tmp_path / "out", "0/1", *more).wait() == 0
    same_tables(tmp_path / "out", finished)


def test_a_case_whose_workers_were_killed_is_given_up(tasks, tmp_path):
    job = Job("given up", {"task": tasks[0]}, lost=RETRIES + 1)
    TaskRunner(tmp_path, METHOD_NAMES, RunConfig())(job)
    errors = [read_run_file(row)["error"] for row in list_row_paths(tmp_path)]
    assert len(errors) == len(METHOD_NAMES)
    assert all("killed 3 times" in error for error in errors)


@pytest.mark.slow
def test_shards_one_after_the_other_add_up(finished, tasks, tmp_path):
    out = tmp_path / "out"
    for number in (1, 0):
        counts = evaluate(tasks, METHOD_NAMES, out, RunConfig(), (number, 2))
        assert counts == RowCounts(4 if number == 0 else 2, 0, 0)
    write_tables(out)
    same_tables(out, finished)


def test_of_settings_within_settings_the_one_that_differs_is_named(tmp_path):
    claim(tmp_path / "run", {"source": {"paths": ["cases.json"] * 100, "one_per_scene": False}})
    with pytest.raises(
        InputError, match=r"with source\.one_per_scene False, and this run has True"
    ):
        claim(tmp_path / "run", {"source": {"paths": ["cases.json"] * 100, "one_per_scene": True}})
