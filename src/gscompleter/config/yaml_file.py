"""A YAML file of settings, as far as JSON knows its values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from gscompleter.errors import InputError, quoted

LONGEST_FILE = 65_536
"""Characters of a file beyond which it holds no settings."""


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
