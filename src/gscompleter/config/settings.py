"""Settings as frozen dataclasses with validated annotations. Nothing here needs torch."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

from annotated_types import Interval

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

S = TypeVar("S", bound="Settings")

Count = Annotated[int, Interval(ge=0, le=100_000)]
Share = Annotated[float, Interval(ge=0, le=1)]
Weight = Annotated[float, Interval(ge=0, le=1e6)]
Device = Literal["auto", "cpu", "cuda", "mps"]
"""Choice of one device for renderer and networks; with `mps` the renderer stays on the CPU."""
COVERED = 0.5
"""Alpha from which a pixel is covered, unless `holes.max_alpha` (τ of Eq. 12) demands more."""
# Levels and rounds add to the seed.
Seed = Annotated[int, Interval(ge=0, lt=2**62)]

MAX_CONFIG_BYTES = 65_536
MAX_BRACKETS = 1000
"""Most lists and mappings in brackets; the settings nest two levels."""
MAX_REASON_LENGTH = 120  # of a sentence about YAML


class Settings:
    """Base of all settings: no unknown names, finite numbers only."""

    __pydantic_config__: ClassVar[Any] = {
        "extra": "forbid",
        "allow_inf_nan": False,
        "revalidate_instances": "always",
    }


def validate(settings: S, prefix: str = "") -> S:
    """Validate types and ranges; InputErrors name `prefix` and the setting as their argument."""
    from pydantic import TypeAdapter  # imported late, so that `--help` does not wait for it

    with translate_errors(settings, prefix=prefix):
        return TypeAdapter(type(settings)).validate_python(settings, strict=True)


def apply_changes(settings: S, changes: Mapping[str, Any], where: str = "", prefix: str = "") -> S:
    """Apply nested changes.

    The sentences of InputErrors begin with `where`, and name `prefix` and the setting as argument.
    """
    from pydantic import TypeAdapter

    # YAML has no tuples. In strict mode pydantic refuses a list for a tuple, but not in JSON.
    text = json.dumps(merge_nested(asdict(settings), changes))  # type: ignore[call-overload]
    with translate_errors(settings, where, prefix):
        return TypeAdapter(type(settings)).validate_json(text, strict=True)


@contextmanager
def translate_errors(settings: object, where: str = "", prefix: str = "") -> Iterator[None]:
    """Translate pydantic's errors into InputErrors."""
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        # A sentence names one setting: that of the first error. Parts of its place that are no
        # text are indices, and those with a bracket kinds of a value that may be of several.
        wrong = error.errors(include_url=False)[0]
        # A group of settings refuses what contradicts itself by a sentence of its own.
        refusal = wrong.get("ctx", {}).get("error")
        if isinstance(refusal, InputError):
            raise refusal from None
        name = ".".join(p for p in wrong["loc"] if isinstance(p, str) and "[" not in p)
        raise InputError(where + describe_invalid(wrong, name, settings), prefix + name) from None


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

    # The group that does not know the name, to list the names that it knows.
    if wrong["type"] == "unexpected_keyword_argument":
        for part in wrong["loc"][:-1]:
            settings = getattr(settings, str(part))
        known = ", ".join(vars(settings))
        return f"There is no setting '{quote_value(name)}'; choose one of {known}."
    shown = f"'{quote_value(value)}'" if isinstance(value, str) else quote_value(value)
    if wrong["type"] == "dataclass_type":
        return f"{name} is a group of settings, got {shown}."
    # Pydantic says "Input should be greater than ...".
    return f"{name} {re.sub(r'^[A-Z][a-z]+ should', 'must', wrong['msg'])}, got {shown}."


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the mapping in a YAML file, limited to JSON values, or raise InputError."""
    import yaml

    name = f"The config {quote_value(path)}"
    data = read_bytes(path, MAX_CONFIG_BYTES)
    # PyYAML looks at all open brackets again for each new one: 60,000 take half a minute.
    if data.count(b"[") + data.count(b"{") > MAX_BRACKETS:
        raise InputError(f"{name} is nested too deeply.")
    try:
        # Aliases can expand a short file endlessly.
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(data.decode())):
            raise yaml.YAMLError("aliases are not read; write the value out")
        # Through JSON: dates and other types of YAML become texts, which validation refuses.
        content = json.loads(json.dumps(yaml.safe_load(data.decode()), default=str))
    except RecursionError as error:
        raise InputError(f"{name} is nested too deeply.") from error
    except Exception as error:  # PyYAML fails in many ways, KeyError and IndexError among them
        mark = getattr(error, "problem_mark", None)
        place = "" if mark is None else f" in line {mark.line + 1}"
        problem = getattr(error, "problem", None) or str(error)
        reason = quote_value(problem, MAX_REASON_LENGTH) + place
        raise InputError(f"{name} is not YAML: {reason}.") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"{name} must map settings to values, as in `holes: ...`.")
    return content
