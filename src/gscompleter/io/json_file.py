"""Reading JSON that somebody else wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError, quoted
from gscompleter.reading import check_plain, read_bytes, read_head

MAX_BYTES = 1 << 29
"""Longest file, in bytes."""
MAX_DIGITS = 20
"""Of an integer: those of 64 bits have no more. Longer ones fit into no array and no float."""


def read_json(path: Path, advice: str) -> Any:
    """The content of a JSON file, with or without a byte order mark.

    Where it is no JSON, the error gives `advice` on what to do, as in "download it again".

    Raises:
        InputError: where it cannot be read, is no JSON, or holds an integer beyond 64 bits.
    """
    data = read_bytes(path, MAX_BYTES)
    try:
        value = json.loads(data.decode("utf-8-sig"), parse_int=_integer)
    except RecursionError as error:
        raise InputError(f"{quoted(path)} is nested too deeply; {advice}.") from error
    except ValueError as error:
        raise InputError(f"{quoted(path)} is not JSON ({quoted(str(error))}); {advice}.") from error
    check_plain(value, path, len(data))
    return value


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"an integer of {len(digits.lstrip('-'))} digits")
    return int(digits)


def begins_a_list(path: Path) -> bool:
    """Whether a JSON file holds a list, by its first character."""
    return read_head(path, 64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")
