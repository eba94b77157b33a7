"""Options of `complete` from a row of a manifest."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Union, get_type_hints

import tyro

from gscompleter.apps.batch.manifest import FOLDER
from gscompleter.apps.commands.options import CompleteOptions, LiveOptions
from gscompleter.apps.commands.words import format_error, parse_words, translate_name
from gscompleter.config.settings import validate
from gscompleter.errors import InputError, quote_value

COMPLETE = "complete"
Command: Any = Union[  # noqa: UP007  (a command line has several)
    Annotated[CompleteOptions, tyro.conf.subcommand(COMPLETE)],
    Annotated[LiveOptions, tyro.conf.subcommand("live")],
]
RESERVED = ("out", "overwrite", "quiet", "threads", "dry-run", "help", "help-all")
"""Options that a batch sets for all jobs."""
TRUE, FALSE = ("true", "yes", "1"), ("false", "no", "0", "")
"""Values of a flag in a CSV."""


def parse_row(row: Mapping[str, Any], out: Path) -> CompleteOptions:
    """Parse a row, or raise InputError; `out` is the output folder."""
    if not isinstance(row.get(FOLDER), str):
        raise InputError("The row has no folder; give it the folder of a scene.")
    words = [COMPLETE, row[FOLDER], *row_to_words(row), "--out", str(out), "--overwrite", "--quiet"]
    try:
        options: CompleteOptions = validate(parse_words(words, Command, (COMPLETE,)))
    except InputError as error:
        raise InputError(format_error(error)) from error
    return options


def row_to_words(row: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Convert a row to words of a command line."""
    for key, value in row.items():
        name = translate_name(f"{prefix}{key}".replace("_", "-"))
        if name in RESERVED:
            raise InputError(f"A row cannot set '{quote_value(name)}'; the batch sets it.")
        if isinstance(value, Mapping):
            yield from row_to_words(value, f"{name}.")
        elif name != FOLDER and value is not None:
            yield from option_to_words(name, value)


def option_to_words(name: str, value: Any) -> list[str]:
    """Convert an option to words; a text is split like a shell if it can have several values."""
    kind = get_type_hints(CompleteOptions).get(name.replace("-", "_"))
    if kind is bool:
        if str(value).lower() not in TRUE + FALSE:
            raise InputError(f"{name} is {quote_value(str(value))}; it must be true or false.")
        return [f"--{name}"] if str(value).lower() in TRUE else []
    values = value if isinstance(value, list) else [value]
    if isinstance(value, str) and has_tuple(kind):
        try:
            values = shlex.split(value)
        except ValueError as error:
            raise InputError(f"'{quote_value(value)}' has an unmatched quotation mark.") from error
    words = [str(item) for item in values]
    for word in words:
        if re.match(r"-(?![\d.])", word):
            raise InputError(f"{name} cannot be '{quote_value(word)}', which begins with a dash.")
    return [f"--{name}", *words]


def has_tuple(kind: Any) -> bool:
    """Return True if an option of this type has several values."""
    return "tuple" in str(kind).lower()
