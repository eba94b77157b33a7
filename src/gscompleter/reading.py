"""Read files that somebody else wrote: regular files only, and no more of them than fits."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO

from gscompleter.errors import InputError, quoted

MAX_BYTES = 1 << 33
"""Largest file that is read at once, in bytes."""
MAX_TEXT = 1 << 23
"""Longest text file, in bytes."""
MAX_LINE = 4096
"""Longest line, in characters."""
MAX_DEPTH = 64
"""Deepest nesting of lists and dictionaries; numpy knows no more dimensions."""

_KINDS = {
    stat.S_IFDIR: "folder",
    stat.S_IFIFO: "pipe",
    stat.S_IFSOCK: "socket",
    stat.S_IFCHR: "device",
    stat.S_IFBLK: "device",
}
_HOLDERS = (list, tuple, dict, set, frozenset)


def check_file(path: Path) -> None:
    """Refuse whatever is no regular file, before it is opened.

    Raises:
        InputError: if there is nothing, or a folder, a pipe, a socket or a device.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise _unreadable(path, error) from error
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "device")
        raise InputError(f"{quoted(path)} is not a file but a {kind}; correct the path.")


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        InputError: as `check_file`, or if it may not be read.
    """
    check_file(path)
    try:
        return path.open("rb")
    except OSError as error:
        raise _unreadable(path, error) from error


def read_head(path: Path, count: int) -> bytes:
    """Read the first `count` bytes of a file; empty where there is no file that can be read."""
    with suppress(InputError, OSError), open_file(path) as file:
        return file.read(count)
    return b""


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """Read a file of at most `most` bytes.

    Raises:
        InputError: as `open_file`, or if it is larger.
    """
    try:
        with open_file(path) as file:
            _check_size(path, file, most)
            return file.read()
    except OSError as error:
        raise _unreadable(path, error) from error


def read_lines(
    path: Path, longest: int = MAX_LINE, most: int = MAX_TEXT, errors: str = "replace"
) -> Iterator[str]:
    """Read the lines of a text file in UTF-8, one after the other, with their ends.

    Args:
        path: The file.
        longest: Characters of a line.
        most: Bytes of the file.
        errors: What becomes of bytes that are no text, as in `bytes.decode`.

    Raises:
        InputError: as `open_file`, or if the file or one of its lines is longer.
        UnicodeDecodeError: if it is no text, and `errors` is "strict".
    """
    try:
        with open_file(path) as file:
            _check_size(path, file, most)
            text = TextIOWrapper(file, encoding="utf-8-sig", errors=errors)
            while line := text.readline(longest + 1):
                if len(line) > longest:
                    raise InputError(
                        f"{quoted(path)} has a line of more than {longest:,} characters, which is "
                        "none of its format; copy it again."
                    )
                yield line
    except OSError as error:
        raise _unreadable(path, error) from error


def check_plain(value: Any, path: Path, most: int) -> None:
    """Refuse lists and dictionaries that are too deep or, with repetitions, too many.

    A value that contains itself is endless, and is refused as too deep or too large.

    Args:
        value: What was read from `path`.
        path: The file.
        most: How many values there may be.

    Raises:
        InputError: if there are more, or `MAX_DEPTH` of them are within one another.
    """
    waiting, count = [(value, 0)], 0
    while waiting:
        held, depth = waiting.pop()
        if not isinstance(held, _HOLDERS):
            continue
        parts = held.values() if isinstance(held, dict) else held
        count += len(parts)
        if depth > MAX_DEPTH or count > most:
            raise InputError(f"{quoted(path)} is nested too deeply or without end; write it again.")
        waiting += [(part, depth + 1) for part in parts if isinstance(part, _HOLDERS)]


def _check_size(path: Path, file: BinaryIO, most: int) -> None:
    size = os.fstat(file.fileno()).st_size
    if size > most:
        raise InputError(
            f"{quoted(path)} has {size:,} bytes, and at most {most:,} are read; name a smaller one."
        )


def _unreadable(path: Path, error: Exception) -> InputError:
    reason = getattr(error, "strerror", None) or "no file can have that name"
    return InputError(f"{quoted(path)} cannot be read: {reason}; correct the path.")
