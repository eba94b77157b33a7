"""Atomic writes: a file is written completely or left as it was."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import BinaryIO

from gscompleter.system.errors import FullDiskError, OutputError, quote_value
from gscompleter.system.files.renaming import replace
from gscompleter.system.files.unfinished import give_signs, make_unfinished_name

ACCESS_LIST = "system.posix_acl_access"
"""Attribute of a file that lists further users who may read or write it."""

FULL_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""Numbers of errors of a disk without space, of a full quota and of a limit of a file's size."""


@contextmanager
def replace_file(path: Path | str, keep_existing: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file that is renamed to `path` once it is completely on the disk.

    An existing file survives every failure, and its permissions go over to the new one. With
    `keep_existing`, a file that another process wrote at `path` meanwhile is kept, where the file
    system has hard links. A device or a pipe is never replaced by a file.
    """
    # The target of a symbolic link is replaced, not the link.
    target = Path(os.path.realpath(path))
    with convert_write_errors(path):
        refuse_special_file(target)
        temporary = target.with_name(make_unfinished_name(target.name))
        try:
            # A private file has no moment at which others may open it, and what takes the place of
            # a file begins as private as any.
            mode = 0o600 if target.exists() else 0o666
            opener = partial(os.open, mode=mode)
            with open(temporary, "xb", opener=opener) as file, give_signs(temporary):
                keep_permissions(target, temporary)
                yield file
                file.flush()
                os.fsync(file.fileno())
            # Unlike a rename, a hard link fails if the name is taken.
            if keep_existing:
                with suppress(OSError):
                    os.link(temporary, target)
            if not (keep_existing and target.exists()):
                replace(temporary, target)
        finally:
            with suppress(OSError):
                temporary.unlink()


def keep_permissions(old: Path, new: Path) -> None:
    """Give a file the mode, and where possible the owner and the access list, of one it replaces.

    Nothing happens if there is no such file, or on a system without owners and modes.
    """
    try:
        status = os.lstat(old)
    except OSError:
        return
    if not hasattr(os, "chown") or not stat.S_ISREG(status.st_mode):
        return
    # Only root gives files away, and the group has to be one of the user's.
    for owner, group in ((-1, status.st_gid), (status.st_uid, -1)):
        with suppress(OSError):
            os.chown(new, owner, group)
    keep_access_list(old, new)
    mode = stat.S_IMODE(status.st_mode) & 0o777
    with suppress(OSError):
        # A group that could not be kept may do no more than everybody.
        if os.lstat(new).st_gid != status.st_gid:
            mode &= 0o707 | (mode & 0o007) << 3
        os.chmod(new, mode)


def keep_access_list(old: Path, new: Path) -> None:
    """Give a file the access list of one that it replaces, and none if that has none.

    Nothing happens on systems without such lists. It comes before the mode: of a file with a list
    the group's bits of the mode are a bound of the whole list, and not the rights of the group.
    """
    if not hasattr(os, "getxattr"):  # on Linux alone
        return
    with suppress(OSError):
        try:
            os.setxattr(new, ACCESS_LIST, os.getxattr(old, ACCESS_LIST))
        except OSError:
            # A folder may give each new file a list, by which others could read a private one.
            os.removexattr(new, ACCESS_LIST)


def refuse_special_file(path: Path) -> None:
    """Raise an OSError if there is something other than a regular file at a path without links."""
    # What is still a link after `os.path.realpath` leads back to itself.
    if os.path.islink(path):
        raise OSError(errno.ELOOP, "it is a loop of symbolic links")
    if os.path.isdir(path):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if os.path.lexists(path) and not os.path.isfile(path):
        raise OSError(errno.EINVAL, "it is a device or a pipe, no file")


@contextmanager
def convert_write_errors(path: Path | str, numbers: Container[int] | None = None) -> Iterator[None]:
    """Convert errors of the operating system in the block to OutputError: `path` is not written.

    With `numbers`, those of other error numbers (`errno`) are left as they are.
    """
    try:
        yield
    except OSError as error:
        if numbers is not None and error.errno not in numbers:
            raise
        folder = Path(path).parent
        if error.errno == errno.ENOENT and not os.path.isdir(folder):
            raise OutputError(
                f"Cannot write {quote_value(Path(path))}: there is no folder "
                f"{quote_value(folder)}; make it, or choose another place."
            ) from error
        sentence = f"Cannot write {quote_value(Path(path))}: {error.strerror or error}"
        if error.errno in FULL_DISK_ERRORS:
            raise FullDiskError(f"{sentence}; free some space, or choose another place.") from error
        raise OutputError(f"{sentence}; choose another place.") from error
