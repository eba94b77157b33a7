"""JSON files that are validated against dataclasses."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_json

T = TypeVar("T")


def read_typed_json(kind: type[T], path: Path, advice: str) -> T:
    """Read a JSON file as a dataclass; sentences about a damaged one end with `advice`.

    Keys that the dataclass does not have are ignored.
    """
    from pydantic import TypeAdapter, ValidationError  # no help page waits for it

    content = read_json(path, advice)
    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        defect = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in defect["loc"]) or "its content"
        raise InputError(
            f"{quote_value(path)} is damaged ({quote_value(place)}: {quote_value(defect['msg'])}); "
            f"{advice}."
        ) from None
