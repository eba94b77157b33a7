"""Places for the files of a batch: a local folder, or one of a store that fsspec reaches.

Both write whole files. In a folder one process at a time holds a claim: a lock that the kernel
releases if the process is killed. A store has no locks, so processes share its jobs by shards only.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gscompleter.errors import InputError, OutputError, quote_value
from gscompleter.io.files import replace_file
from gscompleter.io.unfinished import UNFINISHED_PREFIX, acquire_lock


def open_place(out: str) -> Place:
    """Open a path or an address such as `s3://bucket/folder`."""
    if is_address(out):
        return StorePlace(out.rstrip("/"), open_store(out))
    return FolderPlace(Path(out))


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
    """A folder of a file system; paths in it are relative, with slashes."""

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
        """Write a file atomically; raise OutputError if that fails."""
        make_folder((self.root / path).parent)
        with replace_file(self.root / path) as file:
            file.write(content)

    def remove(self, path: str) -> None:
        """Remove a file if it exists."""
        (self.root / path).unlink(missing_ok=True)

    def list_names(self, folder: str) -> set[str]:
        """List the names in a folder, without unfinished files; empty if it does not exist."""
        try:
            names = os.listdir(self.root / folder)
        except FileNotFoundError:
            return set()
        except OSError as error:
            raise InputError(
                f"{quote_value(self.root / folder)} cannot be read: {error.strerror}; name another."
            ) from error
        return {name for name in names if not name.startswith(UNFINISHED_PREFIX)}

    @contextlib.contextmanager
    def open_folder(self, path: str) -> Iterator[Path]:
        """Yield the folder itself; `complete` writes it atomically."""
        make_folder((self.root / path).parent)
        yield self.root / path

    @contextlib.contextmanager
    def hold_claim(self, path: str) -> Iterator[int | None]:
        """Hold a claim; yield the number of holders killed before, or None if it is held.

        The file has one byte per holder. Without locks in the file system all processes get it.
        """
        target = self.root / path
        make_folder(target.parent)
        with convert_write_errors(target):
            descriptor = os.open(target, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            # The last holder may have removed the file that has just been opened.
            if acquire_lock(descriptor, wait=False) is False or not os.fstat(descriptor).st_nlink:
                yield None
                return
            try:
                lost = os.fstat(descriptor).st_size
                with convert_write_errors(target):
                    os.write(descriptor, b".")
                yield lost
            finally:
                target.unlink(missing_ok=True)
        finally:
            os.close(descriptor)

    def is_held(self, path: str) -> bool:
        """Return True if any process holds the claim."""
        try:
            with (self.root / path).open("rb") as file:
                return acquire_lock(file.fileno(), wait=False) is False
        except FileNotFoundError:
            return False


@dataclass(frozen=True)
class StorePlace:
    """A folder of a store, with the methods of `FolderPlace`."""

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
        """Write an object; raise OutputError if that fails."""
        with convert_write_errors(self._resolve(path)):
            self._make_parent(path)
            self.store.pipe_file(self._resolve(path), content)

    def remove(self, path: str) -> None:
        """Remove an object if it exists."""
        with contextlib.suppress(FileNotFoundError):
            self.store.rm_file(self._resolve(path))

    def list_names(self, folder: str) -> set[str]:
        """List the names in a folder; empty if it does not exist."""
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
        with TemporaryDirectory(prefix="gscompleter-") as temporary:
            made = Path(temporary) / "result"
            yield made
            with convert_write_errors(self._resolve(path)):
                for file in sorted(p for p in made.rglob("*") if p.is_file()):
                    target = f"{path}/{file.relative_to(made).as_posix()}"
                    self._make_parent(target)
                    self.store.put_file(str(file), self._resolve(target))

    @contextlib.contextmanager
    def hold_claim(self, path: str) -> Iterator[int]:
        """Count a process that begins; yield the number of those that were killed."""
        lost = len(self.read(path) or b"")
        self.write(path, b"." * (lost + 1))
        try:
            yield lost
        finally:
            self.remove(path)

    def is_held(self, path: str) -> bool:
        """Return False: nobody holds a claim in a store."""
        return False

    def _make_parent(self, path: str) -> None:
        self.store.makedirs(self._resolve(path).rsplit("/", 1)[0], exist_ok=True)

    def _resolve(self, path: str) -> str:
        return f"{self.name}/{path}".rstrip("/")


Place = FolderPlace | StorePlace
"""The folder of a batch."""


def make_folder(folder: Path) -> None:
    """Create a folder; raise OutputError if that fails."""
    with convert_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def convert_write_errors(path: Path | str) -> Iterator[None]:
    """Turn an OSError of the body into OutputError, which ends the run."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        reason = "there is no space left" if full else error.strerror or error
        raise OutputError(
            f"Cannot write {quote_value(path)}: {reason}; free some space or choose another place."
        ) from error
