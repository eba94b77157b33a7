"""Sentences on the values of an option: too few, too many, or of another kind.

tyro speaks of its types ("no type matching {INT INT}|INT could be instantiated from"), and only
names the option.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from gscompleter.system.errors import quote_value

NAMED_OPTION = re.compile(r"(?:for argument '|Argument helptext:\s+)--([\w.-]+)")
"""Option whose values tyro refuses, in the lines of its message."""
NOUNS = {int: "whole number", float: "number", str: "text", Path: "path"}
"""Names of the values of each type in a sentence."""


@dataclass(frozen=True)
class ValueForm:
    """One of the forms that the values of an option may have."""

    kind: type | None
    """Type of each value; None for one of `choices`."""
    count: int = 1
    choices: tuple[str, ...] = ()

    def fits(self, values: Sequence[str]) -> bool:
        """Check whether values have this form, their ranges aside."""
        if len(values) != self.count:
            return False
        if self.kind is None:
            return values[0] in self.choices
        with suppress(ValueError):
            for value in values:
                self.kind(value)
            return True
        return False

    def describe(self) -> list[str]:
        """Describe the form in words, each choice by itself."""
        if self.kind is None:
            return [*self.choices]
        noun = NOUNS[self.kind]
        return [f"a {noun}" if self.count == 1 else f"{self.count} {noun}s"]


def explain_values(words: Sequence[str], own: Mapping[str, Any], message: str) -> str:
    """Explain why an option that tyro's message names cannot take its values.

    `own` has the options of the command with their types. Returns an empty text where the message
    is about something else, or the option takes any number of values.
    """
    named = NAMED_OPTION.search(message)
    name = named[1] if named is not None else ""
    forms = list_forms(own[name]) if name in own else None
    if forms is None:
        return ""
    values = find_values(words, name)
    # An option whose forms all have one count takes that many words, and leaves those after them
    # to the arguments without a name.
    counts = {form.count for form in forms}
    if len(counts) == 1:
        values = values[: max(counts)]
    shown = [form for form in forms if form.kind is not NoneType]
    if any(form.fits(values) for form in shown):
        return ""
    *others, last = [text for form in shown for text in form.describe()]
    takes = f"{', '.join(others)} or {last}" if others else last
    if any(form.count == len(values) for form in shown):
        given = f"was given '{quote_value(' '.join(values))}'"
    else:
        given = f"{len(values) or 'none'} {'were' if len(values) > 1 else 'was'} given"
    return f"--{name} takes {takes}{describe_names(own[name])}, and {given}"


def list_forms(kind: Any) -> list[ValueForm] | None:
    """List the forms of values of a type; None if it takes any number of them, or is a switch."""
    origin = get_origin(kind)
    parts = get_args(kind)
    if origin is Annotated:
        return list_forms(parts[0])
    if origin is Literal:
        return [ValueForm(None, choices=tuple(str(word) for word in parts))]
    if origin in (Union, UnionType):
        lists = [list_forms(part) for part in parts]
        return None if None in lists else [form for forms in lists if forms for form in forms]
    if origin is tuple:
        kinds = {strip_marks(part) for part in parts}
        is_fixed = len(kinds) == 1 and kinds <= set(NOUNS)
        return [ValueForm(kinds.pop(), len(parts))] if is_fixed else None
    # None is no word that can be given. For tyro it counts as a form of one word.
    return [ValueForm(kind)] if kind in NOUNS or kind is NoneType else None


def strip_marks(kind: Any) -> Any:
    """Return a type without the marks of its annotation."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def find_values(words: Sequence[str], name: str) -> list[str]:
    """Find the words that follow an option, up to the next one; a value may begin with a minus."""
    for place, word in enumerate(words):
        option, sign, value = word.partition("=")
        if word.startswith("--") and option.removeprefix("--").replace("_", "-") == name:
            more = takewhile(lambda later: not later.startswith("--"), words[place + 1 :])
            return [*([value] if sign else []), *more]
    return []


def describe_names(kind: Any) -> str:
    """Describe in brackets what the values are called in the help, if that is said."""
    marks = get_args(kind)[1:] if get_origin(kind) is Annotated else ()
    names = [mark.metavar for mark in marks if getattr(mark, "metavar", None)]
    return f" ({names[0]})" if names else ""
