"""Only regular files are opened, and none is read beyond its limit."""

import os
import random
import socket
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from gscompleter import InputError, load_splat
from gscompleter.system.damage import DamagedError
from gscompleter.system.files.reading import (
    ZIP_ERRORS,
    check_plain,
    is_zip_file,
    read_bytes,
    read_head,
    read_lines,
    read_zip_entry,
)
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
    assert list(read_lines(path, max_length=4)) == ["ab\n", "cdef\n"]
    with pytest.raises(InputError, match="a line of more than 3 characters"):
        list(read_lines(path, max_length=3))
    with pytest.raises(InputError, match="has 11 bytes, and at most 10 are read"):
        list(read_lines(path, max_bytes=10))
    with pytest.raises(InputError, match="has 11 bytes, and at most 10 are read"):
        read_bytes(path, 10)


def test_values_are_plain_up_to_a_depth_and_a_number(tmp_path):
    nested: list = []
    for _ in range(30):
        nested = [nested]
    # numpy 1 makes arrays of up to 32 dimensions.
    assert np.array([nested]).ndim == 32
    check_plain({"a": [1, (2, 3)], "b": nested}, tmp_path, 100)
    check_plain([nested], tmp_path, 100)
    for value in ([[nested]], [[1] * 50] * 2 + [1]):
        with pytest.raises(InputError, match="nested too deeply or without end"):
            check_plain(value, tmp_path, 100)


@pytest.mark.linux
def test_a_file_that_states_no_size_is_read_up_to_the_limit():
    path = Path("/proc/self/maps")
    assert path.stat().st_size == 0
    assert len(read_bytes(path)) > 100
    for reader in (read_bytes, lambda path, most: list(read_lines(path, max_bytes=most))):
        with pytest.raises(InputError, match="and at most 10 are read"):
            reader(path, 10)


@pytest.mark.linux
@pytest.mark.parametrize("part", ["meta.json", "means_l.webp"])
@pytest.mark.parametrize("kind", ["pipe", "device", "socket", "folder"])
def test_a_folder_of_sog_opens_files_alone(tmp_path, others, part, kind):
    (tmp_path / "splats").mkdir()
    folder = made(tmp_path / "splats", "folder", plausible(40, 1))
    (folder / part).unlink()
    (folder / part).symlink_to(others[kind])
    with pytest.raises(InputError, match="no regular file|is a folder without a splat"):
        load_splat(folder)


# ---- archives -----------------------------------------------------------------------------------


def write_bomb(path: Path, method: int, stated: int) -> None:
    """Write an archive whose only file has 100 MB of zeros, and states another size."""
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("a", bytes(100_000_000))
    content = bytearray(path.read_bytes())
    directory = content.rindex(b"PK\x01\x02")
    struct.pack_into("<I", content, directory + 24, stated)
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("method", "stated", "sentence"),
    [
        (zipfile.ZIP_DEFLATED, 100_000_000, "its a is too large: .* claim to hold 100,000,000"),
        (zipfile.ZIP_DEFLATED, 100, "Bad CRC-32"),
        (zipfile.ZIP_LZMA, 100, "another method than deflate"),
        (zipfile.ZIP_BZIP2, 100, "another method than deflate"),
    ],
)
def test_a_file_in_an_archive_is_unpacked_to_no_more_than_it_may_have(
    tmp_path, method, stated, sentence
):
    write_bomb(tmp_path / "a.zip", method, stated)
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        tracemalloc.start()
        with pytest.raises((ValueError, zipfile.BadZipFile), match=sentence):
            read_zip_entry(archive, "a", 10_000)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert most < 2**20


def test_an_encrypted_file_in_an_archive_is_refused_in_a_clause(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("a", b"abc")
    content = bytearray((tmp_path / "a.zip").read_bytes())
    # The first flag, in the header of the file and in the directory.
    content[6] |= 1
    content[content.rindex(b"PK\x01\x02") + 8] |= 1
    (tmp_path / "a.zip").write_bytes(content)
    with (
        zipfile.ZipFile(tmp_path / "a.zip") as archive,
        pytest.raises(DamagedError, match="its a is encrypted"),
    ):
        read_zip_entry(archive, "a", 100)


def test_a_damaged_archive_raises_errors_of_archives_alone(tmp_path):
    """Sizes that are too large end in `EOFError`, headers of newer programs in others."""
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", b"abc" * 50)
    whole = path.read_bytes()
    chance = random.Random(0)
    kinds = set()
    for _ in range(400):
        content = bytearray(whole)
        for place in chance.choices(range(len(content)), k=chance.choice((1, 2))):
            content[place] = chance.randrange(256)
        path.write_bytes(content)
        try:
            with zipfile.ZipFile(path) as archive:
                read_zip_entry(archive, "a", 10_000)
        except ZIP_ERRORS as error:
            kinds.add(type(error))
        is_zip_file(path)
    assert kinds >= {EOFError, KeyError, DamagedError, zipfile.BadZipFile, zlib.error}


def test_an_archive_of_several_disks_is_no_complete_one(tmp_path):
    """Python raises an error of its own for the end of an archive that names other disks."""
    locator = b"PK\x06\x07" + struct.pack("<IQI", 1, 0, 2)
    (tmp_path / "a.pt").write_bytes(locator + b"PK\x05\x06" + bytes(18))
    with pytest.raises(zipfile.BadZipFile):
        zipfile.is_zipfile(tmp_path / "a.pt")
    assert not is_zip_file(tmp_path / "a.pt")


def test_files_in_archives_are_read_whole(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", b"abc" * 5000)
        archive.writestr("none", b"")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert read_zip_entry(archive, "a", 15_000) == b"abc" * 5000
        assert read_zip_entry(archive, "none", 0) == b""
