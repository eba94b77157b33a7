"""Rows of a manifest: words of a command line of `complete`, and the request that they make.

Rows are those that `read_manifest` returns: flat, with absolute paths.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args, get_origin

from gscompleter.apps.batch.manifest import FOLDER
from gscompleter.apps.command_line.chosen_config import CONFIG_OPTION
from gscompleter.apps.command_line.words import format_error, list_options, parse_words
from gscompleter.apps.commands.complete import CompleteOptions, decide_completion
from gscompleter.apps.requests.completion import (
    ExportRequest,
    FillingRequest,
    PlanRequest,
    UpdateRequest,
)
from gscompleter.config.settings import validate
from gscompleter.system.errors import InputError, quote_value

COMPLETE = "complete"
RESERVED = ("out", "overwrite", "quiet", "json", "threads", "dry-run", "help", "help-all")
"""Options that a row does not have, because all jobs of a batch are alike in them."""
TRUE = ("true", "yes", "1")
"""Values of a CSV that set a flag."""
FALSE = ("false", "no", "0", "")
"""Values of a CSV that leave a flag unset; an empty cell is one of them."""


def decide_row(row: Mapping[str, Any], out: Path) -> FillingRequest:
    """Decide what the row of a manifest asks for, or raise InputError."""
    try:
        request = decide_completion(parse_batch_row(row, out))
    except InputError as error:
        # Only the sentence is kept in the row of a failed job, so it names the option itself.
        raise InputError(format_error(error)) from error
    # `parse_batch_row` lets neither an export nor a dry run through.
    assert not isinstance(request, ExportRequest | PlanRequest | UpdateRequest)
    return request


def parse_batch_row(row: Mapping[str, Any], out: Path) -> CompleteOptions:
    """Parse a row, or raise InputError; `out` is the output folder."""
    if not isinstance(row.get(FOLDER), str):
        raise InputError("The row has no folder; give it the folder of a scene.")
    # The row becomes a command line, so that its values are read and refused as those of
    # `complete`. Overwriting is safe: the folder of a job is in the batch's own output.
    words = [COMPLETE, row[FOLDER], *row_to_words(row), "--out", str(out), "--overwrite", "--quiet"]
    options: CompleteOptions = validate(parse_words(words, {COMPLETE: CompleteOptions}))
    if options.export_holes is not None:
        raise InputError(
            "A batch completes scenes and exports no holes; run `complete --export-holes` for each."
        )
    return options


def row_to_words(row: Mapping[str, Any]) -> Iterator[str]:
    """Convert a row to words of a command line; null leaves an option out."""
    for key, value in row.items():
        name = key.replace("_", "-")
        if name in RESERVED:
            raise InputError(
                f"A row cannot set '{quote_value(name)}', in which all rows of a batch are alike."
            )
        if name != FOLDER and value is not None:
            yield from option_to_words(name, value)


def option_to_words(name: str, value: Any) -> list[str]:
    """Convert an option to words; a text is split like a shell if it can have several values."""
    kind = list_options(CompleteOptions).get(name)
    if kind is bool:
        if str(value).lower() not in TRUE + FALSE:
            raise InputError(f"{name} is {quote_value(str(value))}; it must be true or false.")
        is_set = str(value).lower() in TRUE
        # A setting of the method has a value on the command line; a flag is there or not.
        if name.startswith(f"{CONFIG_OPTION}."):
            return [f"--{name}", str(is_set)]
        return [f"--{name}"] if is_set else []

    # A CSV has one text for `0 4`, where JSON has a list. Only options with several values are
    # split, because a single path may contain spaces.
    values = value if isinstance(value, list) else [value]
    if isinstance(value, str) and has_tuple(kind):
        try:
            values = shlex.split(value)
        except ValueError as error:
            raise InputError(
                f"{name} is '{quote_value(value)}', which has an unmatched quotation mark."
            ) from error

    # The parser would take a value such as `--out` for an option; negative numbers are none.
    words = [str(item) for item in values]
    for word in words:
        if re.match(r"-(?![\d.])", word):
            raise InputError(f"{name} cannot be '{quote_value(word)}', which begins with a dash.")
    return [f"--{name}", *words]


def has_tuple(kind: Any) -> bool:
    """Return True if a type is or may be a tuple."""
    return get_origin(kind) is tuple or any(map(has_tuple, get_args(kind)))
