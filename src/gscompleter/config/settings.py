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
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

import yaml
from annotated_types import Interval

from gscompleter.errors import InputError, quoted

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

S = TypeVar("S")

Count = Annotated[int, Interval(ge=0, le=100_000)]
Share = Annotated[float, Interval(ge=0, le=1)]
Weight = Annotated[float, Interval(ge=0, le=1e6)]
Seed = Annotated[int, Interval(ge=0, lt=2**63)]

LONGEST_FILE = 65_536
"""Characters of a YAML file beyond which it holds no settings."""


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


def updated(settings: S, changes: Mapping[str, Any], where: str) -> S:
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
        name = ".".join(map(str, wrong["loc"]))
        raise InputError(where + sentence_on(wrong, name, settings), prefix + name) from None


def merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`values` with `changes`, mappings within mappings alike."""
    return {
        **values,
        **{
            name: merged(values[name], change)
            if isinstance(change, Mapping) and isinstance(values.get(name), Mapping)
            else change
            for name, change in changes.items()
        },
    }


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


class PlainLoader(yaml.SafeLoader):
    """YAML without aliases, of which a short file can make an endless one."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not read; write the value out")
        return super().compose_node(parent, index)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file, of what JSON knows.

    Raises:
        InputError: where it cannot be read, is no YAML, holds something else, or is too long.
    """
    try:
        with path.open() as file:
            text = file.read(LONGEST_FILE + 1)
        content = json.loads(json.dumps(yaml.load(text, PlainLoader), default=str))
    except OSError as error:
        raise InputError(f"Cannot read the config {path}: {error.strerror}.") from error
    except RecursionError as error:
        raise InputError(f"The config {path} is nested too deeply.") from error
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise InputError(
            f"The config {path} is not YAML: {quoted(' '.join(str(error).split()))}."
        ) from error
    if len(text) > LONGEST_FILE:
        raise InputError(f"The config {path} has more than {LONGEST_FILE:,} characters.")
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"The config {path} must map settings to values, as in `holes: ...`.")
    return content
