"""Names of unfinished files and folders, which say whose they are.

    .gscompleter-TARGET-MACHINE-PID-START-RANDOM

TARGET stands for the name of the result and MACHINE for this computer since it was started. START
is the time at which the process began, so that another process of the same PID is noticed. A run
that is killed leaves such entries behind; the next one removes them once their process is gone.
Of a process that cannot be seen, signs count: its owner touches an entry twice a minute. That is
one before a restart, in another container or on another machine, and any on macOS and Windows,
which do not tell when a process began.
"""

from __future__ import annotations

import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from gscompleter.system.errors import quote_value

UNFINISHED_PREFIX = ".gscompleter-"
"""Prefix of the names of unfinished entries, which are never taken for results."""
REPLACED_SUFFIX = ".old"
"""Suffix of the folder beside a draft that takes the files which the draft replaces."""

SIGN_SECONDS = 30.0
"""Interval at which the owner of an entry shows that it still runs."""
LEASE_SECONDS = 180.0
"""Time without a sign after which an entry of another machine counts as left behind."""
MAX_AHEAD_SECONDS = 30.0
"""Time by which a sign may lie in the future, where the clocks of two machines differ. One that is
farther ahead was given before a clock was set back."""

MAX_GIVEN_LENGTH = 60
"""Longest path of the file in the sentence about it, which as a whole may have 300 characters."""
MAX_ENTRY_LENGTH = 100
"""Longest path of the entry in that sentence."""

_UNFINISHED_NAME = re.compile(
    re.escape(UNFINISHED_PREFIX)
    + r"(?P<target>[0-9a-f]{8})-(?P<machine>[0-9a-f]{8})-(?P<pid>\d+)-(?P<start>\d+)-[0-9a-f]{8}"
    + rf"(?:{re.escape(REPLACED_SUFFIX)})?"
)


@dataclass(frozen=True)
class Unfinished:
    """An unfinished entry of a folder."""

    path: Path
    target: str
    """Digest of the name of the result."""
    machine: str
    pid: int
    start: int

    def is_running(self) -> bool:
        """Return True if the process that writes the entry is, or may be, still running."""
        # The system may not list processes with the times at which they began; then signs count.
        can_see_processes = _read_start(os.getpid()) is not None
        if self.machine == _describe_machine() and can_see_processes:
            # A process of the same number that began at another time is not the owner.
            start = _read_start(self.pid)
            return _is_hidden(self.pid) if start is None else start == self.start
        try:
            status = self.path.lstat()
            # The clock of the disk counts, which on a server is not that of this machine.
            age = _read_disk_time(self.path) - status.st_mtime
        except OSError:
            return False
        return -MAX_AHEAD_SECONDS <= age < LEASE_SECONDS

    def is_own(self) -> bool:
        """Return True if this process writes the entry."""
        return self.path.name.startswith(f"{UNFINISHED_PREFIX}{self.target}-{_describe_owner()}-")

    def describe_file(self, given: Path) -> str:
        """Write the sentence that refuses the file `given`, which the owner is writing.

        Whether a process on another machine still lives may be known to the user alone.
        """
        whole = str(self.path)
        entry = whole if len(whole) <= MAX_ENTRY_LENGTH else self.path.name
        return (
            f"Another run (process {self.pid}) is writing {quote_value(given, MAX_GIVEN_LENGTH)}; "
            "wait for its end, or name another file; if it was killed, delete "
            f"{quote_value(entry, MAX_ENTRY_LENGTH)}."
        )

    def describe_folder(self, given: Path) -> str:
        """Write the sentence that refuses the folder `given`, which the owner is writing."""
        # An entry of a folder is not to be deleted by hand: it may hold results that a killed run
        # moved already, and the next run finishes its renames.
        return (
            f"Another run (process {self.pid}) is writing {quote_value(given)}; wait for its end, "
            "or name another folder; if it was killed, try again in "
            f"{LEASE_SECONDS / 60:.0f} minutes."
        )

    def remove(self) -> None:
        """Remove the entry, as far as this user may."""
        shutil.rmtree(self.path, ignore_errors=True)
        with suppress(OSError):
            self.path.unlink()


def make_unfinished_name(target: str) -> str:
    """Make a new name for an unfinished entry of this process that will be called `target`."""
    return _make_name(digest_target(target))


def digest_target(name: str) -> str:
    """Return the part of an unfinished name that stands for the name of the result."""
    return _digest(os.fsencode(name))


def is_unfinished(name: str) -> bool:
    """Return True for the name of an unfinished entry; others that only begin alike are foreign."""
    return _UNFINISHED_NAME.fullmatch(name) is not None


def list_unfinished(folder: Path, target: str | None = None) -> list[Unfinished]:
    """List the unfinished entries of a folder, or those of one result in it."""
    try:
        names = os.listdir(folder)
    except OSError:
        return []
    entries = []
    for name in names:
        match = _UNFINISHED_NAME.fullmatch(name)
        if match is None or (target is not None and match["target"] != digest_target(target)):
            continue
        pid = int(match["pid"])
        start = int(match["start"])
        entries.append(Unfinished(folder / name, match["target"], match["machine"], pid, start))
    return entries


def remove_left_behind(folder: Path, target: str | None = None) -> None:
    """Remove unfinished entries of a folder whose process is gone."""
    for entry in list_unfinished(folder, target):
        if not entry.is_running():
            entry.remove()


def remove_left_behind_below(folder: Path) -> None:
    """Remove unfinished entries whose process is gone from a folder and all folders in it."""
    for home, folders, _ in os.walk(folder):
        remove_left_behind(Path(home))
        # `os.walk` goes on with what is left in its list.
        folders[:] = [name for name in folders if not is_unfinished(name)]


@contextmanager
def give_signs(path: Path) -> Iterator[None]:
    """Show other machines during the block that the owner of a draft or file is running."""
    is_over = threading.Event()

    def touch() -> None:
        while not is_over.wait(SIGN_SECONDS):
            with suppress(OSError):
                os.utime(path)

    thread = threading.Thread(target=touch, name="signs", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()


def _make_name(digest: str) -> str:
    return f"{UNFINISHED_PREFIX}{digest}-{_describe_owner()}-{os.urandom(4).hex()}"


def _describe_owner() -> str:
    """Return the part of an unfinished name that stands for this process."""
    return f"{_describe_machine()}-{os.getpid()}-{_read_start(os.getpid()) or 0}"


@cache
def _describe_machine() -> str:
    """Return a digest of this machine since its start, and of its list of processes.

    Containers of one machine can have the same host name, but each numbers its own processes.
    """
    import socket  # help pages do not wait for it

    parts = [socket.gethostname()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text("ascii"))
    with suppress(OSError):
        parts.append(os.readlink("/proc/self/ns/pid"))
    return _digest("\n".join(parts).encode())


def _digest(content: bytes) -> str:
    from hashlib import sha256  # nor for OpenSSL

    return sha256(content).hexdigest()[:8]


def _read_start(pid: int) -> int | None:
    """Return when a process began, in ticks of the kernel.

    0 if the system says that it has ended; None if it says nothing of it.
    """
    try:
        line = Path(f"/proc/{pid}/stat").read_text("utf-8", errors="replace")
    except OSError:
        return None
    # The second field is the name of the program in parentheses and may contain any characters.
    state, *fields = line.rpartition(")")[2].split()
    # A process that was killed stays in the list as a zombie until its parent asks for it.
    return 0 if state in "ZX" else int(fields[18])


def _is_hidden(pid: int) -> bool:
    """Return True if a process of another user runs, whose entry in /proc is hidden."""
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except OSError:
        return False
    return False


def _read_disk_time(entry: Path) -> float:
    """Return the time of the disk of an entry, or of this machine if it cannot be written to."""
    # Named like an entry of this process, so that one which is left behind is removed, too.
    target = entry.name.removeprefix(UNFINISHED_PREFIX).partition("-")[0]
    probe = entry.with_name(_make_name(target))
    try:
        probe.touch(exist_ok=False)
        return probe.stat().st_mtime
    except OSError:
        return time.time()
    finally:
        with suppress(OSError):
            probe.unlink()
