"""The figures of `tests/support/density.py`, on a file that can be counted by hand."""

from density import find_repeated, measure, parse_files

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


def test_a_constant_of_two_modules_is_repeated_and_the_variable_of_a_comprehension_is_not(tmp_path):
    (tmp_path / "a.py").write_text("SIDE: int = 3\nSIZES = [n for n in range(SIDE)]\n")
    (tmp_path / "b.py").write_text("SIDE, _TOP = 4, 5\nDOUBLES = [2 * n for n in range(SIDE)]\n")
    (tmp_path / "c.py").write_text("__all__ = []\n_TOP = 6\n")
    (tmp_path / "d.py").write_text("from a import SIZES\n__all__ = []\n")
    assert find_repeated(parse_files([tmp_path])) == ["SIDE", "_TOP"]


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
