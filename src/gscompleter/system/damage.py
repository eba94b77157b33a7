"""Defects of damaged files, in words for the person who has the file.

Decoders speak of their buffers, shapes and objects, which tells nobody what to do. A reader that
knows what is missing raises `DamagedError`; `describe_damage` finds words for all other errors.
"""

from __future__ import annotations

import json
import re
import zipfile
import zlib

from gscompleter.system.errors import InputError, quote_value

GENERAL = "its content is damaged"
TOO_SHORT = "it ends too early, as a download that was cut does"
_ENTRY_NAME = re.compile(r"[\w./:-]{1,60}")
"""Keys that name an entry of a file; others are sentences, or damaged themselves."""
_ARCHIVE_ENTRY = re.compile(r"There is no item named '(.+)' in the archive")
"""Key of the error of `zipfile` for an entry that is missing: a sentence around its name."""
_ENDS_EARLY = re.compile(r"truncated|end of (?:file|data)", re.IGNORECASE)
"""Words of Pillow and zlib for data that end too early."""


class DamagedError(ValueError):
    """A defect that a reader found; its message is a clause on the file, such as "it is empty"."""


def describe_damage(error: BaseException) -> str:
    """Describe in a clause why a file cannot be read, whatever error its decoder raised."""
    if isinstance(error, (DamagedError, InputError)):
        return str(error).removesuffix(".")
    if isinstance(error, json.JSONDecodeError):
        return _describe_json_error(error)
    if isinstance(error, UnicodeDecodeError):
        return "it is no text in UTF-8"
    if isinstance(error, EOFError):
        return TOO_SHORT
    # The file may be whole, or be damaged and claim more than it has: either way this is true.
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    if isinstance(error, zlib.error):
        return TOO_SHORT if _ENDS_EARLY.search(str(error)) else GENERAL
    if isinstance(error, zipfile.BadZipFile):
        return "its archive is damaged, or was cut before the list of its files"
    # Pillow is not imported for its errors, which nobody raises without it.
    kind = type(error).__name__
    if kind == "DecompressionBombError":
        # "Image size (N pixels) exceeds limit of M pixels", then a guess at an attack.
        return str(error).partition(",")[0]
    if kind == "UnidentifiedImageError":
        return "it does not begin as an image does"
    if isinstance(error, OSError):
        if error.errno is not None and error.strerror:
            return error.strerror
        return TOO_SHORT if _ENDS_EARLY.search(str(error)) else GENERAL
    return _describe_missing_entry(error) if isinstance(error, KeyError) else GENERAL


def _describe_missing_entry(error: KeyError) -> str:
    key = error.args[0] if error.args else None
    if not isinstance(key, str):
        return GENERAL
    in_archive = _ARCHIVE_ENTRY.fullmatch(key)
    name = key if in_archive is None else in_archive[1]
    return f"it lacks the entry '{name}'" if _ENTRY_NAME.fullmatch(name) else GENERAL


def _describe_json_error(error: json.JSONDecodeError) -> str:
    if not error.doc.strip():
        return "it is empty"
    # A file that was cut is wrong at its very end, or in a text whose quotation mark is missing.
    is_cut = error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated")
    return TOO_SHORT if is_cut else f"line {error.lineno}, column {error.colno}"


def check_rows(num_bytes: int, width: int, count: int, what: str = "Gaussians") -> None:
    """Raise DamagedError if `num_bytes` bytes are too few for `count` rows of `width` bytes."""
    whole = max(num_bytes, 0) // max(width, 1)
    if width > 0 and whole < count:
        raise DamagedError(f"it ends after {whole:,} of {quote_value(f'{count:,}')} {what}")
