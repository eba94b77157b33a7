"""Atomic writes: a file or folder is written completely or left as it was."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from gscompleter.errors import InputError, OutputError, quote_value
from gscompleter.io.interrupts import defer_interrupts

SUMMARY_FILE = "summary.json"
"""File that marks a folder as complete: it is removed first and written last."""
TARGETS_FILE = "targets.json"
"""File of a completion with the target cameras."""
CONTEXT_FILE, COMPLETED_FILE = "context.ply", "completed.ply"
"""The scene of a completion before and after."""

UNFINISHED_PREFIX = ".gscompleter-"
"""Prefix of the names of unfinished entries, which are never taken for results."""
_REPLACED_FOLDER = f"{UNFINISHED_PREFIX}replaced"
"""Folder of a draft for replaced entries."""

_REASONS = {
    errno.ENOSPC: "there is no space left; free some or choose another place",
    errno.EDQUOT: "your disk quota is used up; free some space or choose another place",
    errno.EFBIG: "it would exceed the allowed file size; raise the limit or choose another place",
    errno.EACCES: "you have no permission there; choose another place",
    errno.EPERM: "you have no permission there; choose another place",
    errno.EROFS: "that file system is read-only; choose another place",
    errno.EISDIR: "that is a folder; name a file",
    errno.ENOTDIR: "a part of that path is a file, not a folder; choose another place",
    errno.EEXIST: "a part of that path is a file, not a folder; choose another place",
    errno.ENOENT: "the folder it should lie in does not exist; create it first",
    errno.ENAMETOOLONG: "that name is too long; choose a shorter one",
}

_NO_LINKS = {errno.EPERM, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@contextlib.contextmanager
def replace_file(path: Path | str, keep_existing: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file that is renamed to `path` once it is completely on the disk.

    An existing file survives every failure. With `keep_existing`, a file that another process
    wrote at `path` meanwhile is kept.

    Raises:
        InputError: The file cannot be written.
    """
    # The target of a symbolic link is replaced, not the link.
    target = Path(os.path.realpath(path))
    temporary = target.with_name(_make_name())
    try:
        if os.path.isdir(target):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if not (keep_existing and _link(temporary, target)):
            os.replace(temporary, target)
    except OSError as error:
        raise OutputError(_describe_write_error(path, error)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _link(temporary: Path, target: Path) -> bool:
    """Link the file to `target`, unless that exists; False if there are no hard links."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        return True
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        return False
    return True


def check_output(path: Path | str, overwrite: bool = False) -> None:
    """Check, by trying, that a folder of results can be written.

    Raises:
        InputError: `path` is a file, not empty while `overwrite` is off, or not writable.
    """
    with _create_draft(Path(path), overwrite):
        pass


@contextlib.contextmanager
def open_output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """Open a temporary folder whose content becomes `path` at the end.

    A new `path` is made by one rename. In an existing one, entries of the same names are replaced,
    the summary last, and other files stay. After any exception, `path` and its parents are as
    before. An interrupt waits for the renames.

    Raises:
        InputError: As in `check_output`, or the disk is full.
    """
    with _create_draft(Path(path), overwrite) as draft:
        try:
            yield draft
            with defer_interrupts(f"{quote_value(Path(path))} is complete"):
                _publish(draft, Path(path))
        except InputError as error:
            # The temporary name means nothing to the user.
            whole = str(error.args[0]).replace(str(draft), str(path))
            raise type(error)(whole, error.argument) from error
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise OutputError(_describe_write_error(path, error)) from error


@contextlib.contextmanager
def _create_draft(path: Path, overwrite: bool) -> Iterator[Path]:
    """Create a folder for the content of `path`, in it or beside it, with missing parents.

    At the end whatever was not published is removed.
    """
    target = Path(os.path.realpath(path))
    _check_free(path, target, overwrite)
    home = target if os.path.isdir(target) else target.parent
    missing = [folder for folder in (home, *home.parents) if not os.path.exists(folder)]
    draft = home / _make_name()
    try:
        _make_folder(draft, path)
        yield draft
    finally:
        # Replaced entries that could not be put back exist only here.
        with contextlib.suppress(OSError):
            (draft / _REPLACED_FOLDER).rmdir()
        if not os.path.exists(draft / _REPLACED_FOLDER):
            shutil.rmtree(draft, ignore_errors=True)
        for folder in missing:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _make_folder(draft: Path, path: Path) -> None:
    try:
        draft.mkdir(parents=True)
    except OSError as error:
        raise OutputError(_describe_write_error(path, error)) from error


def _publish(draft: Path, path: Path) -> None:
    """Rename everything to its final name, or nothing."""
    target = Path(os.path.realpath(path))
    try:
        if draft.parent == target:
            _replace_entries(draft, target)
        else:
            os.rename(draft, target)
    except OSError as error:
        raise OutputError(_describe_write_error(path, error)) from error


def _replace_entries(draft: Path, target: Path) -> None:
    """Move the content of `draft` to `target`, or nothing; replaced entries are lost."""
    replaced = draft / _REPLACED_FOLDER
    names = sorted(os.listdir(draft), key=lambda name: (name == SUMMARY_FILE, name))
    old = [name for name in reversed(names) if os.path.lexists(target / name)]
    moves = [(target / name, replaced / name) for name in old]
    replaced.mkdir()
    _rename_all(moves + [(draft / name, target / name) for name in names])
    shutil.rmtree(replaced, ignore_errors=True)


def _rename_all(moves: list[tuple[Path, Path]]) -> None:
    """Do all renames, or none of them."""
    done: list[tuple[Path, Path]] = []
    try:
        for move in moves:
            os.rename(*move)
            done.append(move)
    except BaseException:
        for source, destination in reversed(done):
            os.rename(destination, source)
        raise


def _check_free(path: Path, target: Path, overwrite: bool) -> None:
    """Raise InputError if `path` contains something that must not be overwritten."""
    if os.path.lexists(target) and not os.path.isdir(target):
        raise InputError(
            f"The output {quote_value(path)} is a file, and a folder is needed; name another one."
        )
    try:
        entries = os.listdir(target)
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise OutputError(_describe_write_error(path, error)) from error
    if not overwrite and any(not name.startswith(UNFINISHED_PREFIX) for name in entries):
        raise InputError(
            f"The output folder {quote_value(path)} is not empty; name another one, or overwrite "
            "the results in it.",
            "overwrite",
        )


def _make_name() -> str:
    return f"{UNFINISHED_PREFIX}{secrets.token_hex(6)}"


def _describe_write_error(path: Path | str, error: OSError) -> str:
    reason = _REASONS.get(error.errno or 0, f"{error.strerror or error}; choose another place")
    return f"Cannot write {quote_value(Path(path))}: {reason}."
