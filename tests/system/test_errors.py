"""Quotes of the input in sentences."""

import ast
from pathlib import Path

import pytest

from gscompleter import load_ply, load_splat
from gscompleter.apps.command_line.words import format_error
from gscompleter.data.colmap import read_images
from gscompleter.data.points import read_point_cloud
from gscompleter.data.real_estate import open_chunks
from gscompleter.data.sfm.poses import write_upright
from gscompleter.models.weights.reading import check_kind
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image import read_pixels
from sources import list_nodes, parse_package


def test_a_short_value_is_quoted_as_it_is():
    assert quote_value("room/0.png") == "room/0.png"
    assert quote_value([1, "a"]) == "[1, 'a']"


def test_a_long_one_keeps_its_two_ends():
    shown = quote_value("a" * 60_000 + "b" * 60_000)
    assert len(shown) <= 60
    assert shown.startswith("aaa")
    assert shown.endswith("bbb")
    assert "…" in shown


def test_a_quote_stays_on_its_line_and_shows_no_control_characters():
    assert quote_value("a\nb\x1b[31m") == "a b [31m"


def test_errors_quote_the_paths_that_they_name():
    """A name of a file may hold line breaks, and be longer than the sentence about it."""
    bare = []
    for file in parse_package():
        for call in list_nodes(file):
            is_call = isinstance(call, ast.Call)
            if is_call and getattr(call.func, "id", "") in ("InputError", "require"):
                shown = [part for part in ast.walk(call) if isinstance(part, ast.FormattedValue)]
                words = {ast.unparse(part.value) for part in shown}
                bare += [f"{file}:{call.lineno}"] * bool(words & {"path", "folder", "file", "out"})
    # This one is quoted where it is assigned.
    assert [place for place in bare if "evaluation/apart.py" not in place] == []


def test_lists_are_quoted_without_walking_all_of_them():
    endless: list = []
    endless += [endless] * 100
    wide: list = [0] * 10
    for _ in range(40):
        wide = [wide] * 10
    for value in (endless, wide, {"a": wide}, [["x" * 10**6] * 10**4] * 10**4):
        assert len(quote_value(value)) <= 60


@pytest.mark.parametrize(
    "message",
    [
        "a" * 10**6,
        "a b " * 10**5,
        "\n".join(["line"] * 500),
        f"{'/folder' * 300}/a.png is none; write {'/other' * 300}/b.png again.",
        f"There are {' '.join(map(str, range(500)))}; name others.",
    ],
    ids=["word", "words", "lines", "paths", "numbers"],
)
@pytest.mark.parametrize("argument", [None, "context", "x" * 1000])
def test_whatever_an_error_is_made_of_it_is_one_line(message, argument):
    error = InputError(message, argument)
    shown = f"gscompleter: {format_error(error)}"
    assert 150 < len(shown) <= 300
    assert "\n" not in shown


@pytest.mark.parametrize(
    ("sentence", "shown"),
    [
        ("Leave it out.", "Leave it out (--large-masks)."),
        ("There are none; leave --large-masks out.", "There are none; leave --large-masks out."),
        ("--large-masks-too is another.", "--large-masks-too is another (--large-masks)."),
    ],
)
def test_an_option_is_named_once(sentence, shown):
    assert format_error(InputError(sentence, "large_masks")) == shown


def test_what_matters_of_a_long_error_is_kept():
    error = InputError(f"{'/folder' * 60}/a.png is not an image; copy it again.")
    assert str(error).startswith("/folder")
    assert str(error).endswith("/a.png is not an image; copy it again.")


def test_names_are_summarized():
    assert join_names(["a", "bb\nb", "c"], 2) == "a, bb b and 1 more"
    assert join_names([], 2) == ""


def test_a_path_has_more_room_and_is_written_plainly():
    assert quote_value(Path("a" * 200)) == "a" * 200
    assert len(quote_value(Path("a" * 2000))) <= 250


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
