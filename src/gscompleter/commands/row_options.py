"""Options of `complete` from a row of a manifest."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_type_hints

import tyro

from gscompleter.batch.manifest import FOLDER
from gscompleter.commands.options import CompleteOptions, LiveOptions
from gscompleter.commands.renamed import new_name
from gscompleter.commands.words import read_words, sentence_of
from gscompleter.config.settings import checked
from gscompleter.errors import InputError, quoted

COMPLETE = "complete"
Command: Any = Union[  # noqa: UP007  (a command line has several)
    Annotated[CompleteOptions, tyro.conf.subcommand(COMPLETE)],
    Annotated[LiveOptions, tyro.conf.subcommand("live")],
]
RESERVED = ("out", "overwrite", "quiet", "threads", "dry-run", "help", "help-all")
"""Options that a batch sets for all jobs."""
YES, NO = ("true", "yes", "1"), ("false", "no", "0", "")
"""Values of a flag in a CSV."""


def options_of(row: Mapping[str, Any], out: Path) -> CompleteOptions:
    """Parse a row, or raise InputError; `out` is the output folder."""
    if not isinstance(row.get(FOLDER), str):
        raise InputError("The row has no folder; give it the folder of a scene.")
    words = [COMPLETE, row[FOLDER], *words_of(row), "--out", str(out), "--overwrite", "--quiet"]
    try:
        options: CompleteOptions = checked(read_words(words, Command, (COMPLETE,)))
    except InputError as error:
        raise InputError(sentence_of(error)) from error
    return options


def words_of(row: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Convert a row to words of a command line."""
    for key, value in row.items():
        name = new_name(f"{prefix}{key}".replace("_", "-"))
        if name in RESERVED:
            raise InputError(f"A row cannot set '{quoted(name)}'; the batch sets it.")
        if name == FOLDER or value is None:
            continue
        if isinstance(value, Mapping):
            yield from words_of(value, f"{name}.")
        elif name in flags():
            yield from [f"--{name}"] if is_set(name, value) else []
        else:
            yield from (f"--{name}", *values_of(name, value))


def values_of(name: str, value: Any) -> list[str]:
    """Convert a value to words."""
    if isinstance(value, list):
        words = [str(item) for item in value]
    elif isinstance(value, str) and name in lists():
        words = split(value)
    else:
        words = [str(value)]
    for word in words:
        if word.startswith("-") and not is_number(word):
            raise InputError(f"{name} cannot be '{quoted(word)}', which begins with a dash.")
    return words


def split(cell: str) -> list[str]:
    """Split a cell into words like a shell."""
    try:
        return shlex.split(cell)
    except ValueError as error:
        raise InputError(f"'{quoted(cell)}' has an unmatched quotation mark.") from error


def is_set(name: str, value: Any) -> bool:
    """Return True if a row sets a flag."""
    text = str(value).lower()
    if text not in (*YES, *NO):
        raise InputError(f"{name} is '{quoted(text)}'; it must be true or false.")
    return text in YES


def is_number(word: str) -> bool:
    """Return True if a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


@cache
def flags() -> frozenset[str]:
    """Return the options of `complete` without a value."""
    return frozenset(name for name, kind in hints() if kind is bool)


@cache
def lists() -> frozenset[str]:
    """Return the options of `complete` with several values."""

    def has_tuple(kind: Any) -> bool:
        return "tuple" in str(kind).lower() or any(map(has_tuple, get_args(kind)))

    return frozenset(name for name, kind in hints() if has_tuple(kind))


def hints() -> list[tuple[str, Any]]:
    """Return the options of `complete` with their types."""
    return [(n.replace("_", "-"), kind) for n, kind in get_type_hints(CompleteOptions).items()]
