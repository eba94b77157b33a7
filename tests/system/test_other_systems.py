"""What differs on macOS and Windows, as far as it can be simulated here.

Windows renames no file that is open, has no fork and no /proc, names devices, and drops dots; macOS
splits letters with accents; both ignore case.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from command import run
from gscompleter import InputError, load_camera, load_views
from gscompleter.apps.batch.manifest import make_job_name, read_manifest
from gscompleter.apps.viewer.http import HTML, PageHandler, PageServer
from gscompleter.evaluation.store import make_file_name
from gscompleter.system.files import renaming, unfinished
from gscompleter.system.files.names import fold_name, make_valid_name
from gscompleter.system.files.output_folder import open_output_folder
from gscompleter.system.files.writing import replace_file
from gscompleter.system.interrupts import defer_interrupts, handle_stop_signals
from gscompleter.system.jobs.engines import open_local
from scenes import camera_at, photographed

# -------------------------------------------------------------------------------- open files


def list_open() -> list[str]:
    """List the files that this process holds open or maps, by the names that they have now."""
    held = [
        os.readlink(f"/proc/self/fd/{number}")
        for number in os.listdir("/proc/self/fd")
        if os.path.lexists(f"/proc/self/fd/{number}")
    ]
    maps = Path("/proc/self/maps").read_text("utf-8").splitlines()
    return [*held, *(line.split(maxsplit=5)[5] for line in maps if line.count("/"))]


@pytest.fixture
def windows(monkeypatch):
    """Refuse to rename what is open or mapped, and folders with such files, as Windows does."""
    moved = []

    def refusing(move):
        def checked(source, destination):
            for place in (source, destination):
                real = os.path.realpath(place)
                blocked = [n for n in list_open() if n == real or n.startswith(f"{real}{os.sep}")]
                if blocked:
                    raise PermissionError(13, f"open: {blocked[0]}", str(place))
            moved.append(Path(destination).name)
            move(source, destination)

        return checked

    for name in ("rename", "replace"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name)))
    return moved


@pytest.mark.linux
def test_the_simulation_refuses_what_is_open(windows, tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 5000)
    with (tmp_path / "a").open("rb"), pytest.raises(PermissionError):
        os.rename(tmp_path / "a", tmp_path / "b")
    mapped = np.memmap(tmp_path / "a", np.uint8, "r")
    with pytest.raises(PermissionError):
        os.rename(tmp_path, tmp_path.with_name("c"))
    del mapped
    os.rename(tmp_path / "a", tmp_path / "b")


@pytest.mark.linux
def test_no_file_is_open_when_it_gets_its_name(windows, completed_room, tmp_path, monkeypatch):
    again = ("--overwrite", "--quiet")
    splat = shutil.copy(completed_room / "completed.ply", tmp_path / "splat.ply")
    for name in ("a.ply", "b.spz", "c.sog", "d.glb", "e.compressed.ply", "a.ply"):
        assert run(monkeypatch, "convert", splat, tmp_path / name, *again) == 0
    assert run(monkeypatch, "strip", splat, "--out", tmp_path / "s.ply", *again) == 0
    assert {"a.ply", "s.ply"} <= set(windows)


# The folders of results are those of `OutputFolder`, as in `test_output_folder.py`.
@pytest.mark.slow
@pytest.mark.linux
def test_no_result_is_open_when_it_gets_its_name(
    windows, room, completed_room, tmp_path, monkeypatch
):
    """Also where a result replaces the file that it was made of."""
    out = tmp_path / "out"
    shutil.copytree(completed_room, out)
    again = ("--overwrite", "--quiet")
    words = ("clean", "--scene", out / "context.ply", "--out", tmp_path / "clean")
    assert run(monkeypatch, *words, *again) == 0
    words = ("clean", "--scene", tmp_path / "clean" / "completed.ply", "--out", tmp_path / "clean")
    assert run(monkeypatch, *words, *again) == 0
    frames = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20, "--resolution", 32)
    words = ("complete", room, "--scene", out / "context.ply", *frames, "--out", out)
    assert run(monkeypatch, *words, *again) == 0
    assert {"completed.ply", "summary.json"} <= set(windows)


def test_renames_wait_for_programs_that_hold_a_new_file_for_a_moment(tmp_path, monkeypatch):
    """A scanner for viruses, say; elsewhere than on Windows a refusal is final."""
    rename, calls = os.replace, []

    def busy_at_first(source, destination):
        calls.append(source)
        if len(calls) < 4:
            raise PermissionError(13, "The process cannot access the file")
        rename(source, destination)

    monkeypatch.setattr(os, "replace", busy_at_first)
    monkeypatch.setattr(renaming, "PAUSES", (0.0,) * 6)
    monkeypatch.setattr(renaming, "REFUSES_OPEN_FILES", True)
    with replace_file(tmp_path / "a") as file:
        file.write(b"content")
    assert (tmp_path / "a").read_bytes() == b"content"
    assert len(calls) == 4
    monkeypatch.setattr(renaming, "REFUSES_OPEN_FILES", False)
    calls.clear()
    with pytest.raises(InputError, match="Cannot write"), replace_file(tmp_path / "b") as file:
        file.write(b"content")
    assert len(calls) == 1
    assert os.listdir(tmp_path) == ["a"]


def test_a_file_that_stays_open_is_one_sentence_and_nothing_is_lost(tmp_path, monkeypatch):
    monkeypatch.setattr(renaming, "PAUSES", (0.0,) * 3)
    monkeypatch.setattr(renaming, "REFUSES_OPEN_FILES", True)
    with open_output_folder(tmp_path / "out") as folder:
        (folder / "summary.json").write_text("{}")

    def refuse(source, destination):
        raise PermissionError(13, "The process cannot access the file")

    monkeypatch.setattr(os, "rename", refuse)
    with (
        pytest.raises(InputError, match="Cannot write"),
        open_output_folder(tmp_path / "out", overwrite=True) as folder,
    ):
        (folder / "summary.json").write_text("{}")
    assert os.listdir(tmp_path / "out") == ["summary.json"]


# ------------------------------------------------------------------------------------- names


@pytest.mark.parametrize("name", ["con", "NUL", "Com1", "lpt9", "aux.ply", "prn.json"])
def test_no_file_is_named_as_a_device(name):
    for make in (make_valid_name, make_file_name, lambda text: make_job_name({"name": text})):
        assert make(name) == f"_{name}"
    assert make_valid_name(f"{name[:2]}y") == f"{name[:2]}y"


@pytest.mark.parametrize("name", ['a<b>:"|?*c', "a/b\\c", "trailing.", "trailing ... ", "tab\tx"])
def test_no_name_has_what_windows_forbids(name):
    made = make_valid_name(name)
    assert not set(made) & set('<>:"/\\|?*\t')
    assert not made.endswith((".", " "))


def test_two_jobs_whose_names_differ_in_case_are_refused(tmp_path):
    """They would share a folder where case does not count."""
    manifest = tmp_path / "scenes.csv"
    manifest.write_text("folder,name\na,Room\nb,room\n", encoding="utf-8")
    with pytest.raises(InputError, match="Two jobs have the name Room"):
        read_manifest(manifest, {})


@pytest.mark.parametrize("written", ["NFC", "NFD"])
def test_photographs_whose_accents_macos_stored_otherwise_are_found(tmp_path, written):
    scene = photographed(tmp_path / "room", [camera_at(x, size=32) for x in (0.0, 0.2)])
    stored = unicodedata.normalize({"NFC": "NFD", "NFD": "NFC"}[written], "Küche é.png")
    named = unicodedata.normalize(written, "Küche é.png")
    assert stored != named
    assert fold_name(stored) == fold_name(named)
    os.rename(scene / "1.png", scene / stored)
    table = (scene / "transforms.json").read_text(encoding="utf-8").replace("1.png", named)
    (scene / "transforms.json").write_text(table, encoding="utf-8")
    assert len(load_views(scene)) == 2
    assert load_camera(scene, frame=1).width == 32


@pytest.mark.parametrize("word", ["küche é.png", "KÜCHE é"])
def test_a_photograph_is_named_with_accents_of_either_kind(tmp_path, word):
    from gscompleter.data.formats import open_photographs

    scene = photographed(tmp_path / "room", [camera_at(x, size=32) for x in (0.0, 0.2)])
    stored = unicodedata.normalize("NFD", "Küche é.png")
    os.rename(scene / "1.png", scene / stored)
    table = (scene / "transforms.json").read_text(encoding="utf-8").replace("1.png", stored)
    (scene / "transforms.json").write_text(table, encoding="utf-8")
    assert open_photographs(scene).find_frame(unicodedata.normalize("NFC", word)) == 1


# -------------------------------------------------------------------- processes and signals


@pytest.fixture
def no_proc(monkeypatch):
    """Hide /proc, and refuse to send a signal: on Windows the signal 0 ends a process."""

    def refuse(pid, number):
        raise AssertionError("a signal was sent")

    monkeypatch.setattr(unfinished, "_read_start", lambda pid: None)
    monkeypatch.setattr(os, "kill", refuse)


def test_without_proc_a_folder_of_another_run_is_told_by_its_age(no_proc, tmp_path):
    mine = tmp_path / unfinished.make_unfinished_name("out")
    mine.mkdir()
    (entry,) = unfinished.list_unfinished(tmp_path)
    assert entry.is_running()
    old = unfinished.LEASE_SECONDS + 60
    status = mine.stat()
    os.utime(mine, (status.st_atime - old, status.st_mtime - old))
    assert not entry.is_running()
    unfinished.remove_left_behind(tmp_path)
    assert os.listdir(tmp_path) == []


def test_signals_that_windows_lacks_are_not_asked_for(monkeypatch):
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    monkeypatch.delattr(signal, "SIGHUP", raising=False)
    try:
        handle_stop_signals()
        with pytest.raises(KeyboardInterrupt, match="done"), defer_interrupts("done"):
            signal.raise_signal(signal.SIGTERM)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# `test_children.py` starts workers, which are spawned everywhere.
@pytest.mark.slow
def test_workers_begin_without_fork(monkeypatch):
    """Spawned processes import the program anew, as on Windows and macOS."""
    for name in ("fork", "forkpty", "register_at_fork"):
        monkeypatch.delattr(os, name, raising=False)
    with open_local(1) as pool:
        assert pool.start(run_nothing).result(timeout=120) is None


def run_nothing() -> None:
    """Do nothing in another process."""


def test_two_servers_do_not_share_a_port(monkeypatch):
    """On Windows the option that this class inherits would let them."""

    class Handler(PageHandler):
        def do_GET(self) -> None:
            self.send_content(b"", HTML)

    assert PageServer.allow_reuse_address == (os.name == "posix")
    with PageServer(("127.0.0.1", 0), Handler) as first, pytest.raises(OSError, match="in use"):
        PageServer(("127.0.0.1", first.server_address[1]), Handler)


# ------------------------------------------------------------------------------------ locale


# `test_systems.py` finds texts in the encoding of the system, and `test_doors.py` has names of
# bytes.
@pytest.mark.slow
@pytest.mark.linux
@pytest.mark.parametrize("language", ["C", "POSIX"])
def test_names_beyond_ascii_are_read_and_written_in_a_plain_locale(
    tmp_path, language, completed_room
):
    """Neither the names of files nor the output may need the encoding of the system."""
    folder = tmp_path / "Räume ☃"
    folder.mkdir()
    shutil.copy(completed_room / "context.ply", folder / "Küche.ply")
    code = "import sys; from gscompleter.cli import run; sys.argv[0] = 'gscompleter'; run()"
    plain = {"LC_ALL": language, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    words = ("convert", str(folder / "Küche.ply"), str(folder / "Küche.spz"))
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        check=False,
        env={**os.environ, **plain},
    )
    assert done.returncode == 0, done.stderr
    assert (folder / "Küche.spz").is_file()
    assert b"Gaussians" in done.stdout
