"""Settings from a YAML file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from gscompleter.errors import InputError, quote_value
from gscompleter.io.reading import read_bytes

MAX_CONFIG_BYTES = 65_536
"""Largest size of a settings file, in bytes."""
MAX_REASON_LENGTH = 120
"""Most characters of PyYAML's reason in a sentence."""


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the mapping in a YAML file, limited to JSON values, or raise InputError."""
    name, data = f"The config {quote_value(path)}", read_bytes(path, MAX_CONFIG_BYTES)
    try:
        # They can expand a short file endlessly.
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(data.decode())):
            raise yaml.YAMLError("aliases are not read; write the value out")
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
