"""Writing happens completely or leaves things as they were, whatever stops it."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gscompleter import InputError
from gscompleter.io.files import check_output, output_folder, replacing


def tree(folder: Path) -> dict[str, str]:
    """Every file below `folder` with its text."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in files}


@pytest.fixture
def results(tmp_path) -> Path:
    """The results of an earlier run, beside a file of the user's."""
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
    with output_folder(results, overwrite=True) as folder:
        write_results(folder)
    assert tree(results) == {
        "completed.ply": "new",
        "images/new.png": "new",
        "mine.txt": "old",
        "summary.json": "new",
    }
    assert sorted(os.listdir(results)) == ["completed.ply", "images", "mine.txt", "summary.json"]


def test_the_summary_leaves_first_and_arrives_last(results, monkeypatch):
    moved = []
    rename = os.rename
    monkeypatch.setattr(
        os, "rename", lambda a, b: (moved.append(Path(a).relative_to(results)), rename(a, b))
    )
    with output_folder(results, overwrite=True) as folder:
        write_results(folder)
    assert len(moved) == 6
    assert moved[0] == Path("summary.json")
    assert moved[-1].name == "summary.json"


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_whatever_stops_a_run_leaves_the_results_as_they_were(results, stop):
    before = tree(results)
    with pytest.raises(stop), output_folder(results, overwrite=True) as folder:
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
        output_folder(results, overwrite=True) as folder,
    ):
        write_results(folder)
    assert tree(results) == before
    assert len(os.listdir(results)) == 4


def test_a_full_disk_is_one_sentence_about_the_folder_asked_for(tmp_path):
    with pytest.raises(InputError) as error, output_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert str(error.value).startswith(f"Cannot write {tmp_path / 'out'}: there is no space left")
    assert os.listdir(tmp_path) == []


def test_the_temporary_name_is_not_told_to_the_user(tmp_path):
    (tmp_path / "out").mkdir()
    with (
        pytest.raises(InputError) as error,
        output_folder(tmp_path / "out") as folder,
        replacing(folder / "missing" / "completed.ply"),
    ):
        pass
    assert str(error.value).startswith(f"Cannot write {tmp_path / 'out'}/missing/completed.ply: ")


def test_checking_leaves_nothing_behind_and_does_not_touch_what_is_there(tmp_path, results):
    before = tree(results)
    check_output(tmp_path / "not" / "there" / "yet")
    check_output(results, overwrite=True)
    assert os.listdir(tmp_path) == ["out"]
    assert tree(results) == before


def test_a_folder_that_cannot_take_results_is_refused_before_any_computing(tmp_path, results):
    with pytest.raises(InputError, match="is not empty; .* overwrite"):
        check_output(results)
    with pytest.raises(InputError, match="is a file, and a folder is needed"):
        check_output(results / "mine.txt", overwrite=True)
    with pytest.raises(InputError, match="a part of that path is a file"):
        check_output(results / "mine.txt" / "deeper", overwrite=True)
    with pytest.raises(InputError, match="too long"):
        check_output(tmp_path / ("a" * 300))
    with pytest.raises(InputError, match="Cannot write /proc/"):
        check_output("/proc/gscompleter")


def test_what_a_killed_run_left_does_not_make_a_folder_occupied(tmp_path):
    (tmp_path / "out" / ".gscompleter-0123").mkdir(parents=True)
    with output_folder(tmp_path / "out") as folder:
        (folder / "summary.json").write_text("new")
    assert (tmp_path / "out" / "summary.json").read_text() == "new"


def test_a_linked_folder_stays_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with output_folder(tmp_path / "link") as folder:
        (folder / "summary.json").write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert tree(tmp_path / "real") == {"summary.json": "new"}


def test_a_killed_process_leaves_nothing_under_the_final_names(tmp_path):
    code = (
        "import sys, time\n"
        "from gscompleter.io.files import output_folder, replacing\n"
        "with output_folder(sys.argv[1]) as folder, replacing(folder / 'completed.ply') as file:\n"
        "    file.write(b'half'); file.flush(); print('writing', flush=True); time.sleep(60)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "out")], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == "writing\n"
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.rglob("completed.ply"))
    check_output(tmp_path / "out")


def test_a_file_written_in_place_of_another_keeps_it_until_the_end(tmp_path):
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError), replacing(path) as file:
        file.write(b"half")
        raise RuntimeError
    assert path.read_bytes() == b"old"
    with replacing(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_a_folder_is_no_place_for_a_file(tmp_path):
    with pytest.raises(InputError, match="that is a folder; name a file"), replacing(tmp_path):
        pass
