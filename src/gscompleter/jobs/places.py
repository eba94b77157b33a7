"""Places for the files of a batch: a local folder, or one of a store that fsspec reaches.

Both write files atomically, and only one process at a time holds a claim: in a folder a file lock,
released by the kernel if the process is killed; in a store a small object that expires unless its
holder renews it.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any, Protocol, runtime_checkable

from gscompleter.errors import InputError, OutputError, quote_value
from gscompleter.io.files import UNFINISHED_PREFIX, replace_file

try:
    import fcntl
except ImportError:  # not POSIX: no locks
    fcntl = None  # type: ignore[assignment]

LEASE_SECONDS = 90.0
"""Time without renewal after which a claim in a store expires; clocks must agree within it."""
RENEWAL_SECONDS = 20.0
"""Interval between renewals."""


@runtime_checkable
class Place(Protocol):
    """The folder of a batch; paths in it are relative, with slashes."""

    @property
    def name(self) -> str:
        """Path or address as given by the user."""
        ...

    def read(self, path: str) -> bytes | None:
        """Read a file, or return None if it does not exist."""
        ...

    def write(self, path: str, content: bytes) -> None:
        """Write a file atomically; raise OutputError if that fails."""
        ...

    def remove(self, path: str) -> None:
        """Remove a file if it exists."""
        ...

    def list_names(self, folder: str) -> set[str]:
        """List the names in a folder, without unfinished files; empty if it does not exist."""
        ...

    def open_folder(self, path: str) -> AbstractContextManager[Path]:
        """Yield a local folder whose content is at `path` when the body ends."""
        ...

    def hold_claim(self, path: str) -> AbstractContextManager[int | None]:
        """Hold a claim; yield the number of holders killed before, or None if it is held."""
        ...

    def is_held(self, path: str) -> bool:
        """Return True if any process holds the claim."""
        ...


def open_place(out: str) -> Place:
    """Open a path or an address such as `s3://bucket/folder`."""
    return (
        StorePlace(out.rstrip("/"), open_store(out)) if is_address(out) else FolderPlace(Path(out))
    )


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


@dataclass(frozen=True)
class FolderPlace:
    """A folder of a local or network file system."""

    root: Path

    @property
    def name(self) -> str:
        """Path of the folder."""
        return str(self.root)

    def read(self, path: str) -> bytes | None:
        """Read a file, or return None if it does not exist."""
        try:
            return (self.root / path).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def write(self, path: str, content: bytes) -> None:
        """Write a file atomically."""
        target = self.root / path
        make_folder(target.parent)
        with replace_file(target) as file:
            file.write(content)

    def remove(self, path: str) -> None:
        """Remove a file if it exists."""
        (self.root / path).unlink(missing_ok=True)

    def list_names(self, folder: str) -> set[str]:
        """List the names in a folder, without unfinished files."""
        try:
            return {
                n for n in os.listdir(self.root / folder) if not n.startswith(UNFINISHED_PREFIX)
            }
        except FileNotFoundError:
            return set()
        except OSError as error:
            raise InputError(
                f"{quote_value(self.root / folder)} cannot be read: {error.strerror}; name another."
            ) from error

    @contextlib.contextmanager
    def open_folder(self, path: str) -> Iterator[Path]:
        """Yield the folder itself; `complete` writes it atomically."""
        make_folder((self.root / path).parent)
        yield self.root / path

    @contextlib.contextmanager
    def hold_claim(self, path: str) -> Iterator[int | None]:
        """Lock a file. Without locks in the file system every process gets the claim."""
        target = self.root / path
        make_folder(target.parent)
        try:
            descriptor = os.open(target, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise make_write_error(target, error) from error
        try:
            # The last holder may have removed the file that has just been opened.
            if acquire_lock(descriptor) is False or not os.fstat(descriptor).st_nlink:
                yield None
                return
            lost = parse_count(os.read(descriptor, 16))
            write_count(target, descriptor, lost + 1)
            try:
                yield lost
            finally:
                target.unlink(missing_ok=True)
        finally:
            os.close(descriptor)

    def is_held(self, path: str) -> bool:
        """Return True if any process holds the claim."""
        try:
            descriptor = os.open(self.root / path, os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            return acquire_lock(descriptor) is False
        finally:
            os.close(descriptor)


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


def parse_count(content: bytes) -> int:
    """Parse the number in a claim; 0 for a new one."""
    return int(content) if content.isdigit() else 0


def write_count(path: Path, descriptor: int, count: int) -> None:
    """Count one more started process, in case it is killed."""
    try:
        os.pwrite(descriptor, str(count).encode(), 0)
    except OSError as error:
        if not os.fstat(descriptor).st_size:
            path.unlink(missing_ok=True)
        raise make_write_error(path, error) from error


def make_folder(folder: Path) -> None:
    """Create a folder; raise OutputError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise make_write_error(folder, error) from error


def make_write_error(path: Path, error: OSError) -> OutputError:
    """Return the OutputError for a write error."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    reason = "there is no space left" if full else error.strerror
    return OutputError(
        f"Cannot write {quote_value(path)}: {reason}; free some space or choose another place."
    )


@dataclass(frozen=True)
class StorePlace:
    """A folder of a store."""

    name: str
    store: Any
    """A file system of fsspec."""

    def read(self, path: str) -> bytes | None:
        """Read an object, or return None if it does not exist."""
        try:
            return bytes(self.store.cat_file(self._resolve(path)))
        except FileNotFoundError:
            return None

    def write(self, path: str, content: bytes) -> None:
        """Write an object."""
        with self._convert_errors(path):
            self.store.pipe_file(self._resolve(path), content)

    def remove(self, path: str) -> None:
        """Remove an object if it exists."""
        with contextlib.suppress(FileNotFoundError):
            self.store.rm_file(self._resolve(path))

    def list_names(self, folder: str) -> set[str]:
        """List the names in a folder."""
        # Listings are cached, and other processes may have written since.
        self.store.invalidate_cache()
        try:
            found = self.store.ls(self._resolve(folder), detail=False)
        except FileNotFoundError:
            return set()
        return {name.rstrip("/").rsplit("/", 1)[-1] for name in found}

    @contextlib.contextmanager
    def open_folder(self, path: str) -> Iterator[Path]:
        """Yield a temporary folder, and upload its files when the body ends."""
        from tempfile import TemporaryDirectory

        with TemporaryDirectory(prefix="gscompleter-") as temporary:
            made = Path(temporary) / "result"
            yield made
            with self._convert_errors(path):
                for file in sorted(p for p in made.rglob("*") if p.is_file()):
                    target = self._resolve(f"{path}/{file.relative_to(made).as_posix()}")
                    self.store.makedirs(target.rsplit("/", 1)[0], exist_ok=True)
                    self.store.put_file(str(file), target)

    @contextlib.contextmanager
    def hold_claim(self, path: str) -> Iterator[int | None]:
        """Create an object exclusively; two processes may both take over an expired one."""
        holder = secrets.token_hex(8)
        lost = self._take_claim(path, holder)
        if lost is None:
            yield None
            return
        over = Event()
        renewing = Thread(target=self._renew, args=(path, holder, lost, over), daemon=True)
        renewing.start()
        try:
            yield lost
        finally:
            over.set()
            renewing.join()
            self.remove(path)

    def is_held(self, path: str) -> bool:
        """Return True if any process holds the claim."""
        claim = self.read(path)
        return claim is not None and not is_expired(claim)

    def _take_claim(self, path: str, holder: str) -> int | None:
        """Take a claim; return the number of holders killed before, or None if it is held."""
        with self._convert_errors(path):
            try:
                self.store.pipe_file(self._resolve(path), make_lease(holder, 0), mode="create")
                return 0
            except FileExistsError:
                pass
            claim = self.read(path)
            if claim is None or not is_expired(claim):
                return None
            lost = 1 + int(json.loads(claim)["lost"])
            self.store.pipe_file(self._resolve(path), make_lease(holder, lost))
            taken = self.read(path)
            return lost if taken is not None and json.loads(taken)["holder"] == holder else None

    def _renew(self, path: str, holder: str, lost: int, over: Event) -> None:
        while not over.wait(RENEWAL_SECONDS):
            with contextlib.suppress(OSError):
                self.store.pipe_file(self._resolve(path), make_lease(holder, lost))

    @contextlib.contextmanager
    def _convert_errors(self, path: str) -> Iterator[None]:
        try:
            self.store.makedirs(self._resolve(path).rsplit("/", 1)[0], exist_ok=True)
            yield
        except OSError as error:
            raise OutputError(
                f"Cannot write {quote_value(self._resolve(path))}: {error}."
            ) from error

    def _resolve(self, path: str) -> str:
        return f"{self.name}/{path}".rstrip("/")


def make_lease(holder: str, lost: int) -> bytes:
    """Return the content of a claim in a store, renewed now."""
    return json.dumps({"holder": holder, "lost": lost, "renewed": time.time()}).encode()


def is_expired(claim: bytes) -> bool:
    """Return True if a claim in a store has expired."""
    try:
        return time.time() - float(json.loads(claim)["renewed"]) > LEASE_SECONDS
    except (ValueError, KeyError, TypeError):
        return False  # another process is writing it
