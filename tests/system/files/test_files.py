"""A file is written completely or stays as it was."""

import errno
import os
import signal
import stat
import struct
import time
from enum import IntEnum
from pathlib import Path

import pytest

from gscompleter import InputError
from gscompleter.system.errors import FullDiskError, OutputError
from gscompleter.system.files import unfinished, writing
from gscompleter.system.files.downloads import get_download_folder
from gscompleter.system.files.output_file import reserve_file
from gscompleter.system.files.output_folder import open_output_folder
from gscompleter.system.files.text import encode_text
from gscompleter.system.files.unfinished import digest_target
from gscompleter.system.files.writing import ACCESS_LIST, replace_file
from gscompleter.system.interrupts import defer_interrupts


def test_events_that_windows_lists_among_the_signals_are_not_asked_for(monkeypatch):
    monkeypatch.setattr(signal, "Signals", IntEnum("Signals", {"CTRL_C_EVENT": 0, "SIGINT": 2}))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    try:
        with pytest.raises(KeyboardInterrupt, match="is complete"), defer_interrupts("is complete"):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_an_interrupt_is_not_lost_where_the_results_cannot_be_renamed():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt, match="^$"), defer_interrupts("is complete"):
            signal.raise_signal(signal.SIGINT)
            raise OSError("no space")
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_user_without_a_home_folder_is_told_where_to_name_one(monkeypatch):
    monkeypatch.setenv("GSCOMPLETER_HOME", "~nobody of this name/downloads")
    with pytest.raises(InputError, match="no home folder .* GSCOMPLETER_HOME"):
        get_download_folder()


def test_a_byte_of_a_name_that_is_no_text_is_one_unknown_character_of_a_page():
    name = os.fsdecode(b"caf\xe9.jpg")
    assert encode_text(name).decode() == "caf\N{REPLACEMENT CHARACTER}.jpg"
    assert encode_text("café \N{GRINNING FACE}").decode() == "café \N{GRINNING FACE}"


def test_space_is_asked_for_only_where_it_is_missing(tmp_path):
    of_a_folder = r"Is a directory; choose another place\.$"
    with pytest.raises(OutputError, match=of_a_folder), replace_file(tmp_path):
        pass
    of_a_full_disk = r"No space left .*; free some space, or choose another place\.$"
    with pytest.raises(FullDiskError, match=of_a_full_disk), replace_file(tmp_path / "scene.ply"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


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
    for folder in (tmp_path, tmp_path.anchor):
        with pytest.raises(InputError, match="Is a directory"), replace_file(folder):
            pass


@pytest.mark.linux
def test_links_that_lead_back_to_themselves_are_told_as_such(tmp_path):
    (tmp_path / "a.ply").symlink_to("b.ply")
    (tmp_path / "b.ply").symlink_to("a.ply")
    with (
        pytest.raises(InputError, match="is a loop of symbolic links"),
        replace_file(tmp_path / "a.ply"),
    ):
        pass
    assert sorted(os.listdir(tmp_path)) == ["a.ply", "b.ply"]


@pytest.mark.linux
def test_a_pipe_and_a_device_are_never_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "null.ply").symlink_to("/dev/null")
    for name in ("pipe.ply", "null.ply"):
        with (
            pytest.raises(InputError, match="a device or a pipe"),
            replace_file(tmp_path / name) as file,
        ):
            file.write(b"new")
    assert sorted(os.listdir(tmp_path)) == ["null.ply", "pipe.ply"]
    assert not os.path.isfile("/dev/null")


# --------------------------------------------------------------------- marks of other runs


def leave_mark(folder: Path, name: str, age: float) -> Path:
    """Leave the mark of a run on another machine, or before a restart, `age` seconds ago."""
    mark = folder / f".gscompleter-{digest_target(name)}-deadbeef-4242-777-0123abcd"
    mark.touch()
    os.utime(mark, (time.time() - age, time.time() - age))
    return mark


@pytest.mark.parametrize("age", [0, 60, -10])
def test_a_file_that_another_machine_is_writing_is_refused_with_the_name_of_its_mark(tmp_path, age):
    mark = leave_mark(tmp_path, "x.sog", age)
    sentence = r"Another run \(process 4242\) is writing .*x.sog; .* if it was killed, delete "
    with pytest.raises(InputError, match=sentence) as error, reserve_file(tmp_path / "x.sog", True):
        pytest.fail("it was let in")
    assert mark.name in str(error.value)
    assert os.listdir(tmp_path) == [mark.name]


@pytest.mark.parametrize("age", [200, 23 * 3600, -60, -10 * 24 * 3600])
def test_a_mark_without_a_sign_for_three_minutes_or_of_the_future_is_left_behind(tmp_path, age):
    """A mark is ahead of the clock once that was set back, and would block the name until then."""
    leave_mark(tmp_path, "x.sog", age)
    with reserve_file(tmp_path / "x.sog", False):
        pass
    assert os.listdir(tmp_path) == []


def test_a_folder_is_free_again_after_a_mark_of_the_future(tmp_path):
    mark = leave_mark(tmp_path, "out", -10 * 24 * 3600)
    with open_output_folder(tmp_path / "out"):
        pass
    assert not mark.exists()


def test_who_writes_a_file_gives_signs(tmp_path, monkeypatch):
    monkeypatch.setattr(unfinished, "SIGN_SECONDS", 0.01)
    with reserve_file(tmp_path / "x.sog", False), replace_file(tmp_path / "x.sog") as file:
        entries = list(tmp_path.iterdir())
        assert len(entries) == 2  # the mark, and the unfinished file
        for entry in entries:
            os.utime(entry, (0, 0))
        deadline = time.monotonic() + 30
        while any(entry.stat().st_mtime < 1 for entry in entries):
            assert time.monotonic() < deadline, "no sign was given"
            time.sleep(0.01)
        file.write(b"new")
    assert os.listdir(tmp_path) == ["x.sog"]


# ----------------------------------------------------------------------------- permissions


@pytest.mark.linux
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, 0o644])
def test_a_file_that_replaces_another_keeps_its_mode_from_the_first_byte_on(tmp_path, mode):
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")
    path.chmod(mode)
    with replace_file(path) as file:
        (temporary,) = tmp_path.glob(".gscompleter-*")
        assert stat.S_IMODE(temporary.stat().st_mode) == mode
        file.write(b"new")
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == mode


@pytest.mark.linux
def test_what_replaces_a_private_file_is_private_when_it_is_made(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")
    path.chmod(0o600)
    modes = []

    def note_mode(old: Path, new: Path) -> None:
        modes.append(stat.S_IMODE(new.stat().st_mode))

    monkeypatch.setattr(writing, "keep_permissions", note_mode)
    with replace_file(path) as file:
        file.write(b"new")
    with replace_file(tmp_path / "new.ply") as file:
        file.write(b"new")
    umask = os.umask(0)
    os.umask(umask)
    assert modes == [0o600, 0o666 & ~umask]


@pytest.mark.linux
def test_a_file_that_replaces_another_keeps_its_owner(tmp_path):
    if os.geteuid() != 0:
        pytest.skip("only root gives files away")
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")
    os.chown(path, 12345, 23456)
    with replace_file(path) as file:
        file.write(b"new")
    assert (path.stat().st_uid, path.stat().st_gid) == (12345, 23456)


@pytest.mark.linux
def test_a_group_that_cannot_be_kept_may_do_no_more_than_everybody(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")
    path.chmod(0o660)
    if os.geteuid() != 0:
        pytest.skip("needs a file of another group")
    os.chown(path, -1, 23456)
    monkeypatch.setattr(os, "chown", refuse)
    with replace_file(path) as file:
        file.write(b"new")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def refuse(*_: object) -> None:
    raise PermissionError(1, "Operation not permitted")


def make_access_list(user: int) -> bytes:
    """Make a list of version 2 by which a user reads, as its owner and group do."""
    nobody = 0xFFFFFFFF
    rights = ((0x01, 6, nobody), (0x02, 4, user), (0x04, 4, nobody), (0x10, 4, nobody))
    rows = (*rights, (0x20, 0, nobody))
    return struct.pack("<I", 2) + b"".join(struct.pack("<HHI", *row) for row in rows)


@pytest.mark.linux
@pytest.mark.parametrize("has_list", [False, True])
def test_users_who_may_read_a_file_are_those_who_could_read_the_one_in_its_place(
    tmp_path, has_list
):
    path = tmp_path / "scene.ply"
    path.write_bytes(b"old")
    path.chmod(0o640)
    try:
        if has_list:
            os.setxattr(path, ACCESS_LIST, make_access_list(12345))
        # The folder lets another user read every new file.
        os.setxattr(tmp_path, "system.posix_acl_default", make_access_list(23456))
    except OSError:
        pytest.skip("the file system has no access lists")
    with replace_file(path) as file:
        file.write(b"new")
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    if has_list:
        assert os.getxattr(path, ACCESS_LIST) == make_access_list(12345)
    else:
        assert ACCESS_LIST not in os.listxattr(path)


@pytest.mark.linux
def test_results_keep_the_modes_of_those_that_they_replace(tmp_path):
    out = tmp_path / "out"
    with open_output_folder(out, command="complete") as folder:
        (folder / "completed.ply").write_text("old")
    (out / "completed.ply").chmod(0o600)
    with open_output_folder(out, overwrite=True, command="complete") as folder:
        (folder / "completed.ply").write_text("new")
    assert (out / "completed.ply").read_text() == "new"
    assert stat.S_IMODE((out / "completed.ply").stat().st_mode) == 0o600
