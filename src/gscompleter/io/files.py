"""Writing that either happens completely or leaves things as they were."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from gscompleter.errors import InputError, OutputError, quoted
from gscompleter.interrupts import stops_deferred
from gscompleter.io.unfinished import (
    MARK,
    abandoned,
    create_file,
    create_folder,
    remove,
    remove_abandoned,
)

SUMMARY = "summary.json"
"""The file that says a folder is complete: it leaves first and arrives last."""
TARGETS = "targets.json"
"""The file of a completion with the cameras that it was done for."""
CONTEXT, COMPLETED = "context.ply", "completed.ply"
"""The scene of a completion before and after."""

_REPLACED = f"{MARK}replaced"
"""Where a draft keeps what it replaces. Once it is there, the draft is complete."""

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
def replacing(path: Path | str, first_stays: bool = False) -> Iterator[BinaryIO]:
    """A file to write into that takes the name `path` once everything is on the disk.

    It lies beside `path` under a temporary name until then, so that a reader never sees half a
    file and an existing one survives every failure.

    With `first_stays`, a file that another process made of that name meanwhile is left.

    Raises:
        InputError: where the file cannot be written: no permission, no space, a folder.
    """
    # A symbolic link stays one: what it points to is replaced.
    target = Path(os.path.realpath(path))
    temporary: Path | None = None
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        remove_abandoned(target.parent)
        with stops_deferred():
            temporary, opened = create_file(target.parent)
        with opened as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if not (first_stays and _linked(temporary, target)):
                os.replace(temporary, target)
    except OSError as error:
        raise OutputError(_cannot_write(path, error)) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


def _linked(temporary: Path, target: Path) -> bool:
    """Whether the file has the name `target` too, or another had it first.

    False where the file system has no hard links, and so no name that only one can take.
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
    """Make sure, before anything is computed, that a folder of results can be written.

    Whether it can is found out by trying, and nothing of the attempt remains.

    Raises:
        InputError: where `path` is a file, is a folder with something in it while `overwrite`
            is off, or cannot be created or written to.
    """
    with stops_deferred():
        _Draft(Path(path), overwrite).close()


@contextlib.contextmanager
def output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder to write results into, which become `path` all at once at the end.

    Where `path` does not exist, the folder is renamed to it; where it holds nothing but results
    of the same names, the two folders change places in one step. Where that cannot be (a mount, a
    working directory, other files in it), it stays the folder it is: the new entries replace
    those of the same name by renames, the summary last, and everything else in it is left alone;
    should the process be killed meanwhile, the next run finishes the renames. After any exception,
    an interrupt included, `path` is as it was before, and so are its parents. An interrupt that
    comes while the results are given their names waits until that is done.

    Raises:
        InputError: as `check_output`, and where the disk is full.
    """
    draft: _Draft | None = None
    try:
        with stops_deferred():
            draft = _Draft(Path(path), overwrite)
        try:
            yield draft.folder
            with stops_deferred(f"{quoted(Path(path))} is complete"):
                draft.publish()
                draft.close()
        except InputError as error:
            # The user asked for `path` and need not hear of the temporary name.
            whole = str(error.args[0]).replace(str(draft.folder), str(path))
            raise type(error)(whole, error.argument) from error
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise OutputError(_cannot_write(path, error)) from error
    finally:
        with stops_deferred():
            if draft is not None:
                draft.close()


class _Draft:
    """The unfinished content of an output folder, and the folders made to hold it."""

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.target = Path(os.path.realpath(path))
        try:
            self.exists = self.target.is_dir()
        except OSError as error:
            raise OutputError(_cannot_write(path, error)) from error
        self.parents: list[Path] = []
        self.closed = False
        if self.exists:
            _finish_abandoned(self.target)
        _check_free(path, self.target, overwrite)
        try:
            beside = not self.exists or _may_change_places(self.target)
            home = self.target.parent if beside else self.target
            self._make_parents(home)
            remove_abandoned(home)
            self.folder, self.lock = create_folder(home)
        except OSError as error:
            self._remove_parents()
            raise OutputError(_cannot_write(path, error)) from error

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
        """Give everything its final name, or nothing."""
        try:
            if not self.exists:
                os.rename(self.folder, self.target)
                self.parents = []
            elif not self._changed_places():
                self._move_inside()
                _finish(self.folder)
        except OSError as error:
            raise OutputError(_cannot_write(self.target, error)) from error

    def _changed_places(self) -> bool:
        """Swap draft and target in one step, where nothing but results would go."""
        if self.folder.parent != self.target.parent:
            return False
        others = set(os.listdir(self.target)) - set(os.listdir(self.folder))
        if any(not name.startswith(MARK) for name in others):
            return False
        with contextlib.suppress(OSError):
            shutil.copymode(self.target, self.folder)
            _exchange(self.folder, self.target)
            return True
        return False

    def _move_inside(self) -> None:
        """Into the target, where the next run looks for it should this one be killed."""
        inside = self.target / self.folder.name
        if inside != self.folder:
            os.rename(self.folder, inside)
            self.folder = inside

    def close(self) -> None:
        """Remove what was not published, and the parents made for it where they are empty."""
        if self.closed:
            return
        self.closed = True
        # What could not be put back is all there is of it; the next run finishes the renames.
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            if not os.listdir(self.folder / _REPLACED):
                os.rmdir(self.folder / _REPLACED)
        if not (self.folder / _REPLACED).exists():
            remove(self.folder)
        os.close(self.lock)
        self._remove_parents()


def _finish_abandoned(target: Path) -> None:
    """Finish the renames that a killed run had begun in `target`, and remove what else it left."""
    with abandoned(target) as found:
        for draft in found:
            with contextlib.suppress(OSError):
                if (draft / _REPLACED).is_dir():
                    _finish(draft)
                remove(draft)


def _finish(draft: Path) -> None:
    """Move everything in `draft` to the folder it lies in, or nothing; what it replaces is lost."""
    target, replaced = draft.parent, draft / _REPLACED
    entries = set(os.listdir(draft)) - {_REPLACED}
    names = sorted(entries, key=lambda name: (name == SUMMARY, name))
    replaced.mkdir(exist_ok=True)
    old = [name for name in reversed(names) if os.path.lexists(target / name)]
    moves = [(target / name, replaced / name) for name in old]
    _rename_all(moves + [(draft / name, target / name) for name in names])
    remove(replaced)


def _may_change_places(folder: Path) -> bool:
    """Whether another folder can take the place of this one without anybody missing it."""
    here = Path.cwd()
    return (
        hasattr(os, "geteuid")
        and not os.path.ismount(folder)
        and folder not in (here, *here.parents)
        and os.access(folder.parent, os.W_OK | os.X_OK)
        and folder.stat().st_uid == os.geteuid()
    )


def _exchange(one: Path, other: Path) -> None:
    """Let two entries of a file system change names in one step, as Linux can."""
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
            # The last one may or may not have happened when an interrupt arrived.
            if not os.path.lexists(source):
                os.rename(destination, source)
        raise


def _check_free(path: Path, target: Path, overwrite: bool) -> None:
    """Raise an InputError where `path` holds something that must not be written over."""
    if os.path.lexists(target) and not target.is_dir():
        raise InputError(
            f"The output {quoted(path)} is a file, and a folder is needed; name another one."
        )
    try:
        entries = os.listdir(target) if target.is_dir() else []
    except OSError as error:
        raise OutputError(_cannot_write(path, error)) from error
    if not overwrite and any(not name.startswith(MARK) for name in entries):
        raise InputError(
            f"The output folder {quoted(path)} is not empty; name another one, or overwrite the "
            "results in it.",
            "overwrite",
        )


def _cannot_write(path: Path | str, error: OSError) -> str:
    reason = _REASONS.get(error.errno or 0, f"{error.strerror or error}; choose another place")
    return f"Cannot write {quoted(Path(path))}: {reason}."
