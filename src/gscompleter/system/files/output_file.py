"""Output files of a command, each of which the user names."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.unfinished import (
    give_signs,
    list_unfinished,
    make_unfinished_name,
    remove_left_behind,
)
from gscompleter.system.files.writing import convert_write_errors, refuse_special_file


@contextmanager
def reserve_file(path: Path, overwrite: bool) -> Iterator[None]:
    """Reserve a file for the result of this process during the block, by trying to write there.

    Raise an InputError if it exists and `overwrite` is not set, if it is a device or a pipe, or if
    another run is writing it.
    """
    target = Path(os.path.realpath(path))
    mark = target.with_name(make_unfinished_name(target.name))
    with convert_write_errors(path):
        check_free(path, overwrite)
        refuse_special_file(target)
        mark.touch(exist_ok=False)
    try:
        entries = list_unfinished(target.parent, target.name)
        # The mark of this run is made before it looks for others: of two runs at least one sees the
        # other.
        for entry in entries:
            if not entry.is_own() and entry.is_running():
                raise InputError(entry.describe_file(path))
        remove_left_behind(target.parent, target.name)
        with give_signs(mark):
            yield
    finally:
        with suppress(OSError):
            mark.unlink()


def check_free(path: Path, overwrite: bool) -> None:
    """Refuse to replace a file unless `overwrite` is set."""
    try:
        os.lstat(os.path.realpath(path))
    except (FileNotFoundError, NotADirectoryError):
        return  # any other error, as of a name that is too long, is one of writing there
    if not overwrite:
        raise InputError(
            f"{quote_value(path)} exists; name another file, or overwrite it.", "overwrite"
        )
