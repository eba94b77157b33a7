"""JSON files that are validated against dataclasses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_json

T = TypeVar("T")


def read_typed_json(kind: type[T], path: Path, advice: str) -> T:
    """Read a JSON file as a dataclass; sentences about a damaged one end with `advice`.

    Keys that the dataclass does not have are ignored.
    """
    return validate_typed(kind, read_json(path, advice), quote_value(path), advice)


def parse_typed_json(kind: type[T], content: bytes, name: str, advice: str) -> T:
    """Parse JSON as a dataclass; sentences call it `name`, and end with `advice`."""
    try:
        parsed = json.loads(content)
    except (ValueError, RecursionError):
        raise InputError(f"{name} is no JSON; {advice}.") from None
    return validate_typed(kind, parsed, name, advice)


def validate_typed(kind: type[T], content: object, name: str, advice: str) -> T:
    """Validate values of JSON as a dataclass; sentences call them `name`, and end with `advice`."""
    from pydantic import TypeAdapter, ValidationError  # no help page waits for it

    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        defect = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in defect["loc"]) or "its content"
        raise InputError(
            f"{name} is damaged ({quote_value(place)}: {quote_value(defect['msg'])}); {advice}."
        ) from None
