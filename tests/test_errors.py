"""A sentence quotes what was given, and stays a sentence."""

from pathlib import Path

import pytest

from gscompleter import load_ply, load_splat
from gscompleter.data.chunks import open_chunks
from gscompleter.data.colmap.binary import read_images
from gscompleter.data.point_cloud import read_point_cloud
from gscompleter.data.upright import write_upright
from gscompleter.errors import InputError, quoted
from gscompleter.io.image import read_pixels
from gscompleter.weights.reading import check_kind


def test_a_short_value_is_quoted_as_it_is():
    assert quoted("room/0.png") == "room/0.png"
    assert quoted([1, "a"]) == "[1, 'a']"


def test_a_long_one_keeps_its_two_ends():
    shown = quoted("a" * 60_000 + "b" * 60_000)
    assert len(shown) <= 100
    assert shown.startswith("aaa")
    assert shown.endswith("bbb")
    assert "…" in shown


def test_a_quote_stays_on_its_line_and_shows_no_control_characters():
    assert quoted("a\nb\x1b[31m") == "a b [31m"


def test_integers_that_python_refuses_to_write_are_described():
    assert quoted(10**5000) == "an integer of about 5,000 digits"
    assert quoted([10**5000]) == "a list that cannot be written out"


def test_a_path_has_more_room_and_is_written_plainly():
    assert quoted(Path("a" * 200)) == "a" * 200
    assert len(quoted(Path("a" * 2000))) <= 250


def test_every_reader_tells_a_pointer_of_git_lfs_in_the_same_words(tmp_path):
    pointer = tmp_path / "file.torch"
    pointer.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    readers = (
        load_ply,
        load_splat,
        read_pixels,
        read_point_cloud,
        read_images,
        lambda path: list(open_chunks(path)),
        lambda path: check_kind(path, "a.ckpt"),
        lambda path: write_upright(tmp_path, path.name, tmp_path / "copies"),
    )
    for reader in readers:
        with pytest.raises(InputError) as error:
            reader(pointer)
        assert str(error.value) == (
            f"{pointer} is a git-lfs pointer, not the file itself; run `git lfs pull` in its "
            "repository to fetch it."
        )
