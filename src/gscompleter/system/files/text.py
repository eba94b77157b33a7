"""Texts as bytes of files."""

from __future__ import annotations

import re


def encode_text(text: str) -> bytes:
    """Encode a text for a page or a table as UTF-8.

    Names of files may hold bytes that are no UTF-8; each becomes the sign for an unknown character.
    """
    # Python reads a byte that is no UTF-8 as a lone surrogate, which UTF-8 cannot write.
    return re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text).encode()
