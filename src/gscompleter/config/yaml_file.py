"""A YAML file of settings, as far as JSON knows its values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from gscompleter.errors import InputError, quoted
from gscompleter.reading import read_bytes

LONGEST_FILE = 65_536
"""Bytes of a file beyond which it holds no settings."""
LONGEST_REASON = 120
"""Characters of what PyYAML objects to."""


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
    name, data = f"The config {quoted(path)}", read_bytes(path, LONGEST_FILE)
    try:
        content = json.loads(json.dumps(yaml.load(data.decode(), PlainLoader), default=str))
    except RecursionError as error:
        raise InputError(f"{name} is nested too deeply.") from error
    except Exception as error:  # PyYAML fails in many ways, KeyError and IndexError among them
        mark = getattr(error, "problem_mark", None)
        place = "" if mark is None else f" in line {mark.line + 1}"
        reason = f"{quoted(getattr(error, 'problem', None) or str(error), LONGEST_REASON)}{place}"
        raise InputError(f"{name} is not YAML: {reason}.") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"{name} must map settings to values, as in `holes: ...`.")
    return content
