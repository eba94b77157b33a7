"""Reading JSON that somebody else wrote."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError, quoted

MAX_DIGITS = 20
"""Of an integer: those of 64 bits have no more. Longer ones fit into no array and no float."""


def read_json(path: Path, advice: str) -> Any:
    """The content of a JSON file, with or without a byte order mark.

    Where it is no JSON, the error gives `advice` on what to do, as in "download it again".

    Raises:
        InputError: where it cannot be read, is no JSON, or holds an integer beyond 64 bits.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"{quoted(path)} is not a file; correct the path.")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"), parse_int=_integer)
    except OSError as error:
        raise InputError(
            f"{quoted(path)} cannot be read: {error.strerror}; correct the path, or make it "
            "readable."
        ) from error
    except RecursionError as error:
        raise InputError(f"{quoted(path)} is nested too deeply; {advice}.") from error
    except ValueError as error:
        raise InputError(f"{quoted(path)} is not JSON ({quoted(str(error))}); {advice}.") from error


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"an integer of {len(digits.lstrip('-'))} digits")
    return int(digits)


def begins_a_list(path: Path) -> bool:
    """Whether a JSON file holds a list, by its first character."""
    try:
        with path.open("rb") as file:
            return file.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")
    except OSError:
        return False
