"""The figures of `tests/support/density.py`, on a file that can be counted by hand."""

from density import measure

SOURCE = '''"""A module."""

# One comment.
WIDTH = 3  # no line of its own


def pack(a):
    """Return two values."""
    first, second = a, WIDTH
    height, width = a.shape  # belongs together
    return join(first + second, height + width)


def join(a, b):
    # noqa: X
    # Another comment.
    return a, b


def run():
    return pack(WIDTH)
'''


def test_figures_are_those_that_one_counts(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(SOURCE)
    (tmp_path / "other.py").write_text("def run():\n    return 0\n")
    density = measure([tmp_path])
    assert density.lines == len(SOURCE.splitlines()) + 2
    assert density.comments == 2
    assert density.packed == 1
    # Lines of a comment before the first statement do not count.
    assert density.lengths == [3, 1, 1, 1]
    assert density.one_use == ["pack", "join"]
    assert density.repeated == ["run"]
    assert "repeated 1\n  run" in density.describe()
