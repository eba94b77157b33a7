"""A file is written completely or stays as it was."""

import os
import signal
from enum import IntEnum

import pytest

from gscompleter import InputError
from gscompleter.system.files.writing import defer_interrupts, replace_file


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
