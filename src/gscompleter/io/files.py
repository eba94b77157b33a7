"""Atomic writes: a file or folder is written completely or left as it was.

Interrupts (Ctrl-C, `kill`, a scheduler, or a closed terminal) wait while results are renamed.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import signal
import threading
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from gscompleter.errors import InputError, OutputError, quote_value

SUMMARY_FILE = "summary.json"
"""File that marks a folder as complete: it is removed first and written last."""
TARGETS_FILE = "targets.json"
"""File of a completion with the target cameras."""
CONTEXT_FILE, COMPLETED_FILE = "context.ply", "completed.ply"
"""The scene of a completion before and after."""
OPTIONAL_FILES = ("removed.ply", TARGETS_FILE, "video.mp4")
"""Files that only some completions have: those of an earlier one do not belong to its successor."""

UNFINISHED_PREFIX = ".gscompleter-"
"""Prefix of the names of unfinished entries, which are never taken for results."""

_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@contextmanager
def replace_file(path: Path | str, keep_existing: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file that is renamed to `path` once it is completely on the disk.

    An existing file survives every failure. With `keep_existing`, a file that another process
    wrote at `path` meanwhile is kept, where the file system has hard links.
    """
    # The target of a symbolic link is replaced, not the link.
    target = Path(os.path.realpath(path))
    temporary = target.with_name(_make_name())
    with convert_write_errors(path):
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if keep_existing:
                with suppress(OSError):
                    os.link(temporary, target)
            if not (keep_existing and target.exists()):
                os.replace(temporary, target)
        finally:
            with suppress(OSError):
                temporary.unlink()


def check_output(path: Path | str, overwrite: bool = False) -> None:
    """Raise an InputError if results cannot be written to this folder, by trying."""
    with _create_draft(Path(path), overwrite):
        pass


@contextmanager
def open_output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """Open a temporary folder whose content becomes `path` at the end.

    A new `path` is made by one rename. In an existing one, entries of the same names are replaced,
    the summary last, and other files stay. After any exception, `path` and its parents are as
    before.
    """
    with _create_draft(Path(path), overwrite) as draft:
        try:
            with convert_write_errors(path, _DISK_ERRORS):
                yield draft
            state = f"{quote_value(Path(path))} is complete"
            with convert_write_errors(path), defer_interrupts(state):
                _publish(draft, Path(os.path.realpath(path)))
        except InputError as error:
            # The temporary name means nothing to the user.
            whole = str(error.args[0]).replace(str(draft), str(path))
            raise type(error)(whole, error.argument) from error


@contextmanager
def _create_draft(path: Path, overwrite: bool) -> Iterator[Path]:
    """Create a folder for the content of `path`, in it or beside it, with missing parents.

    At the end whatever was not published is removed.
    """
    target = Path(os.path.realpath(path))
    home = target if os.path.isdir(target) else target.parent
    missing = [folder for folder in (home, *home.parents) if not os.path.exists(folder)]
    draft = home / _make_name()
    try:
        with convert_write_errors(path):
            _check_free(path, overwrite)
            draft.mkdir(parents=True)
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()


def _check_free(path: Path, overwrite: bool) -> None:
    """Raise an error if `path` is a file or contains something that must not be overwritten."""
    names = list[str]()
    with suppress(FileNotFoundError):
        names = os.listdir(path)
    if not overwrite and any(not name.startswith(UNFINISHED_PREFIX) for name in names):
        raise InputError(
            f"The output folder {quote_value(path)} is not empty; name another one, or overwrite "
            "the results in it.",
            "overwrite",
        )


def _publish(draft: Path, target: Path) -> None:
    """Rename everything to its final name, or nothing; replaced entries are lost."""
    if draft.parent != target:
        os.rename(draft, target)
        return
    replaced = target / _make_name()
    names = sorted(os.listdir(draft), key=lambda name: (name == SUMMARY_FILE, name))
    stale = [name for name in OPTIONAL_FILES if COMPLETED_FILE in names and name not in names]
    old = [name for name in reversed([*stale, *names]) if os.path.lexists(target / name)]
    moves = [(target / name, replaced / name) for name in old]
    replaced.mkdir()
    try:
        _rename_all(moves + [(draft / name, target / name) for name in names])
    except OSError:
        with suppress(OSError):  # an entry that could not be put back exists only here
            replaced.rmdir()
        raise
    shutil.rmtree(replaced, ignore_errors=True)


def _rename_all(moves: list[tuple[Path, Path]]) -> None:
    """Do all renames, or none of them."""
    for number, move in enumerate(moves):
        try:
            os.rename(*move)
        except OSError:
            for source, destination in reversed(moves[:number]):
                os.rename(destination, source)
            raise


def _make_name() -> str:
    return f"{UNFINISHED_PREFIX}{secrets.token_hex(6)}"


@contextmanager
def convert_write_errors(path: Path | str, numbers: Container[int] | None = None) -> Iterator[None]:
    """Convert errors of the operating system, or those of the numbers, to OutputError."""
    try:
        yield
    except OSError as error:
        if numbers is not None and error.errno not in numbers:
            raise
        raise OutputError(
            f"Cannot write {quote_value(Path(path))}: {error.strerror or error}; free some space, "
            "or choose another place."
        ) from error


def handle_stop_signals() -> None:
    """Let the signals that end a process raise KeyboardInterrupt, so that it cleans up.

    Signals that are ignored (`nohup`) or handled already stay so. This works in the main thread
    only.
    """
    for name in ("SIGTERM", "SIGHUP", "SIGBREAK"):
        number = getattr(signal, name, None)  # only Windows has the last, and no SIGHUP
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


@contextmanager
def defer_interrupts(state: str) -> Iterator[None]:
    """Defer KeyboardInterrupt, with the message `state`, to the end of a block."""
    came: list[int] = []
    handled = []
    if threading.current_thread() is threading.main_thread():
        numbers = signal.valid_signals()  # on Windows, `Signals` has others
        handled = [n for n in numbers if signal.getsignal(n) is signal.default_int_handler]
    for number in handled:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, signal.default_int_handler)
    if came:
        raise KeyboardInterrupt(state)


def get_download_folder() -> Path:
    """Return $GSCOMPLETER_HOME, or else ~/.cache/gscompleter."""
    return Path(os.environ.get("GSCOMPLETER_HOME") or "~/.cache/gscompleter").expanduser()
