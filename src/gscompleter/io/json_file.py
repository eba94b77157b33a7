"""JSON written by others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import check_plain, read_bytes, read_head

MAX_BYTES = 1 << 29
"""Longest file, in bytes."""
MAX_DIGITS = 20
"""Longest integer: 64 bits have no more digits."""


def read_json(path: Path, advice: str) -> Any:
    """Read a JSON file, with or without a byte order mark.

    Errors end with `advice`, such as "download it again".
    """
    data = read_bytes(path, MAX_BYTES)
    try:
        value = json.loads(data.decode("utf-8-sig"), parse_int=_parse_integer)
    except RecursionError as error:
        raise InputError(f"{quote_value(path)} is nested too deeply; {advice}.") from error
    except ValueError as error:
        raise InputError(
            f"{quote_value(path)} is not JSON ({quote_value(str(error))}); {advice}."
        ) from error
    check_plain(value, path, len(data))
    return value


def _parse_integer(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"an integer of {len(digits.lstrip('-'))} digits")
    return int(digits)


def is_json_list(path: Path) -> bool:
    """Return True if the JSON file is a list, by its first character."""
    return read_head(path, 64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")
