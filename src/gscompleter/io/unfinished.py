"""Files and folders that are not finished: nobody takes them for results, and none stays for ever.

Whoever writes one holds a lock on it, which the kernel takes back when the process ends, however
it ends. What nobody holds is a leftover of a process that was killed.
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
except ImportError:  # not a POSIX system: there are no locks, and leftovers stay
    fcntl = None  # type: ignore[assignment]

MARK = ".gscompleter-"
"""How the name of everything unfinished begins."""


def create_file(folder: Path) -> tuple[Path, BinaryIO]:
    """A new file in `folder`, locked until it is closed."""
    while True:
        path = folder / _new_name()
        file = path.open("xb")
        if locked(file.fileno(), wait=True) is not False and os.fstat(file.fileno()).st_nlink:
            return path, file
        file.close()  # it was cleaned up before it was locked


def create_folder(folder: Path) -> tuple[Path, int]:
    """A new folder in `folder`, and the descriptor that locks it until it is closed."""
    while True:
        path = folder / _new_name()
        path.mkdir()
        with contextlib.suppress(FileNotFoundError):
            lock = os.open(path, os.O_RDONLY)
            locked(lock, wait=True)
            if path.exists():
                return path, lock
            os.close(lock)


@contextlib.contextmanager
def abandoned(folder: Path) -> Iterator[list[Path]]:
    """What killed processes left in `folder`; nobody else handles it meanwhile.

    Only what was made on this machine is listed: whether the locks of others are seen depends on
    the file system.
    """
    found: list[Path] = []
    with contextlib.ExitStack() as locks:
        for path in _made_here(folder):
            with contextlib.suppress(OSError):
                lock = os.open(path, os.O_RDONLY)
                locks.callback(os.close, lock)
                if locked(lock, wait=False):
                    found.append(path)
        yield found


def remove_abandoned(folder: Path) -> None:
    """Remove what killed processes left in `folder`, as far as we may."""
    with abandoned(folder) as found:
        for path in found:
            remove(path)


def remove(path: Path) -> None:
    """Remove a file or folder, as far as we may."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    with contextlib.suppress(OSError):
        path.unlink()


def _made_here(folder: Path) -> list[Path]:
    with contextlib.suppress(OSError):
        return [folder / name for name in os.listdir(folder) if name.startswith(_prefix())]
    return []


def _prefix() -> str:
    return f"{MARK}{re.sub(r'[^A-Za-z0-9]', '', socket.gethostname())[:32]}-"


def _new_name() -> str:
    return f"{_prefix()}{secrets.token_hex(6)}"


def locked(descriptor: int, wait: bool) -> bool | None:
    """Lock it; False where another holds it, None where the file system knows no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
