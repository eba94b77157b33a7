"""An output folder is written completely or stays as it was, and keeps what is not ours."""

import contextlib
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gscompleter import InputError
from gscompleter.system.files.output_folder import (
    check_output,
    open_output_folder,
    read_listing,
    reserve_output,
)
from gscompleter.system.files.unfinished import list_unfinished, make_unfinished_name
from gscompleter.system.files.writing import replace_file

SUMMARY = "summary.json"


def tree(folder: Path) -> dict[str, str]:
    """Read every file below `folder` as text, a summary as its entry `text`."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): read_text(path) for path in files}


def read_text(path: Path) -> str:
    return json.loads(path.read_text())["text"] if path.name == SUMMARY else path.read_text()


def write_summary(folder: Path, text: str, files: list[str] | None = None) -> None:
    """Write a summary, with the names that an earlier run has listed."""
    listed = {} if files is None else {"command": "complete", "files": files}
    (folder / SUMMARY).write_text(json.dumps({"text": text, **listed}))


@pytest.fixture
def results(tmp_path) -> Path:
    """Write the results of an earlier run, beside a file of the user's."""
    out = tmp_path / "out"
    (out / "images").mkdir(parents=True)
    for name in ("mine.txt", "completed.ply", "images/old.png"):
        (out / name).write_text("old")
    write_summary(out, "old", ["completed.ply", "images/old.png", SUMMARY])
    return out


def write_results(folder: Path) -> None:
    (folder / "images").mkdir()
    for name in ("completed.ply", "images/new.png"):
        (folder / name).write_text("new")
    write_summary(folder, "new")


def test_overwriting_replaces_our_entries_and_leaves_those_of_the_user(results):
    with open_output_folder(results, overwrite=True) as folder:
        write_results(folder)
    assert tree(results) == {
        "completed.ply": "new",
        "images/new.png": "new",
        "mine.txt": "old",
        "summary.json": "new",
    }
    assert sorted(os.listdir(results)) == ["completed.ply", "images", "mine.txt", "summary.json"]


def test_the_summary_lists_what_the_run_wrote_and_a_folder_without_one_gets_it(tmp_path):
    with open_output_folder(tmp_path / "out", command="complete") as folder:
        write_results(folder)
    summary = json.loads((tmp_path / "out" / SUMMARY).read_text())
    assert summary["files"] == ["completed.ply", "images/new.png", SUMMARY]
    assert (summary["command"], summary["text"]) == ("complete", "new")
    with open_output_folder(tmp_path / "other") as folder:
        (folder / "bench.json").write_text("{}")
    assert read_listing(tmp_path / "other") == {"bench.json", SUMMARY}


def test_what_the_earlier_run_alone_wrote_goes(results):
    """Files of two runs are not mixed, nor are empty folders of the earlier one left."""
    with open_output_folder(results, overwrite=True) as folder:
        (folder / "tables.md").write_text("new")
        write_summary(folder, "new")
    assert sorted(os.listdir(results)) == ["mine.txt", SUMMARY, "tables.md"]


def test_a_file_of_the_user_in_a_folder_of_results_stays_and_is_named(results):
    (results / "images" / "holiday.jpg").write_text("mine")
    (results / "album").mkdir()
    (results / "album" / "a.jpg").write_text("mine")
    with reserve_output(results, overwrite=True) as output, output.write() as folder:
        write_results(folder)
    assert output.others == ["album", "mine.txt", "images/holiday.jpg"]
    (line,) = output.describe_others()
    assert line.startswith("Kept: album, mine.txt, images/holiday.jpg in ")
    assert tree(results) == {
        "album/a.jpg": "mine",
        "completed.ply": "new",
        "images/holiday.jpg": "mine",
        "images/new.png": "new",
        "mine.txt": "old",
        SUMMARY: "new",
    }


@pytest.mark.linux
@pytest.mark.parametrize(
    "make",
    [
        lambda out: (out / "completed.ply").write_text("mine"),
        lambda out: (out / "completed.ply" / "mine").mkdir(parents=True),
        lambda out: os.mkfifo(out / "completed.ply"),
        lambda out: (out / "completed.ply").symlink_to(out.parent / "photographs" / "a.jpg"),
        lambda out: (out / "images").symlink_to(out.parent / "photographs"),
        lambda out: (out / "images").write_text("mine"),
        lambda out: write_summary(out, "mine"),
        lambda out: write_summary(out, "mine", ["completed.ply"]),
    ],
)
def test_what_is_in_the_way_of_a_result_is_refused_before_any_work(tmp_path, make):
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "a.jpg").write_text("mine")
    make(out)
    before = sorted(map(str, tmp_path.rglob("*")))
    with (
        pytest.raises(InputError, match="is in the way of a result"),
        reserve_output(out, True, patterns=("completed.ply", "images/target*.png", SUMMARY)),
    ):
        pytest.fail("it was let in")
    assert sorted(map(str, tmp_path.rglob("*"))) == before


def test_what_gets_in_the_way_during_a_run_is_not_replaced_either(results):
    before = {**tree(results), "images/new.png": "mine"}
    with (
        pytest.raises(InputError, match="images/new.png is in the way"),
        open_output_folder(results, overwrite=True) as folder,
    ):
        write_results(folder)
        (results / "images" / "new.png").write_text("mine")
    assert tree(results) == before


@pytest.mark.parametrize(
    "name", ["../mine.txt", "/etc/passwd", "images/../../mine.txt", "a//b", "", ".", "a\\b"]
)
def test_a_listed_name_cannot_lead_out_of_the_folder(tmp_path, name):
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "mine.txt").write_text("mine")
    write_summary(out, "old", [name, SUMMARY])
    assert read_listing(out) == {SUMMARY}
    with open_output_folder(out, overwrite=True) as folder:
        write_results(folder)
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.linux
def test_a_listed_name_cannot_lead_out_through_a_link(tmp_path):
    out, photographs = tmp_path / "out", tmp_path / "photographs"
    out.mkdir()
    photographs.mkdir()
    (photographs / "old.png").write_text("mine")
    (out / "images").symlink_to(photographs)
    write_summary(out, "old", ["images/old.png", SUMMARY])
    with (
        pytest.raises(InputError, match="images is in the way"),
        open_output_folder(out, overwrite=True) as folder,
    ):
        write_results(folder)
    assert os.listdir(photographs) == ["old.png"]


@pytest.mark.parametrize("content", ["", "[]", "null", '{"files": 3}', "{" * 10_000])
def test_a_damaged_summary_lists_nothing(tmp_path, content):
    (tmp_path / SUMMARY).write_text(content)
    assert read_listing(tmp_path) == frozenset()


@pytest.mark.linux
@pytest.mark.parametrize("exists", [False, True])
def test_a_second_run_is_refused_before_it_begins(tmp_path, results, exists):
    out = results if exists else tmp_path / "new"
    with writing(out) as process:
        with pytest.raises(InputError, match=f"Another run \\(process {process.pid}\\) is writing"):
            check_output(out, overwrite=True)
        stopped(process, signal.SIGKILL)
    check_output(out, overwrite=True)


@pytest.mark.linux
def test_of_two_runs_that_begin_together_one_goes_on(tmp_path):
    code = (
        "import sys, time\n"
        "from gscompleter.system.files.output_folder import open_output_folder\n"
        "from gscompleter import InputError\n"
        "sys.stdin.readline()\n"
        "try:\n"
        "    with open_output_folder(sys.argv[1]) as folder:\n"
        "        (folder / 'a').write_text('new')\n"
        "        print('in', flush=True)\n"
        "        time.sleep(2)\n"
        "except InputError as error:\n"
        "    print(error)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "out")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    pair = [subprocess.Popen(command, text=True, **pipes) for _ in range(2)]
    for process in pair:
        process.stdin.write("\n")
        process.stdin.flush()
    said = sorted(process.communicate()[0].split(" ")[0].strip() for process in pair)
    assert said == ["Another", "in"]
    assert sorted(os.listdir(tmp_path / "out")) == ["a", SUMMARY]


@pytest.mark.linux
def test_what_a_killed_run_left_is_removed_by_the_next_and_that_of_others_is_not(tmp_path):
    """Entries of another machine may be in use until they have given no sign for long."""
    out, other = tmp_path / "out", tmp_path / ".gscompleter-0123"
    other.mkdir()
    with writing(out) as process:
        stopped(process, signal.SIGKILL)
    (left,) = tmp_path.glob(".gscompleter-*-*")
    target, machine, pid, start, _ = left.name.removeprefix(".gscompleter-").split("-")
    reused = left.with_name(f".gscompleter-{target}-{machine}-{os.getpid()}-{start}-00000000")
    quiet = left.with_name(f".gscompleter-{target}-00000000-{pid}-{start}-00000001")
    neighbour = left.with_name(make_unfinished_name("neighbour"))
    for path in (reused, quiet, neighbour):
        path.mkdir()
    with pytest.raises(InputError, match="Another run"):
        check_output(out)  # `quiet` has just been made, as far as one can tell
    os.utime(quiet, (0, 0))
    check_output(out)
    assert sorted(tmp_path.glob(".gscompleter-*")) == sorted([other, neighbour])


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs a list of processes")
def test_a_process_of_another_user_that_has_ended_is_not_running(tmp_path, monkeypatch):
    """It stays listed as a zombie until its parent asks for it, and no signal may be sent to it."""

    def refuse(pid: int, number: int) -> None:
        raise PermissionError

    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
        name = make_unfinished_name("out").replace(f"-{os.getpid()}-", f"-{ended.pid}-")
        (tmp_path / name).mkdir()
        monkeypatch.setattr(os, "kill", refuse)
        (entry,) = list_unfinished(tmp_path)
        assert entry.pid == ended.pid
        assert not entry.is_running()


def test_the_summary_leaves_first_and_arrives_last(results, monkeypatch):
    moved = []
    rename = os.rename
    monkeypatch.setattr(os, "rename", lambda a, b: (moved.append(Path(a)), rename(a, b)))
    with open_output_folder(results, overwrite=True) as folder:
        write_results(folder)
    assert len(moved) == 6
    assert moved[0] == results / "summary.json"
    assert moved[-1].name == "summary.json"


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_whatever_stops_a_run_leaves_the_results_as_they_were(results, stop):
    before = tree(results)
    with pytest.raises(stop), open_output_folder(results, overwrite=True) as folder:
        write_results(folder)
        raise stop
    assert tree(results) == before
    assert len(os.listdir(results)) == 4


@pytest.mark.parametrize("failing", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES])
def test_a_rename_that_fails_takes_all_others_back(results, monkeypatch, failing, code):
    before = tree(results)
    rename, calls = os.rename, []

    def fails_once(a, b):
        calls.append(a)
        if len(calls) == failing:
            raise OSError(code, os.strerror(code))
        rename(a, b)

    monkeypatch.setattr(os, "rename", fails_once)
    with (
        pytest.raises(InputError, match="Cannot write"),
        open_output_folder(results, overwrite=True) as folder,
    ):
        write_results(folder)
    assert tree(results) == before
    assert len(os.listdir(results)) == 4


def test_a_full_disk_is_one_sentence_about_the_folder_asked_for(tmp_path):
    with pytest.raises(InputError) as error, open_output_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert str(error.value).startswith(f"Cannot write {tmp_path / 'out'}: No space left")
    assert os.listdir(tmp_path) == []


def test_the_temporary_name_is_not_told_to_the_user(tmp_path):
    (tmp_path / "out").mkdir()
    with (
        pytest.raises(InputError) as error,
        open_output_folder(tmp_path / "out") as folder,
        replace_file(folder / "missing" / "completed.ply"),
    ):
        pass
    assert str(error.value).startswith(f"Cannot write {tmp_path / 'out'}/missing/completed.ply: ")


def test_checking_leaves_nothing_behind_and_does_not_touch_what_is_there(tmp_path, results):
    before = tree(results)
    check_output(tmp_path / "not" / "there" / "yet")
    check_output(results, overwrite=True)
    assert os.listdir(tmp_path) == ["out"]
    assert tree(results) == before


@pytest.mark.linux
def test_a_folder_that_cannot_take_results_is_refused_before_any_computing(tmp_path, results):
    with pytest.raises(InputError, match="is not empty; .* overwrite"):
        check_output(results)
    with pytest.raises(InputError, match="Cannot write .*mine.txt: Not a directory"):
        check_output(results / "mine.txt", overwrite=True)
    with pytest.raises(InputError, match="deeper: Not a directory"):
        check_output(results / "mine.txt" / "deeper", overwrite=True)
    with pytest.raises(InputError, match="name too long"):
        check_output(tmp_path / ("a" * 300))
    with pytest.raises(InputError, match="Cannot write /proc/"):
        check_output("/proc/gscompleter")


def test_the_working_directory_stays_the_folder_it_is(results, monkeypatch):
    (results / "mine.txt").unlink()
    monkeypatch.chdir(results)
    inode = results.stat().st_ino
    with open_output_folder(".", overwrite=True) as folder:
        write_results(folder)
    assert results.stat().st_ino == inode
    assert read_text(Path(SUMMARY)) == "new"


def test_what_cannot_be_put_back_is_not_thrown_away(results, monkeypatch):
    rename, calls = os.rename, []

    def fails_from_the_fourth_on(a, b):
        calls.append(a)
        if len(calls) >= 4:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        rename(a, b)

    before = tree(results)
    monkeypatch.setattr(os, "rename", fails_from_the_fourth_on)
    with (
        pytest.raises(InputError, match="Cannot write"),
        open_output_folder(results, overwrite=True) as folder,
    ):
        write_results(folder)
    (replaced,) = results.glob(".gscompleter-*")
    assert {**tree(replaced), "mine.txt": (results / "mine.txt").read_text()} == before
    # Nor by the next run, as that of another process finds it.
    monkeypatch.undo()
    left = replaced.with_name(replaced.name.replace(f"-{os.getpid()}-", "-0-"))
    replaced.rename(left)
    with pytest.raises(InputError, match="could not put back"):
        check_output(results, overwrite=True)
    assert {**tree(left), "mine.txt": (results / "mine.txt").read_text()} == before


def test_what_a_killed_run_left_does_not_make_a_folder_occupied(tmp_path):
    left = tmp_path / "out" / make_unfinished_name("out").replace(f"-{os.getpid()}-", "-0-")
    left.mkdir(parents=True)
    with open_output_folder(tmp_path / "out") as folder:
        write_summary(folder, "new")
    assert os.listdir(tmp_path / "out") == [SUMMARY]
    assert read_text(tmp_path / "out" / SUMMARY) == "new"


@pytest.mark.linux
def test_a_linked_folder_stays_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with open_output_folder(tmp_path / "link") as folder:
        write_summary(folder, "new")
    assert (tmp_path / "link").is_symlink()
    assert tree(tmp_path / "real") == {"summary.json": "new"}


WRITES = """
import os, signal, sys, time
from gscompleter.system.files.writing import replace_file
from gscompleter.system.interrupts import handle_stop_signals
from gscompleter.system.files.output_folder import open_output_folder

for number in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_DFL)  # nohup and shells in the background ignore some
signal.signal(signal.SIGINT, signal.default_int_handler)
handle_stop_signals()
out, renames = sys.argv[1], int(sys.argv[2])
rename = os.rename
def waits(a, b):
    global renames
    if renames == 0:
        print("ready", flush=True)
        time.sleep(60)
    renames -= 1
    rename(a, b)
os.rename = waits
with open_output_folder(out, overwrite=True) as folder:
    os.mkdir(folder / "images")
    for name in ("completed.ply", "images/new.png"):
        (folder / name).write_text("new")
    (folder / "summary.json").write_text('{"text": "new"}')
    if renames < 0:
        with replace_file(folder / "scene.ply") as file:
            file.write(b"half"); file.flush(); print("ready", flush=True); time.sleep(60)
"""


@contextlib.contextmanager
def writing(out: Path, renames: int = -1) -> Iterator[subprocess.Popen]:
    """Start a process that writes to `out` and waits, before it publishes or after renames."""
    command = [sys.executable, "-c", WRITES, str(out), str(renames)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
        process.kill()


def stopped(process: subprocess.Popen, number: int) -> None:
    process.send_signal(number)
    process.wait()


@pytest.mark.linux
@pytest.mark.parametrize("exists", [False, True])
def test_a_killed_process_leaves_nothing_under_the_final_names(tmp_path, results, exists):
    out, before = results if exists else tmp_path / "new", tree(results)
    with writing(out) as process:
        stopped(process, signal.SIGKILL)
    (left,) = tmp_path.rglob(".gscompleter-*/images")
    assert left.parent.parent == (out if exists else tmp_path)
    assert out.exists() == exists
    check_output(out, overwrite=True)
    assert tree(tmp_path) == {f"out/{name}": text for name, text in before.items()}


@pytest.mark.linux
@pytest.mark.parametrize("renames", range(6))
def test_a_run_that_is_killed_while_results_are_replaced_is_finished_by_the_next(results, renames):
    """All new files are complete by then, and of the old ones some have made way."""
    with writing(results, renames) as process:
        stopped(process, signal.SIGKILL)
    assert any(results.glob(".gscompleter-*.old"))
    with pytest.raises(InputError, match="not empty"):
        check_output(results)
    check_output(results, overwrite=True)
    assert tree(results) == {
        "completed.ply": "new",
        "images/new.png": "new",
        "mine.txt": "old",
        SUMMARY: "new",
    }


@pytest.mark.linux
@pytest.mark.parametrize("renames", range(6))
def test_so_is_one_that_replaces_the_results_of_a_version_that_listed_no_files(results, renames):
    entries = ["version", "settings", "seed", "device", "scene", "frame", "targets", "seconds"]
    early = {**dict.fromkeys(entries), "gaussians": {"context": 1, "added": 1}, "text": "old"}
    (results / SUMMARY).write_text(json.dumps(early))
    (results / "images" / "old.png").rename(results / "images" / "target1_before.png")
    with writing(results, renames) as process:
        stopped(process, signal.SIGKILL)
    check_output(results, overwrite=True)
    assert tree(results) == {
        "completed.ply": "new",
        "images/new.png": "new",
        "mine.txt": "old",
        SUMMARY: "new",
    }


def keep_session(out: Path) -> None:
    """Write the steps of a session, which no summary lists, to a folder."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    (out / "images" / "stroke1.png").write_text("old")
    (out / "strokes.json").write_text('{"program": "gscompleter", "format": 1}')


def test_the_steps_of_a_session_are_files_of_a_run(results, tmp_path):
    alone = tmp_path / "alone"
    keep_session(results)
    keep_session(alone)
    (results / "images" / "stroke_mine.png").write_text("mine")
    files = {"strokes.json", "images/stroke1.png"}
    assert read_listing(alone) == files
    assert files < read_listing(results)
    assert "images/stroke_mine.png" not in read_listing(results)
    # Those of another program, or elsewhere, are not.
    (alone / "strokes.json").write_text("{}")
    assert read_listing(alone) == frozenset()
    shutil.rmtree(alone)
    keep_session(alone)
    (alone / "images").rename(tmp_path / "images")
    (alone / "images").symlink_to(tmp_path / "images")
    assert read_listing(alone) == {"strokes.json"}


@pytest.mark.linux
@pytest.mark.parametrize("renames", range(8))
def test_a_run_that_replaces_a_session_is_finished_too(results, tmp_path, renames):
    keep_session(results)
    outs = [results]
    if renames < 5:
        outs.append(tmp_path / "alone")
        keep_session(outs[1])
    for out in outs:
        with writing(out, renames) as process:
            stopped(process, signal.SIGKILL)
        check_output(out, overwrite=True)
        others = {"mine.txt": "old"} if out == results else {}
        written = {"completed.ply": "new", "images/new.png": "new", SUMMARY: "new"}
        assert tree(out) == {**written, **others}


@pytest.mark.linux
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_process_that_is_told_to_stop_cleans_up(tmp_path, results, name):
    before = tree(results)
    for out in (results, tmp_path / "new" / "folder"):
        with writing(out) as process:
            stopped(process, getattr(signal, name))
    assert os.listdir(tmp_path) == ["out"]
    assert tree(results) == before


@pytest.mark.linux
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_an_interrupt_while_results_are_replaced_leaves_nothing_behind(results, name):
    code = (
        "import os, shutil, sys\n"
        "from gscompleter.system.interrupts import handle_stop_signals\n"
        "from gscompleter.system.files.output_folder import open_output_folder\n"
        "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_DFL)\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\nhandle_stop_signals()\n"
        "rmtree = shutil.rmtree\n"
        "def stopped(*words, **others):\n"
        "    shutil.rmtree = rmtree\n"
        "    os.kill(os.getpid(), int(sys.argv[2]))\n"
        "    rmtree(*words, **others)\n"
        "shutil.rmtree = stopped\n"
        "try:\n"
        "    with open_output_folder(sys.argv[1], overwrite=True) as folder:\n"
        "        for name in ('completed.ply', 'removed.ply'):\n"
        "            (folder / name).write_text('new')\n"
        "except KeyboardInterrupt as stop:\n    print(stop)\n"
    )
    command = [sys.executable, "-c", code, str(results), str(int(getattr(signal, name)))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == f"{results} is complete", done.stderr
    (results / SUMMARY).unlink()
    assert tree(results) == {"completed.ply": "new", "mine.txt": "old", "removed.ply": "new"}
    assert os.listdir(results.parent) == [results.name]
