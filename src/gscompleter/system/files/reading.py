"""Safe reading of files from elsewhere: regular files only, of limited size."""

from __future__ import annotations

import json
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO

from gscompleter.system.damage import DamagedError, describe_damage
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.names import is_hidden_name

MAX_BYTES = 1 << 33
"""Largest file that is read at once, in bytes."""
MAX_TEXT = 1 << 23
"""Largest text file, in bytes."""
MAX_LINE = 4096
"""Longest line, in characters, without its line break."""
MAX_JSON = 1 << 29
"""Largest JSON file, in bytes."""
MAX_DIGITS = 20
"""Longest integer in JSON: 64 bits have no more digits."""
MAX_DEPTH = 32
"""Most lists and dictionaries within each other. Lists become arrays, and numpy 1 ends with an
error of its own beyond 32 dimensions, numpy 2 beyond 64."""
BLOCK_BYTES = 1 << 20
"""Bytes that are read at a time from a file of unknown size."""

ZIP_ERRORS = (
    *(EOFError, LookupError, NotImplementedError, OSError, ValueError),
    *(zipfile.BadZipFile, zlib.error),
)
"""Errors that opening an archive and `read_zip_entry` raise of a damaged one."""

_HOLDERS = (list, tuple, dict, set, frozenset)


def check_file(path: Path) -> None:
    """Raise InputError if `path` is not a regular file, without opening it."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise make_read_error(path, error) from error
    if not stat.S_ISREG(mode):
        raise InputError(f"{quote_value(path)} is no regular file; correct the path.")


@contextmanager
def open_file(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file; raise InputError if opening or reading it fails."""
    check_file(path)
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise make_read_error(path, error) from error


def read_head(path: Path, count: int) -> bytes:
    """Read the first `count` bytes of a file, or none if it cannot be read."""
    with suppress(InputError), open_file(path) as file:
        return file.read(count)
    return b""


def hash_file(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal; files of gigabytes are not held in memory."""
    from hashlib import sha256  # help pages do not wait for OpenSSL

    digest = sha256()
    with open_file(path) as file:
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def read_bytes(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read a file of at most `max_bytes` bytes; raise InputError if that fails."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        _check_size(path, size, max_bytes)
        data = file.read(size + 1)
        # Files of /proc state no size, and others may grow.
        while len(data) <= max_bytes and (more := file.read(BLOCK_BYTES)):
            data += more
        _check_size(path, len(data), max_bytes)
        return data


def read_zip_entry(archive: zipfile.ZipFile, name: str, max_bytes: int) -> bytes:
    """Read a file in an archive of at most `max_bytes` bytes, once it is unpacked.

    However little an archive takes, it may hold any number of bytes, and state any other. Raises
    DamagedError for a larger file, one that is encrypted, and one that is not packed by deflate;
    `ZIP_ERRORS` for a damaged archive.
    """
    entry = archive.getinfo(name)
    # Its first flag says so. Python asks for a password by a RuntimeError, as for defects.
    if entry.flag_bits & 1:
        raise DamagedError(f"its {quote_value(name)} is encrypted")
    if entry.file_size > max_bytes:
        claim = f"{entry.compress_size:,} bytes claim to hold {entry.file_size:,}"
        raise DamagedError(f"its {quote_value(name)} is too large: {claim}")
    # Python unpacks other methods at once, whatever the size that is stated.
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise DamagedError(f"its {quote_value(name)} is packed by another method than deflate")
    with archive.open(entry) as file:
        return file.read(entry.file_size)


def is_zip_file(path: Path) -> bool:
    """Check whether a file is an archive with its end; a damaged end is none."""
    try:
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:
        return False


def read_lines(
    path: Path, max_length: int = MAX_LINE, max_bytes: int = MAX_TEXT, errors: str = "replace"
) -> Iterator[str]:
    """Read the lines of a UTF-8 text file one by one; raise InputError if it is too long."""
    with open_file(path) as file:
        _check_size(path, os.fstat(file.fileno()).st_size, max_bytes)
        text = TextIOWrapper(file, encoding="utf-8-sig", errors=errors)
        while line := text.readline(max_length + 1):
            # The size may be unknown, as in `read_bytes`.
            _check_size(path, file.tell(), max_bytes)
            if len(line.removesuffix("\n")) > max_length:
                raise InputError(
                    f"{quote_value(path)} has a line of more than {max_length:,} characters, "
                    "which its format does not allow; copy the file again."
                )
            yield line


def list_entries(folder: Path, pattern: str = "*") -> list[Path]:
    """List what matches a pattern in a folder, by name and without what is hidden."""
    return sorted(path for path in folder.glob(pattern) if not is_hidden_name(path.name))


def list_folders(folder: Path) -> list[Path]:
    """List the folders of a folder by name, without hidden ones; none if it cannot be read."""
    try:
        return [child for child in list_entries(folder) if os.path.isdir(child)]
    except OSError:
        return []


def read_json(path: Path, advice: str) -> Any:
    """Read a JSON file; errors end with `advice`, such as "download it again"."""
    return parse_json(read_bytes(path, MAX_JSON), path, advice)


def parse_json(data: bytes, name: Path | str, advice: str) -> Any:
    """Parse the bytes of a JSON file; `name` and `advice` are for errors."""
    try:
        value = json.loads(data.decode("utf-8-sig"), parse_int=_parse_integer)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{quote_value(name)} is not JSON ({quote_value(describe_damage(error))}); {advice}."
        ) from error
    check_plain(value, name, len(data))
    return value


def _parse_integer(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise DamagedError(f"an integer of {len(digits.lstrip('-'))} digits")
    return int(digits)


def is_json_list(path: Path) -> bool:
    """Return True if the JSON file is a list, by its first character."""
    return read_head(path, 64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")


def check_plain(value: Any, name: Path | str, max_values: int) -> None:
    """Raise InputError if values read from `name` are nested too deeply or too many.

    Repeated values count again, so that a value that contains itself is refused as endless.
    """
    waiting = [(value, 0)]
    count = 0
    while waiting:
        holder, depth = waiting.pop()
        if not isinstance(holder, _HOLDERS):
            continue
        parts = holder.values() if isinstance(holder, dict) else holder
        count += len(parts)
        if depth >= MAX_DEPTH or count > max_values:
            raise InputError(
                f"{quote_value(name)} is nested too deeply or without end; write it again."
            )
        waiting += [(part, depth + 1) for part in parts if isinstance(part, _HOLDERS)]


def _check_size(path: Path, size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise InputError(
            f"{quote_value(path)} has {size:,} bytes, and at most {max_bytes:,} are read; name a "
            "smaller one."
        )


def make_read_error(path: Path, error: Exception) -> InputError:
    """Make the error of a file that the system does not let read."""
    reason = getattr(error, "strerror", None) or "no file can have that name"
    return InputError(f"{quote_value(path)} cannot be read: {reason}; correct the path.")
