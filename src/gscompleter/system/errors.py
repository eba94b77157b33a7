"""Errors for the user, and the sentences that they hold."""

import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from reprlib import Repr

MESSAGE_PREFIX = "gscompleter: "
"""Prefix of every error message."""
MAX_MESSAGE_LENGTH = 300
MAX_QUOTE_LENGTH = 60
MAX_PATH_LENGTH = 250
MAX_NAME_BYTES = 255
"""Longest name of a file or folder on usual disks."""
MEMORY_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
"""Place in memory in the text of an object without one of its own."""

LFS_POINTER = b"version https://git-lfs"

_REPR = Repr()
_REPR.maxlevel = 4
_REPR.maxstring = 4 * MAX_QUOTE_LENGTH
_REPR.maxother = 4 * MAX_QUOTE_LENGTH
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = MAX_QUOTE_LENGTH // 2


class InputError(ValueError):
    """An error in the input, which the user can correct.

    Its message is one sentence: what was given, what is needed, what to do. The command line prints
    it on one line and exits with code 2.
    """

    def __init__(self, message: str, argument: str | None = None) -> None:
        """Create the error; the command line names the option `argument` if `message` does not."""
        super().__init__(message)
        self.argument = None if argument is None else quote_value(argument)

    def __str__(self) -> str:
        option = 0 if self.argument is None else len(f" (--{self.argument}).")
        return shorten_message(super().__str__(), MAX_MESSAGE_LENGTH - len(MESSAGE_PREFIX) - option)


class OutputError(InputError):
    """An error while writing results, which affects all of them."""


class FullDiskError(OutputError):
    """A disk without space, or a quota that is used up, which is no fault of the input."""


class NoCaseError(InputError):
    """No case of an evaluation was completed, so that there is no table or figure to write."""


class WorkerError(InputError):
    """Processes that end before they do anything, which is no fault of the input."""


def print_error(sentence: str) -> None:
    """Print a sentence as one line of the standard error, shortened to `MAX_MESSAGE_LENGTH`.

    If that is full or its reader has left, nothing is printed, and the exit code still says what
    went wrong.
    """
    with suppress(OSError):
        print(
            MESSAGE_PREFIX + shorten_message(sentence, MAX_MESSAGE_LENGTH - len(MESSAGE_PREFIX)),
            file=sys.stderr,
        )


def quote_value(value: object, length: int | None = None) -> str:
    """Format a value for a sentence: on one line, with its middle left out if it is long.

    Strings get no quotation marks; write `f"'{quote_value(word)}'"` to add them. `length` limits
    the characters; by default it depends on the type.
    """
    if length is None:
        length = MAX_PATH_LENGTH if isinstance(value, os.PathLike) else MAX_QUOTE_LENGTH
    is_text = isinstance(value, (str, os.PathLike))
    # The place of an object in memory tells nothing, and is another one in each run.
    text = str(value) if is_text else re.sub(MEMORY_ADDRESS, "", _REPR.repr(value))
    # Only the ends of very long texts are processed.
    ends = text if len(text) <= 4 * length else text[: 2 * length] + text[-2 * length :]
    # Line breaks and control characters would split the sentence or drive the terminal.
    line = "".join(c if c.isprintable() else " " for c in ends)
    if len(text) <= length:
        return line
    half = (length - 1) // 2
    return f"{line[:half]}…{line[-half:]}"


def shorten_message(message: str, most: int) -> str:
    """Shorten the longest words of a message, such as paths but not URLs, and then its middle."""
    words = message.split()
    while len(" ".join(words)) > most:
        excess = len(" ".join(words)) - most
        # URLs count as empty words.
        lengths = [0 if "://" in word else len(word) for word in words]
        longest = lengths.index(max(lengths))
        length = max(len(words[longest]) - excess, MAX_QUOTE_LENGTH)
        if length >= len(words[longest]):
            break
        words[longest] = quote_value(words[longest], length)
    return quote_value(" ".join(words), most)


def require_path(value: object) -> Path:
    """Return a path, or raise InputError for a value that is none."""
    if isinstance(value, (str, os.PathLike)):
        path = Path(value)
        for part in path.parts:
            if "\0" in part or len(part.encode("utf-8", "surrogatepass")) > MAX_NAME_BYTES:
                raise InputError(f"No file can be called '{quote_value(part)}'; name another path.")
        if isinstance(value, os.PathLike) or value:
            return path
    raise InputError(
        f"A path has to be a str or Path that is not empty, and is '{quote_value(value)}'."
    )


def join_names(names: Sequence[object], most: int, length: int | None = None) -> str:
    """List the first `most` names, as in "a, b and 7 more"."""
    shown = ", ".join(quote_value(name, length) for name in names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown


def format_rounded(value: float, digits: int = 3) -> str:
    """Format a number to some significant digits, below a million without an exponent."""
    return f"{float(f'{value:.{digits}g}'):g}"


def refuse_pointer(path: Path) -> None:
    """Raise InputError for a git-lfs pointer in place of the file itself."""
    if not os.path.isfile(path):
        return
    with suppress(OSError), path.open("rb") as file:
        if file.read(len(LFS_POINTER)) == LFS_POINTER:
            raise InputError(
                f"{quote_value(path)} is a git-lfs pointer, not the file itself; run "
                "`git lfs pull` in its repository to fetch it."
            )
