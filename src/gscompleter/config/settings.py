"""Settings as frozen dataclasses with validated annotations. Nothing here needs torch."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

from annotated_types import Interval

from gscompleter.errors import InputError, quote_value

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

S = TypeVar("S", bound="Settings")

Count = Annotated[int, Interval(ge=0, le=100_000)]
Share = Annotated[float, Interval(ge=0, le=1)]
Weight = Annotated[float, Interval(ge=0, le=1e6)]
# Levels and rounds add to the seed.
Seed = Annotated[int, Interval(ge=0, lt=2**62)]


class Settings:
    """Base of all settings: no unknown names, finite numbers only."""

    __pydantic_config__: ClassVar[Any] = {
        "extra": "forbid",
        "allow_inf_nan": False,
        "revalidate_instances": "always",
    }


def validate(settings: S, prefix: str = "") -> S:
    """Validate types and ranges; InputErrors name `prefix` and the setting as their argument."""
    from pydantic import TypeAdapter

    with translate_errors(settings, prefix=prefix):
        return TypeAdapter(type(settings)).validate_python(settings, strict=True)


def apply_changes(settings: S, changes: Mapping[str, Any], where: str = "") -> S:
    """Apply nested changes; the sentences of InputErrors begin with `where`."""
    from pydantic import TypeAdapter

    text = json.dumps(merge_nested(asdict(settings), changes))  # type: ignore[call-overload]
    with translate_errors(settings, where):
        return TypeAdapter(type(settings)).validate_json(text, strict=True)


@contextmanager
def translate_errors(settings: object, where: str = "", prefix: str = "") -> Iterator[None]:
    """Translate pydantic's errors into InputErrors."""
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        wrong = error.errors(include_url=False)[0]
        name = ".".join(part for part in wrong["loc"] if isinstance(part, str))
        raise InputError(where + describe_invalid(wrong, name, settings), prefix + name) from None


def merge_nested(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested mappings; `changes` win."""
    result = dict(values)
    for name, change in changes.items():
        nested = isinstance(change, Mapping) and isinstance(values.get(name), Mapping)
        result[name] = merge_nested(values[name], change) if nested else change
    return result


def describe_invalid(wrong: ErrorDetails, name: str, settings: object) -> str:
    """Write the sentence about the setting called `name`."""
    if wrong["type"] == "unexpected_keyword_argument":
        for part in wrong["loc"][:-1]:
            settings = getattr(settings, str(part))
        known = ", ".join(vars(settings))
        return f"There is no setting '{quote_value(name)}'; choose one of {known}."
    given = wrong["input"]
    shown = f"'{quote_value(given)}'" if isinstance(given, str) else quote_value(given)
    if wrong["type"] == "dataclass_type":
        return f"{name} is a group of settings, got {shown}."
    return f"{name} {re.sub(r'^[A-Z][a-z]+ should', 'must', wrong['msg'])}, got {shown}."
