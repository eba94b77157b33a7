"""A sentence quotes what was given, and stays a sentence."""

from pathlib import Path

from gscompleter.errors import quoted


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
