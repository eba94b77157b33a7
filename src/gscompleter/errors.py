"""What the user is told when the input is wrong."""

import os
from contextlib import suppress
from pathlib import Path

LONGEST_QUOTE = 100
"""Characters of the input that a sentence quotes at most."""
LONGEST_PATH = 250
"""The same of a path, which one may want to copy."""

POINTER = b"version https://git-lfs"
"""How a pointer of git-lfs begins."""


class InputError(ValueError):
    """The input is wrong, and the user can mend it.

    Its message is one sentence: what was given, what is needed, what to do. The command
    line prints it without a traceback and exits with code 2.
    """

    def __init__(self, message: str, argument: str | None = None) -> None:
        """The `argument` of the function, or the name of the setting, that the user can mend. The
        command line names its option of that name."""
        super().__init__(message)
        self.argument = argument


class OutputError(InputError):
    """A result cannot be written: nothing else could be written there either."""


def quoted(value: object, length: int | None = None) -> str:
    """What was given as a sentence can hold it: on one line, its middle left out if it is long.

    A string stands in it without quotation marks; write `f"'{quoted(word)}'"` where it needs some.

    Args:
        value: Anything; strings and paths as they are, other values as Python writes them.
        length: Most characters that are returned; if left out, as many as such a value gets.
    """
    if length is None:
        length = LONGEST_PATH if isinstance(value, os.PathLike) else LONGEST_QUOTE
    text = str(value) if isinstance(value, (str, os.PathLike)) else _written(value)
    # Twice as many characters as are wanted at either end are enough, whatever is left out.
    ends = text if len(text) <= 4 * length else text[: 2 * length] + text[-2 * length :]
    line = "".join(c if c.isprintable() else " " for c in ends)
    if len(text) <= length:
        return line
    half = (length - 1) // 2
    return f"{line[:half]}…{line[-half:]}"


def refuse_pointer(path: Path) -> None:
    """Refuse what git-lfs leaves in place of a file until it is fetched.

    Whatever else may be wrong with the file is left to those who read it.

    Raises:
        InputError: where the file is such a pointer.
    """
    with suppress(OSError), path.open("rb") as file:
        if file.read(len(POINTER)) == POINTER:
            raise InputError(
                f"{quoted(path)} is a git-lfs pointer, not the file itself; run `git lfs pull` in "
                "its repository to fetch it."
            )


def _written(value: object) -> str:
    """`repr`, which refuses integers of more than 4,300 digits."""
    if isinstance(value, int) and value.bit_length() > 4 * LONGEST_QUOTE:
        return f"an integer of about {value.bit_length() * 0.30103:,.0f} digits"
    try:
        return repr(value)
    except (ValueError, RecursionError):
        return f"a {type(value).__name__} that cannot be written out"
