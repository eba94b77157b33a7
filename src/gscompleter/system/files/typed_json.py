"""JSON files that are validated against dataclasses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_json
from gscompleter.system.files.result_format import read_number, refuse_later

T = TypeVar("T")


def read_typed_json(
    kind: type[T], path: Path, advice: str, early: Mapping[str, Any] = MappingProxyType({})
) -> T:
    """Read a JSON file of ours as a dataclass; sentences about a damaged one end with `advice`.

    Keys that the dataclass does not have are ignored. A file of a later version is named as such.
    One of a version before formats had numbers gets the entries `early` where it has none.
    """
    content = read_json(path, advice)
    name = quote_value(path)
    refuse_later(content, name)
    is_early = isinstance(content, dict) and read_number(content) is None
    if is_early:
        content = {**early, **content}
    return validate_typed(kind, content, name, advice, is_early)


def parse_typed_json(kind: type[T], content: bytes, name: str, advice: str) -> T:
    """Parse JSON as a dataclass; sentences call it `name`, and end with `advice`."""
    try:
        parsed = json.loads(content)
    except (ValueError, RecursionError):
        raise InputError(f"{name} is no JSON; {advice}.") from None
    return validate_typed(kind, parsed, name, advice)


def validate_typed(
    kind: type[T], content: object, name: str, advice: str, is_early: bool = False
) -> T:
    """Validate values of JSON as a dataclass; sentences call them `name`, and end with `advice`.

    Where `is_early`, a version before formats had numbers may have written them with fewer entries.
    """
    from pydantic import TypeAdapter, ValidationError  # no help page waits for it

    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        defect = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in defect["loc"]) or "its content"
        if is_early and defect["type"] == "missing":
            raise InputError(
                f"{name} was written by an early version, and has no {quote_value(place)}; "
                f"{advice}."
            ) from None
        raise InputError(
            f"{name} is damaged ({quote_value(place)}: {quote_value(defect['msg'])}); {advice}."
        ) from None
