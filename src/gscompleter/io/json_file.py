"""Reading JSON that somebody else wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gscompleter.errors import InputError


def read_json(path: Path, advice: str) -> Any:
    """The content of a JSON file, with or without a byte order mark.

    Args:
        path: The file.
        advice: What to do where it is no JSON, as in "download it again".

    Raises:
        InputError: where it cannot be read, or is no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror}; correct the path, or make it readable."
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not JSON ({error}); {advice}.") from error


def begins_a_list(path: Path) -> bool:
    """Whether a JSON file holds a list, by its first character."""
    try:
        with path.open("rb") as file:
            return file.read(64).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")
    except OSError:
        return False
