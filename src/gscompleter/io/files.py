"""Atomic writes: a file or folder is written completely or left as it was."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from gscompleter.errors import InputError, OutputError, quote_value
from gscompleter.io.interrupts import defer_interrupts
from gscompleter.io.unfinished import (
    UNFINISHED_PREFIX,
    create_file,
    create_folder,
    lock_abandoned,
    remove,
    remove_abandoned,
)

SUMMARY_FILE = "summary.json"
"""File that marks a folder as complete: it is removed first and written last."""
TARGETS_FILE = "targets.json"
"""File of a completion with the target cameras."""
CONTEXT_FILE, COMPLETED_FILE = "context.ply", "completed.ply"
"""The scene of a completion before and after."""

_REPLACED_FOLDER = f"{UNFINISHED_PREFIX}replaced"
"""Folder of a draft for replaced entries; it exists only once the draft is complete."""

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

    An existing file survives every failure. With `first_stays`, a file that another process wrote
    at
    `path` meanwhile is kept.

    Raises:
        InputError: The file cannot be written.
    """
    # The target of a symbolic link is replaced, not the link.
    target = Path(os.path.realpath(path))
    temporary: Path | None = None
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        remove_abandoned(target.parent)
        with defer_interrupts():
            temporary, opened = create_file(target.parent)
        with opened as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if not (keep_existing and _link(temporary, target)):
                os.replace(temporary, target)
    except OSError as error:
        raise OutputError(_describe_write_error(path, error)) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


def _link(temporary: Path, target: Path) -> bool:
    """Link the file to `target`, unless another process wrote that first.

    Returns:
        False if the file system has no hard links.
    """
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
    with defer_interrupts():
        _Draft(Path(path), overwrite).close()


@contextlib.contextmanager
def open_output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """Open a temporary folder whose content becomes `path` at once at the end.

    A new `path` is made by a rename. One with only results of the same names is exchanged in one
    step.
    Otherwise (a mount, a working directory, other files in it) entries are renamed one by one, the
    summary last, and other files stay; if the process is killed, the next run finishes the renames.
    After any exception, `path` and its parents are as before. An interrupt waits for the renames.

    Raises:
        InputError: As in `check_output`, or the disk is full.
    """
    draft: _Draft | None = None
    try:
        with defer_interrupts():
            draft = _Draft(Path(path), overwrite)
        try:
            yield draft.folder
            with defer_interrupts(f"{quote_value(Path(path))} is complete"):
                draft.publish()
                draft.close()
        except InputError as error:
            # The temporary name means nothing to the user.
            whole = str(error.args[0]).replace(str(draft.folder), str(path))
            raise type(error)(whole, error.argument) from error
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise OutputError(_describe_write_error(path, error)) from error
    finally:
        with defer_interrupts():
            if draft is not None:
                draft.close()


class _Draft:
    """The unfinished content of an output folder, and the parent folders created for it."""

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.target = Path(os.path.realpath(path))
        try:
            self.exists = self.target.is_dir()
        except OSError as error:
            raise OutputError(_describe_write_error(path, error)) from error
        self.parents: list[Path] = []
        self.closed = False
        if self.exists:
            _finish_abandoned(self.target)
        _check_free(path, self.target, overwrite)
        try:
            beside = not self.exists or _can_exchange(self.target)
            home = self.target.parent if beside else self.target
            self._make_parents(home)
            remove_abandoned(home)
            self.folder, self.lock = create_folder(home)
        except OSError as error:
            self._remove_parents()
            raise OutputError(_describe_write_error(path, error)) from error

    def _make_parents(self, folder: Path) -> None:
        missing = [p for p in (folder, *folder.parents) if not p.exists()]
        for parent in reversed(missing):
            parent.mkdir(exist_ok=True)
            self.parents.append(parent)

    def _remove_parents(self) -> None:
        for parent in reversed(self.parents):
            with contextlib.suppress(OSError):
                parent.rmdir()

    def publish(self) -> None:
        """Rename everything to its final name, or nothing."""
        try:
            if not self.exists:
                os.rename(self.folder, self.target)
                self.parents = []
            elif not self._try_exchange():
                self._move_inside()
                _finish_renames(self.folder)
        except OSError as error:
            raise OutputError(_describe_write_error(self.target, error)) from error

    def _try_exchange(self) -> bool:
        """Exchange draft and target in one step, if only results would be lost."""
        if self.folder.parent != self.target.parent:
            return False
        others = set(os.listdir(self.target)) - set(os.listdir(self.folder))
        if any(not name.startswith(UNFINISHED_PREFIX) for name in others):
            return False
        with contextlib.suppress(OSError):
            shutil.copymode(self.target, self.folder)
            _exchange(self.folder, self.target)
            return True
        return False

    def _move_inside(self) -> None:
        """Move the draft into the target, where the next run finds it if this one is killed."""
        inside = self.target / self.folder.name
        if inside != self.folder:
            os.rename(self.folder, inside)
            self.folder = inside

    def close(self) -> None:
        """Remove unpublished content, and empty parents that were created for it."""
        if self.closed:
            return
        self.closed = True
        # Entries that could not be restored exist only here; the next run finishes the renames.
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            if not os.listdir(self.folder / _REPLACED_FOLDER):
                os.rmdir(self.folder / _REPLACED_FOLDER)
        if not (self.folder / _REPLACED_FOLDER).exists():
            remove(self.folder)
        os.close(self.lock)
        self._remove_parents()


def _finish_abandoned(target: Path) -> None:
    """Finish the renames of a killed run in `target`, and remove its other leftovers."""
    with lock_abandoned(target) as found:
        for draft in found:
            with contextlib.suppress(OSError):
                if (draft / _REPLACED_FOLDER).is_dir():
                    _finish_renames(draft)
                remove(draft)


def _finish_renames(draft: Path) -> None:
    """Move the content of `draft` to its parent folder, or nothing; replaced entries are lost."""
    target, replaced = draft.parent, draft / _REPLACED_FOLDER
    entries = set(os.listdir(draft)) - {_REPLACED_FOLDER}
    names = sorted(entries, key=lambda name: (name == SUMMARY_FILE, name))
    replaced.mkdir(exist_ok=True)
    old = [name for name in reversed(names) if os.path.lexists(target / name)]
    moves = [(target / name, replaced / name) for name in old]
    _rename_all(moves + [(draft / name, target / name) for name in names])
    remove(replaced)


def _can_exchange(folder: Path) -> bool:
    """Return True if another folder can take the place of this one unnoticed."""
    here = Path.cwd()
    return (
        hasattr(os, "geteuid")
        and not os.path.ismount(folder)
        and folder not in (here, *here.parents)
        and os.access(folder.parent, os.W_OK | os.X_OK)
        and folder.stat().st_uid == os.geteuid()
    )


def _exchange(one: Path, other: Path) -> None:
    """Exchange two entries of a file system in one step (Linux)."""
    here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of <fcntl.h> and <linux/fs.h>
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None or rename(here, bytes(one), here, bytes(other), exchange) != 0:
        raise OSError(ctypes.get_errno() or errno.ENOSYS, "cannot exchange two folders")


def _rename_all(moves: list[tuple[Path, Path]]) -> None:
    """Do all renames, or none of them."""
    done: list[tuple[Path, Path]] = []
    try:
        for move in moves:
            done.append(move)
            os.rename(*move)
    except BaseException:
        for source, destination in reversed(done):
            # An interrupt may have come before or after the last rename.
            if not os.path.lexists(source):
                os.rename(destination, source)
        raise


def _check_free(path: Path, target: Path, overwrite: bool) -> None:
    """Raise InputError if `path` contains something that must not be overwritten."""
    if os.path.lexists(target) and not target.is_dir():
        raise InputError(
            f"The output {quote_value(path)} is a file, and a folder is needed; name another one."
        )
    try:
        entries = os.listdir(target) if target.is_dir() else []
    except OSError as error:
        raise OutputError(_describe_write_error(path, error)) from error
    if not overwrite and any(not name.startswith(UNFINISHED_PREFIX) for name in entries):
        raise InputError(
            f"The output folder {quote_value(path)} is not empty; name another one, or overwrite "
            "the "
            "results in it.",
            "overwrite",
        )


def _describe_write_error(path: Path | str, error: OSError) -> str:
    reason = _REASONS.get(error.errno or 0, f"{error.strerror or error}; choose another place")
    return f"Cannot write {quote_value(Path(path))}: {reason}."
