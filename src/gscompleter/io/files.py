"""Writing that either happens completely or leaves things as they were."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from gscompleter.errors import InputError

SUMMARY = "summary.json"
"""The file that says a folder is complete: it leaves first and arrives last."""

_MARK = ".gscompleter-"
"""How the name of everything unfinished begins. A killed process may leave one behind."""

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

_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@contextlib.contextmanager
def replacing(path: Path | str) -> Iterator[BinaryIO]:
    """A file to write into that takes the name `path` once everything is on the disk.

    It lies beside `path` under a temporary name until then, so that a reader never sees half a
    file and an existing one survives every failure.

    Raises:
        InputError: where the file cannot be written: no permission, no space, a folder.
    """
    # A symbolic link stays one: what it points to is replaced.
    target = Path(os.path.realpath(path))
    temporary = target.with_name(_unfinished_name())
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(_cannot_write(path, error)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def check_output(path: Path | str, overwrite: bool = False) -> None:
    """Make sure, before anything is computed, that a folder of results can be written.

    Whether it can is found out by trying, and nothing of the attempt remains.

    Raises:
        InputError: where `path` is a file, is a folder with something in it while `overwrite`
            is off, or cannot be created or written to.
    """
    with contextlib.closing(_Draft(Path(path), overwrite)):
        pass


@contextlib.contextmanager
def output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder to write results into, which become `path` all at once at the end.

    Where `path` does not exist, the folder is renamed to it. Where it does, it stays the folder
    it is (a mount, a link, somebody's working directory): the new entries replace those of the
    same name by renames, the summary last, and everything else in it is left alone. After any
    exception, an interrupt included, `path` is as it was before, and so are its parents.

    Raises:
        InputError: as `check_output`, and where the disk is full.
    """
    draft = _Draft(Path(path), overwrite)
    with contextlib.closing(draft):
        try:
            yield draft.folder
            draft.publish()
        except InputError as error:
            # The user asked for `path` and need not hear of the temporary name.
            raise InputError(str(error).replace(str(draft.folder), str(path))) from error
        except OSError as error:
            if error.errno not in _DISK_ERRORS:
                raise
            raise InputError(_cannot_write(path, error)) from error


class _Draft:
    """The unfinished content of an output folder, and the folders made to hold it."""

    def __init__(self, path: Path, overwrite: bool) -> None:
        self.target = Path(os.path.realpath(path))
        try:
            self.exists = self.target.is_dir()
        except OSError as error:
            raise InputError(_cannot_write(path, error)) from error
        self.parents: list[Path] = []
        _check_free(path, self.target, overwrite)
        # Inside an existing folder, because its parent may be another file system or closed to us.
        home = self.target if self.exists else self.target.parent
        self.folder = home / _unfinished_name()
        try:
            self._make_parents(home)
            self.folder.mkdir()
        except OSError as error:
            self.close()
            raise InputError(_cannot_write(path, error)) from error

    def _make_parents(self, folder: Path) -> None:
        missing = [p for p in (folder, *folder.parents) if not p.exists()]
        for parent in reversed(missing):
            parent.mkdir(exist_ok=True)
            self.parents.append(parent)

    def publish(self) -> None:
        """Give everything its final name, or nothing."""
        if not self.exists:
            try:
                os.rename(self.folder, self.target)
            except OSError as error:
                raise InputError(_cannot_write(self.target, error)) from error
            self.parents = []
            return
        names = sorted(os.listdir(self.folder), key=lambda name: (name == SUMMARY, name))
        replaced = self.folder / f"{_MARK}replaced"
        replaced.mkdir()
        moves = [
            (self.target / name, replaced / name)
            for name in reversed(names)
            if os.path.lexists(self.target / name)
        ]
        moves += [(self.folder / name, self.target / name) for name in names]
        try:
            _rename_all(moves)
        except OSError as error:
            raise InputError(_cannot_write(self.target, error)) from error

    def close(self) -> None:
        """Remove what was not published, and the parents made for it where they are empty."""
        shutil.rmtree(self.folder, ignore_errors=True)
        for parent in reversed(self.parents):
            with contextlib.suppress(OSError):
                parent.rmdir()


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
        raise InputError(f"The output {path} is a file, and a folder is needed; name another one.")
    try:
        entries = os.listdir(target) if target.is_dir() else []
    except OSError as error:
        raise InputError(_cannot_write(path, error)) from error
    if not overwrite and any(not name.startswith(_MARK) for name in entries):
        raise InputError(
            f"The output folder {path} is not empty; name another one, or overwrite the "
            "results in it.",
            "overwrite",
        )


def _unfinished_name() -> str:
    return f"{_MARK}{secrets.token_hex(6)}"


def _cannot_write(path: Path | str, error: OSError) -> str:
    reason = _REASONS.get(error.errno or 0, f"{error.strerror or error}; choose another place")
    return f"Cannot write {path}: {reason}."
