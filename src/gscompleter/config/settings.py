"""Settings as frozen dataclasses with validated annotations. Nothing here needs torch."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

from annotated_types import Interval

from gscompleter.system.errors import InputError, quote_value

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

S = TypeVar("S", bound="Settings")

Count = Annotated[int, Interval(ge=0, le=100_000)]
"""Number of things or of repetitions, such as iterations."""
Share = Annotated[float, Interval(ge=0, le=1)]
"""Part of a whole."""
Weight = Annotated[float, Interval(ge=0, le=1e6)]
"""Factor of a term in a sum."""
Device = Literal["auto", "cpu", "cuda", "mps"]
"""Choice of one device for renderer and networks; with `mps` the renderer stays on the CPU."""
Seed = Annotated[int, Interval(ge=0, lt=2**62)]
"""Seed of random numbers. Attempts, levels and rounds add to it, and sums stay below 2⁶³."""

COVERED = 0.5
"""Alpha from which a pixel is covered, unless `holes.max_alpha` (τ of Eq. 12) demands more."""


class Settings:
    """Base of all settings: no unknown names, finite numbers only."""

    __pydantic_config__: ClassVar[Any] = {
        "extra": "forbid",
        "allow_inf_nan": False,
        "revalidate_instances": "always",
    }
    has_plain_options: ClassVar[bool] = False
    """True if its settings are options without the name of their group before them."""


def validate(settings: S, prefix: str = "") -> S:
    """Validate types and ranges.

    The argument of an InputError is the name of the setting, with `prefix` before it.
    """
    from pydantic import TypeAdapter  # imported late, so that `--help` does not wait for it

    with translate_errors(settings, prefix=prefix):
        return TypeAdapter(type(settings)).validate_python(settings, strict=True)


def apply_changes(settings: S, changes: Mapping[str, Any], where: str = "", prefix: str = "") -> S:
    """Apply nested changes, and validate the result as `validate` does.

    The sentence of an InputError begins with `where`, the place that the changes are from; that of
    a group of settings that contradict each other is its own.
    """
    from pydantic import TypeAdapter

    # YAML has no tuples. In strict mode pydantic refuses a list for a tuple, but not in JSON.
    text = json.dumps(merge_nested(asdict(settings), changes))  # type: ignore[call-overload]
    with translate_errors(settings, where, prefix):
        return TypeAdapter(type(settings)).validate_json(text, strict=True)


@contextmanager
def translate_errors(settings: object, where: str = "", prefix: str = "") -> Iterator[None]:
    """Translate pydantic's errors about `settings` into InputErrors.

    `where` and `prefix` are those of `apply_changes`.
    """
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        # A sentence names one setting: that of the first error.
        wrong = error.errors(include_url=False)[0]
        # A group of settings refuses what contradicts itself by a sentence of its own.
        refusal = wrong.get("ctx", {}).get("error")
        if isinstance(refusal, InputError):
            raise refusal from None
        name = ".".join(list_names(settings, wrong["loc"]))
        argument = prefix + name if name else None
        raise InputError(where + describe_invalid(wrong, name, settings), argument) from None


def list_names(settings: object, place: Sequence[int | str]) -> list[str]:
    """List the names, from the outermost group on, by which options call the value at a place."""
    names = []
    group = settings
    for part in place:
        # Numbers are indices in a list. What has a bracket is a kind of a value that may be of
        # several.
        if not isinstance(part, str) or "[" in part:
            continue
        group = getattr(group, part, None)
        if not (isinstance(group, Settings) and group.has_plain_options):
            names.append(part)
    return names


def merge_nested(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested mappings; `changes` win."""
    result = dict(values)
    for name, change in changes.items():
        if isinstance(change, Mapping) and isinstance(values.get(name), Mapping):
            result[name] = merge_nested(values[name], change)
        else:
            result[name] = change
    return result


def describe_invalid(wrong: ErrorDetails, name: str, settings: object) -> str:
    """Write the sentence about the setting called `name`."""
    value = wrong["input"]

    # The only texts that `json.dumps` writes and pydantic does not read.
    if wrong["type"] == "json_invalid":
        return "A setting has characters that are no Unicode; write it again."
    if wrong["type"] == "unexpected_keyword_argument":
        # The group that does not know the name lists those that it knows.
        group = settings
        for part in wrong["loc"][:-1]:
            group = getattr(group, str(part))
        known = ", ".join(vars(group))
        return f"There is no setting '{quote_value(name)}'; choose one of {known}."
    shown = f"'{quote_value(value)}'" if isinstance(value, str) else quote_value(value)
    if wrong["type"] == "dataclass_type":
        return f"{name} is a group of settings, got {shown}."
    # Pydantic says "Input should be greater than ...".
    return f"{name} {re.sub(r'^[A-Z][a-z]+ should', 'must', wrong['msg'])}, got {shown}."
