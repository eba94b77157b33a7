"""Unfinished files and folders, which are never taken for results.

The writer holds a lock, which the kernel releases when the process ends. An unlocked entry is a
leftover of a killed process.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # not POSIX: no locks, and leftovers stay
    fcntl = None  # type: ignore[assignment]

UNFINISHED_PREFIX = ".gscompleter-"
"""Prefix of the names of unfinished entries."""


def create_file(folder: Path) -> tuple[Path, BinaryIO]:
    """Create a file in `folder`, locked until it is closed."""
    while True:
        path = folder / _make_name()
        file = path.open("xb")
        if acquire_lock(file.fileno(), wait=True) is not False and os.fstat(file.fileno()).st_nlink:
            return path, file
        file.close()  # another process removed it before it was locked


def create_folder(folder: Path) -> tuple[Path, int]:
    """Create a folder in `folder`; the returned descriptor locks it until it is closed."""
    while True:
        path = folder / _make_name()
        path.mkdir()
        with contextlib.suppress(FileNotFoundError):
            lock = os.open(path, os.O_RDONLY)
            acquire_lock(lock, wait=True)
            if path.exists():
                return path, lock
            os.close(lock)


@contextlib.contextmanager
def lock_abandoned(folder: Path) -> Iterator[list[Path]]:
    """Lock and list the leftovers of killed processes of this machine in `folder`."""
    found: list[Path] = []
    with contextlib.ExitStack() as locks:
        for path in _list_own_entries(folder):
            with contextlib.suppress(OSError):
                lock = os.open(path, os.O_RDONLY)
                locks.callback(os.close, lock)
                if acquire_lock(lock, wait=False):
                    found.append(path)
        yield found


def remove_abandoned(folder: Path) -> None:
    """Remove leftovers of killed processes in `folder`, as far as permitted."""
    with lock_abandoned(folder) as found:
        for path in found:
            remove(path)


def remove(path: Path) -> None:
    """Remove a file or folder, as far as permitted."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    with contextlib.suppress(OSError):
        path.unlink()


def _list_own_entries(folder: Path) -> list[Path]:
    with contextlib.suppress(OSError):
        return [folder / name for name in os.listdir(folder) if name.startswith(_make_prefix())]
    return []


def _make_prefix() -> str:
    return f"{UNFINISHED_PREFIX}{re.sub(r'[^A-Za-z0-9]', '', socket.gethostname())[:32]}-"


def _make_name() -> str:
    return f"{_make_prefix()}{secrets.token_hex(6)}"


def acquire_lock(descriptor: int, wait: bool) -> bool | None:
    """Lock a descriptor; False if another process holds it, None if locks are unsupported."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
