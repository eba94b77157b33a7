"""Names of files and folders that every system accepts and tells apart."""

from __future__ import annotations

import re
import unicodedata

DEVICES = re.compile(r"(?:con|prn|aux|nul|com[0-9]|lpt[0-9])(?:\..*)?", re.IGNORECASE)
"""Names that Windows gives to devices, with any ending."""


def make_valid_name(text: str) -> str:
    """Turn a text into the name of a file, which may be empty.

    Windows allows neither most punctuation nor the names of devices, and drops dots at the end.
    """
    name = re.sub(r"[^\w.+-]+", "-", text).rstrip(".")
    return f"_{name}" if DEVICES.fullmatch(name) else name


def make_colmap_name(name: str) -> str:
    """Replace blanks and # in a name: in COLMAP's lists they end it and begin a comment."""
    return re.sub(r"[\s#]", "_", name)


def is_hidden_name(name: str) -> bool:
    """Check whether a file or folder is hidden.

    macOS writes "._x.jpg", which is no image, for each "x.jpg" into archives and on other disks.
    """
    return name.startswith(".")


def fold_name(name: str) -> str:
    """Fold a name to what all of its spellings share.

    macOS and Windows ignore case, and macOS stores letters with accents in two characters.
    """
    return unicodedata.normalize("NFC", name).casefold()
