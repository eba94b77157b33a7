"""The number of the format of results, by which files of other versions are told from damaged ones.

Every JSON file that a run writes and a later run reads begins with these entries:

    {"program": "gscompleter", "format": 1, ...}

One number stands for all files of an output folder. It grows when a reader of the number before
would misread a file. Files of versions before the first number have none, and are read.
"""

from __future__ import annotations

from types import MappingProxyType

from gscompleter.system.errors import InputError

FORMAT_KEY = "format"
"""Entry with the number of the format."""
NEWEST = 1
"""Number of the format that is written, and the latest that is read."""
PROGRAM_KEY = "program"
"""Entry with the name of the program; cameras of other programs may have a `format`, too."""
PROGRAM_NAME = "gscompleter"
RESULT_MARK = MappingProxyType({PROGRAM_KEY: PROGRAM_NAME, FORMAT_KEY: NEWEST})
"""First entries of every file."""


def is_marked(content: object) -> bool:
    """Return True for values of a JSON file that says that this program wrote it."""
    return isinstance(content, dict) and content.get(PROGRAM_KEY) == PROGRAM_NAME


def read_number(content: object) -> int | None:
    """Return the number of the format of a file of ours; None before the first number."""
    number = content.get(FORMAT_KEY) if isinstance(content, dict) else None
    return number if isinstance(number, int) and not isinstance(number, bool) else None


def refuse_later(content: object, name: str) -> None:
    """Raise InputError if the values of a file of ours, called `name`, are of a later format."""
    number = read_number(content)
    if number is not None and number > NEWEST:
        raise InputError(
            f"{name} was written by a later version of {PROGRAM_NAME} (format {number}, this one "
            f"reads up to {NEWEST}); update it."
        )
