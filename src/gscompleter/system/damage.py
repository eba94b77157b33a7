"""Defects of damaged files, in words for the person who has the file.

Decoders speak of their buffers, shapes and objects, which tells nobody what to do. A reader that
knows what is missing raises `DamagedError`; `describe_damage` finds words for all other errors.
"""

from __future__ import annotations

import json
import re
import zipfile

from gscompleter.system.errors import InputError, quote_value

GENERAL = "its content is damaged"
TOO_SHORT = "it ends too early, as a download that was cut does"
_KEY = re.compile(r"[\w.:-]{1,60}")
"""Names of entries that are worth quoting."""
_SHORT_IMAGE = re.compile(r"truncated|end of (?:file|data)", re.IGNORECASE)
"""Words of Pillow for an image that ends too early."""


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
        return TOO_SHORT if _SHORT_IMAGE.search(str(error)) else GENERAL
    key = error.args[0] if isinstance(error, KeyError) and error.args else None
    if isinstance(key, str) and _KEY.fullmatch(key):
        return f"it lacks the entry '{key}'"
    return GENERAL


def _describe_json_error(error: json.JSONDecodeError) -> str:
    # A file that was cut is wrong at its very end, or in a text whose quotation mark is missing.
    is_cut = error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated")
    if is_cut and error.doc.strip():
        return TOO_SHORT
    return f"line {error.lineno}, column {error.colno}"


def check_rows(num_bytes: int, width: int, count: int, what: str = "Gaussians") -> None:
    """Raise DamagedError if `num_bytes` bytes are too few for `count` rows of `width` bytes."""
    whole = max(num_bytes, 0) // max(width, 1)
    if width > 0 and whole < count:
        raise DamagedError(f"it ends after {whole:,} of {quote_value(f'{count:,}')} {what}")
