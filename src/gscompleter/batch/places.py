"""Where a batch lies: a folder of this machine, or one of a store that fsspec reaches.

Both write a file whole or not at all, and let one process at a time claim a name. A folder of this
machine (or one that machines share by a file system with locks) has claims that the kernel takes
back from a process that was killed. In a store a claim is a small object that its holder renews,
and that counts for nothing once it was not renewed for a while.
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

from gscompleter.errors import InputError, OutputError, quoted
from gscompleter.io.files import replacing
from gscompleter.io.unfinished import MARK, locked

LEASE_SECONDS = 90.0
"""After so many seconds without being renewed a claim in a store counts for nothing. The clocks of
the machines have to agree better than that."""
RENEWAL_SECONDS = 20.0
"""How often its holder renews it."""


@runtime_checkable
class Place(Protocol):
    """The folder of a batch; paths in it are relative, with slashes."""

    @property
    def name(self) -> str:
        """What the user calls it."""
        ...

    def read(self, path: str) -> bytes | None:
        """The content of a file; None where there is none."""
        ...

    def write(self, path: str, content: bytes) -> None:
        """Write a file, whole or not at all; an OutputError where it cannot be."""
        ...

    def remove(self, path: str) -> None:
        """Remove a file where there is one."""
        ...

    def names(self, folder: str) -> set[str]:
        """The names in a folder, empty where there is none; what is unfinished does not count."""
        ...

    def folder(self, path: str) -> AbstractContextManager[Path]:
        """A folder of this machine whose content is at `path` once the body is over."""
        ...

    def claimed(self, path: str) -> AbstractContextManager[int | None]:
        """Hold the claim `path`: how many holders before were killed over it, or None where
        somebody else holds it."""
        ...

    def is_held(self, path: str) -> bool:
        """Whether somebody holds the claim `path`."""
        ...


def place_of(out: str) -> Place:
    """The place that a path or an address such as `s3://bucket/folder` names.

    Raises:
        InputError: where no package reaches it.
    """
    return StorePlace(out.rstrip("/"), store_of(out)) if is_address(out) else FolderPlace(Path(out))


def is_address(text: str) -> bool:
    """Whether `text` is an address rather than a path."""
    return "://" in text


def store_of(address: str) -> Any:
    """The file system of fsspec behind an address; an InputError where there is none."""
    import fsspec

    try:
        return fsspec.core.url_to_fs(address)[0]
    except (ImportError, ValueError) as error:
        raise InputError(f"{quoted(address)} cannot be reached: {quoted(str(error))}.") from error


@dataclass(frozen=True)
class FolderPlace:
    """A folder of this machine, or one that it shares."""

    root: Path

    @property
    def name(self) -> str:
        return str(self.root)

    def read(self, path: str) -> bytes | None:
        try:
            return (self.root / path).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def write(self, path: str, content: bytes) -> None:
        target = self.root / path
        make_folder(target.parent)
        with replacing(target) as file:
            file.write(content)

    def remove(self, path: str) -> None:
        (self.root / path).unlink(missing_ok=True)

    def names(self, folder: str) -> set[str]:
        try:
            return {n for n in os.listdir(self.root / folder) if not n.startswith(MARK)}
        except FileNotFoundError:
            return set()
        except OSError as error:
            raise InputError(
                f"{quoted(self.root / folder)} cannot be read: {error.strerror}; name another."
            ) from error

    @contextlib.contextmanager
    def folder(self, path: str) -> Iterator[Path]:
        """The folder itself: `complete` makes it appear all at once."""
        make_folder((self.root / path).parent)
        yield self.root / path

    @contextlib.contextmanager
    def claimed(self, path: str) -> Iterator[int | None]:
        """By a lock on a file. On a file system that knows no locks everybody holds it: there only
        shards keep processes apart."""
        target = self.root / path
        make_folder(target.parent)
        try:
            descriptor = os.open(target, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise cannot_write(target, error) from error
        try:
            # Whoever held it until a moment ago removed the file that we have opened.
            if locked(descriptor, wait=False) is False or not os.fstat(descriptor).st_nlink:
                yield None
                return
            lost = counted(os.read(descriptor, 16))
            write_count(target, descriptor, lost + 1)
            try:
                yield lost
            finally:
                target.unlink(missing_ok=True)
        finally:
            os.close(descriptor)

    def is_held(self, path: str) -> bool:
        try:
            descriptor = os.open(self.root / path, os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            return locked(descriptor, wait=False) is False
        finally:
            os.close(descriptor)


def counted(content: bytes) -> int:
    """The number that a claim says; 0 for one that is new."""
    return int(content) if content.isdigit() else 0


def write_count(path: Path, descriptor: int, count: int) -> None:
    """Note that one more process has begun the job, in case it never comes back."""
    try:
        os.pwrite(descriptor, str(count).encode(), 0)
    except OSError as error:
        if not os.fstat(descriptor).st_size:
            path.unlink(missing_ok=True)
        raise cannot_write(path, error) from error


def make_folder(folder: Path) -> None:
    """Make `folder` where it is not there; an OutputError where that cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def cannot_write(path: Path, error: OSError) -> OutputError:
    """The sentence for what the system refused."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    reason = "there is no space left" if full else error.strerror
    return OutputError(f"Cannot write {quoted(path)}: {reason}; make room or choose another place.")


@dataclass(frozen=True)
class StorePlace:
    """A folder of a store, by its address."""

    name: str
    store: Any
    """A file system of fsspec."""

    def read(self, path: str) -> bytes | None:
        try:
            return bytes(self.store.cat_file(self._at(path)))
        except FileNotFoundError:
            return None

    def write(self, path: str, content: bytes) -> None:
        with self._writing(path):
            self.store.pipe_file(self._at(path), content)

    def remove(self, path: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            self.store.rm_file(self._at(path))

    def names(self, folder: str) -> set[str]:
        # Listings are cached, and others write meanwhile.
        self.store.invalidate_cache()
        try:
            found = self.store.ls(self._at(folder), detail=False)
        except FileNotFoundError:
            return set()
        return {name.rstrip("/").rsplit("/", 1)[-1] for name in found}

    @contextlib.contextmanager
    def folder(self, path: str) -> Iterator[Path]:
        """A temporary folder; its files are sent once it is complete."""
        from tempfile import TemporaryDirectory

        with TemporaryDirectory(prefix="gscompleter-") as temporary:
            made = Path(temporary) / "result"
            yield made
            with self._writing(path):
                for file in sorted(p for p in made.rglob("*") if p.is_file()):
                    target = self._at(f"{path}/{file.relative_to(made).as_posix()}")
                    self.store.makedirs(target.rsplit("/", 1)[0], exist_ok=True)
                    self.store.put_file(str(file), target)

    @contextlib.contextmanager
    def claimed(self, path: str) -> Iterator[int | None]:
        """By an object that only one can create. Who takes over one that was not renewed may, in
        the same moment, not be alone: then the job is done twice, with the same bytes."""
        holder = secrets.token_hex(8)
        lost = self._taken(path, holder)
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
        claim = self.read(path)
        return claim is not None and not expired(claim)

    def _taken(self, path: str, holder: str) -> int | None:
        """Become the holder: how many were killed before, or None where somebody holds it."""
        with self._writing(path):
            try:
                self.store.pipe_file(self._at(path), lease(holder, 0), mode="create")
                return 0
            except FileExistsError:
                pass
            claim = self.read(path)
            if claim is None or not expired(claim):
                return None
            lost = 1 + int(json.loads(claim)["lost"])
            self.store.pipe_file(self._at(path), lease(holder, lost))
            taken = self.read(path)
            return lost if taken is not None and json.loads(taken)["holder"] == holder else None

    def _renew(self, path: str, holder: str, lost: int, over: Event) -> None:
        while not over.wait(RENEWAL_SECONDS):
            with contextlib.suppress(OSError):
                self.store.pipe_file(self._at(path), lease(holder, lost))

    @contextlib.contextmanager
    def _writing(self, path: str) -> Iterator[None]:
        """Make the folder of `path`; what then cannot be written ends the run."""
        try:
            self.store.makedirs(self._at(path).rsplit("/", 1)[0], exist_ok=True)
            yield
        except OSError as error:
            raise OutputError(f"Cannot write {quoted(self._at(path))}: {error}.") from error

    def _at(self, path: str) -> str:
        return f"{self.name}/{path}".rstrip("/")


def lease(holder: str, lost: int) -> bytes:
    """A claim in a store, renewed now."""
    return json.dumps({"holder": holder, "lost": lost, "renewed": time.time()}).encode()


def expired(claim: bytes) -> bool:
    """Whether a claim in a store was not renewed for long."""
    try:
        return time.time() - float(json.loads(claim)["renewed"]) > LEASE_SECONDS
    except (ValueError, KeyError, TypeError):
        return False  # it is just being written
