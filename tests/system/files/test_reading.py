"""Only regular files are opened, and none is read beyond its limit."""

import os
import socket

import pytest

from gscompleter import InputError, load_splat
from gscompleter.system.files.reading import check_plain, read_bytes, read_head, read_lines
from splat_files import made, plausible


@pytest.fixture
def others(tmp_path):
    """Create a path that is not a regular file, by its kind."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "device").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as bound:
        here = os.getcwd()
        os.chdir(tmp_path)  # the name of a socket has room for 107 characters
        bound.bind("socket")
        os.chdir(here)
        yield {kind: tmp_path / kind for kind in ("pipe", "folder", "device", "socket")}


@pytest.mark.linux
@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "socket"])
def test_what_is_no_file_is_never_opened(others, kind):
    for reader in (read_bytes, lambda path: list(read_lines(path)), load_splat):
        with pytest.raises(InputError, match=f"{kind} is (no regular file|a {kind})"):
            reader(others[kind])
    assert read_head(others[kind], 4) == b""


@pytest.mark.parametrize("name", ["missing", "a\0b", "\ud800", "a" * 300])
def test_a_file_that_cannot_be_there_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="cannot be read"):
        read_bytes(tmp_path / name)


def test_files_and_lines_that_are_too_long_are_refused(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfab\ncdef\n")
    assert list(read_lines(path)) == ["ab\n", "cdef\n"]
    assert list(read_lines(path, max_length=5)) == ["ab\n", "cdef\n"]
    with pytest.raises(InputError, match="a line of more than 4 characters"):
        list(read_lines(path, max_length=4))
    with pytest.raises(InputError, match="has 11 bytes, and at most 10 are read"):
        list(read_lines(path, max_bytes=10))
    with pytest.raises(InputError, match="has 11 bytes, and at most 10 are read"):
        read_bytes(path, 10)


def test_values_are_plain_up_to_a_depth_and_a_number(tmp_path):
    nested: list = []
    for _ in range(63):
        nested = [nested]
    check_plain({"a": [1, (2, 3)], "b": nested}, tmp_path, 100)
    for value in ([[nested]], [[1] * 50] * 2 + [1]):
        with pytest.raises(InputError, match="nested too deeply or without end"):
            check_plain(value, tmp_path, 100)


@pytest.mark.linux
@pytest.mark.parametrize("part", ["meta.json", "means_l.webp"])
@pytest.mark.parametrize("kind", ["pipe", "device", "socket", "folder"])
def test_a_folder_of_sog_opens_files_alone(tmp_path, others, part, kind):
    folder = made(tmp_path, "splat", plausible(40, 1))
    (folder / part).unlink()
    (folder / part).symlink_to(others[kind])
    with pytest.raises(InputError, match="no regular file|is a folder without a splat"):
        load_splat(folder)
