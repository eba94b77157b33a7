"""Writing is complete or leaves things as they were, whatever stops it."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path

import pytest

from gscompleter import InputError
from gscompleter.io.files import check_output, defer_interrupts, open_output_folder, replace_file


def tree(folder: Path) -> dict[str, str]:
    """Read every file below `folder` as text."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in files}


@pytest.fixture
def results(tmp_path) -> Path:
    """Write the results of an earlier run, beside a file of the user's."""
    out = tmp_path / "out"
    (out / "images").mkdir(parents=True)
    for name in ("mine.txt", "completed.ply", "images/old.png", "summary.json"):
        (out / name).write_text("old")
    return out


def write_results(folder: Path) -> None:
    (folder / "images").mkdir()
    for name in ("completed.ply", "images/new.png", "summary.json"):
        (folder / name).write_text("new")


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


def test_a_completion_does_not_keep_the_removed_gaussians_of_an_earlier_one(results):
    (results / "removed.ply").write_text("old")
    with open_output_folder(results, overwrite=True) as folder:
        (folder / "tables.md").write_text("new")
    assert (results / "removed.ply").read_text() == "old"
    with open_output_folder(results, overwrite=True) as folder:
        write_results(folder)
    assert not (results / "removed.ply").exists()


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
    assert Path("summary.json").read_text() == "new"


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


def test_what_a_killed_run_left_does_not_make_a_folder_occupied(tmp_path):
    (tmp_path / "out" / ".gscompleter-0123").mkdir(parents=True)
    with open_output_folder(tmp_path / "out") as folder:
        (folder / "summary.json").write_text("new")
    assert (tmp_path / "out" / "summary.json").read_text() == "new"


@pytest.mark.linux
def test_a_linked_folder_stays_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with open_output_folder(tmp_path / "link") as folder:
        (folder / "summary.json").write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert tree(tmp_path / "real") == {"summary.json": "new"}


WRITES = """
import os, signal, sys, time
from gscompleter.io.files import handle_stop_signals, open_output_folder, replace_file

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
    for name in ("completed.ply", "images/new.png", "summary.json"):
        (folder / name).write_text("new")
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
    shutil.rmtree(left.parent)
    assert tree(tmp_path) == {f"out/{name}": text for name, text in before.items()}


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
        "from gscompleter.io.files import handle_stop_signals, open_output_folder\n"
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
        "        for name in os.listdir(sys.argv[1]):\n"
        "            if not name.startswith('.'): (folder / name).write_text('new')\n"
        "except KeyboardInterrupt as stop:\n    print(stop)\n"
    )
    command = [sys.executable, "-c", code, str(results), str(int(getattr(signal, name)))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == f"{results} is complete", done.stderr
    assert set(tree(results).values()) == {"new"}
    assert os.listdir(results.parent) == [results.name]


def test_events_that_windows_lists_among_the_signals_are_not_asked_for(monkeypatch):
    monkeypatch.setattr(signal, "Signals", IntEnum("Signals", {"CTRL_C_EVENT": 0, "SIGINT": 2}))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    try:
        with pytest.raises(KeyboardInterrupt, match="is complete"), defer_interrupts("is complete"):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_file_written_in_place_of_another_keeps_it_until_the_end(tmp_path):
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError), replace_file(path) as file:
        file.write(b"half")
        raise RuntimeError
    assert path.read_bytes() == b"old"
    with replace_file(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_a_folder_is_no_place_for_a_file(tmp_path):
    with pytest.raises(InputError, match="Is a directory"), replace_file(tmp_path):
        pass
