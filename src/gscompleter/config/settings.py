"""Settings that are declared once: frozen dataclasses whose annotations say what is allowed.

The command line is derived from them, and pydantic checks them wherever they come from. Nothing
here needs torch, and pydantic is imported where something is checked.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

from annotated_types import Interval

from gscompleter.errors import InputError, quoted

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

S = TypeVar("S", bound="Settings")

Count = Annotated[int, Interval(ge=0, le=100_000)]
Share = Annotated[float, Interval(ge=0, le=1)]
Weight = Annotated[float, Interval(ge=0, le=1e6)]
# Room is left for what is added to it on each level and in each round.
Seed = Annotated[int, Interval(ge=0, lt=2**62)]


class Settings:
    """What settings have in common: no unknown names, and only finite numbers."""

    __pydantic_config__: ClassVar[Any] = {
        "extra": "forbid",
        "allow_inf_nan": False,
        "revalidate_instances": "always",
    }


def checked(settings: S, prefix: str = "") -> S:
    """`settings`, once each value is seen to be of its type and in its range.

    Raises:
        InputError: where one is not. `prefix` and the name of the setting are its argument.
    """
    from pydantic import TypeAdapter

    with told(settings, prefix=prefix):
        return TypeAdapter(type(settings)).validate_python(settings, strict=True)


def updated(settings: S, changes: Mapping[str, Any], where: str = "") -> S:
    """`settings` with `changes`, a mapping of names in which settings of settings are mappings too.

    Raises:
        InputError: where a name is unknown, or a value of the wrong type or out of range; it
            begins with `where` the value stands.
    """
    from pydantic import TypeAdapter

    text = json.dumps(merged(asdict(settings), changes))  # type: ignore[call-overload]
    with told(settings, where):
        return TypeAdapter(type(settings)).validate_json(text, strict=True)


@contextmanager
def told(settings: object, where: str = "", prefix: str = "") -> Iterator[None]:
    """What pydantic finds wrong with `settings` becomes a sentence."""
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        name = ".".join(part for part in wrong["loc"] if isinstance(part, str))
        raise InputError(where + sentence_on(wrong, name, settings), prefix + name) from None


def merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`values` with `changes`, mappings within mappings alike."""
    result = dict(values)
    for name, change in changes.items():
        nested = isinstance(change, Mapping) and isinstance(values.get(name), Mapping)
        result[name] = merged(values[name], change) if nested else change
    return result


def sentence_on(wrong: ErrorDetails, name: str, settings: object) -> str:
    """What is wrong with the setting called `name`."""
    if wrong["type"] == "unexpected_keyword_argument":
        for part in wrong["loc"][:-1]:
            settings = getattr(settings, str(part))
        known = ", ".join(vars(settings))
        return f"There is no setting '{quoted(name)}'; choose one of {known}."
    given = wrong["input"]
    shown = f"'{quoted(given)}'" if isinstance(given, str) else quoted(given)
    if wrong["type"] == "dataclass_type":
        return f"{name} holds settings of its own, got {shown}."
    return f"{name} {re.sub(r'^[A-Z][a-z]+ should', 'must', wrong['msg'])}, got {shown}."
