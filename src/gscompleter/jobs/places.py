"""The place of a batch's files: a local folder, or one of a store that fsspec reaches.

In a folder one process at a time holds a claim: a lock that the kernel releases if the process is
killed. A store has no locks, so processes share its jobs by shards only.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import UNFINISHED_PREFIX, convert_write_errors, replace_file

try:
    import fcntl
except ImportError:  # not POSIX: no locks
    fcntl = None  # type: ignore[assignment]


def is_address(text: str) -> bool:
    """Return True for an address such as `s3://bucket/folder`, False for a path."""
    return "://" in text


def open_store(address: str) -> Any:
    """Open the fsspec file system of an address; raise InputError if there is none."""
    import fsspec

    try:
        return fsspec.core.url_to_fs(address)[0]
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{quote_value(address)} cannot be reached: {quote_value(str(error))}."
        ) from error


def open_place(out: str | Path) -> Place:
    """Open a path or an address."""
    from fsspec.implementations.local import LocalFileSystem

    if is_address(str(out)):
        return Place(str(out).rstrip("/"), open_store(str(out)), has_locks=False)
    return Place(os.path.abspath(out), LocalFileSystem(), has_locks=True)


@dataclass(frozen=True)
class Place:
    """A folder whose files are written whole; paths in it are relative, with slashes."""

    name: str
    """Path or address."""
    store: Any
    """A file system of fsspec."""
    has_locks: bool
    """True for a local folder."""

    def locate(self, path: str) -> str:
        """Return the path or address of a file."""
        return f"{self.name}/{path}".rstrip("/")

    def read(self, path: str) -> bytes | None:
        """Read a file, or return None if it does not exist."""
        try:
            return bytes(self.store.cat_file(self.locate(path)))
        except (FileNotFoundError, NotADirectoryError):
            return None

    def write(self, path: str, content: bytes) -> None:
        """Write a file whole; raise OutputError if that fails."""
        self._make_parent(path)
        if self.has_locks:
            with replace_file(self.locate(path)) as file:
                file.write(content)
        else:
            with convert_write_errors(self.locate(path)):
                self.store.pipe_file(self.locate(path), content)

    def remove(self, path: str) -> None:
        """Remove a file if it exists."""
        with contextlib.suppress(FileNotFoundError):
            self.store.rm_file(self.locate(path))

    def list_names(self, folder: str) -> set[str]:
        """List the names in a folder, without unfinished files; empty if it does not exist."""
        # Listings of stores are cached, and other processes may have written since.
        self.store.invalidate_cache()
        try:
            found = self.store.ls(self.locate(folder), detail=False)
        except FileNotFoundError:
            return set()
        except OSError as error:
            reason = error.strerror or error
            raise InputError(
                f"{quote_value(self.locate(folder))} cannot be read: {reason}; name another."
            ) from error
        names = {name.rstrip("/").rsplit("/", 1)[-1] for name in found}
        return {name for name in names if not name.startswith(UNFINISHED_PREFIX)}

    @contextlib.contextmanager
    def open_folder(self, path: str) -> Iterator[Path]:
        """Yield a folder that is written whole, or one that is uploaded when the body ends."""
        if self.has_locks:
            self._make_parent(path)
            yield Path(self.locate(path))
            return
        with TemporaryDirectory(prefix="gscompleter-") as temporary:
            made = Path(temporary) / "result"
            yield made
            for file in sorted(p for p in made.rglob("*") if p.is_file()):
                target = f"{path}/{file.relative_to(made).as_posix()}"
                self._make_parent(target)
                with convert_write_errors(self.locate(path)):
                    self.store.put_file(str(file), self.locate(target))

    @contextlib.contextmanager
    def hold_claim(self, path: str) -> Iterator[int | None]:
        """Hold a claim; yield the number of holders killed before, or None if it is held.

        The file has one byte per holder. Without locks all processes get the claim.
        """
        if not self.has_locks:
            lost = len(self.read(path) or b"")
            self.write(path, b"." * (lost + 1))
            try:
                yield lost
            finally:
                self.remove(path)
            return
        self._make_parent(path)
        with convert_write_errors(self.locate(path)):
            descriptor = os.open(self.locate(path), os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            # The last holder may have removed the file that has just been opened.
            if acquire_lock(descriptor) is False or not os.fstat(descriptor).st_nlink:
                yield None
                return
            try:
                lost = os.fstat(descriptor).st_size
                with convert_write_errors(self.locate(path)):
                    os.write(descriptor, b".")
                yield lost
            finally:
                self.remove(path)
        finally:
            os.close(descriptor)

    def is_held(self, path: str) -> bool:
        """Return True if any process holds the claim."""
        if not self.has_locks:
            return False
        try:
            with Path(self.locate(path)).open("rb") as file:
                return acquire_lock(file.fileno()) is False
        except FileNotFoundError:
            return False

    def _make_parent(self, path: str) -> None:
        with convert_write_errors(self.locate(path)):
            self.store.makedirs(self.locate(path).rsplit("/", 1)[0], exist_ok=True)


def acquire_lock(descriptor: int) -> bool | None:
    """Lock a descriptor; False if another process holds it, None if locks are unsupported."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
