"""Files of settings in YAML, of which nothing is read in another way than its author meant it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes

MAX_CONFIG_BYTES = 65_536
"""Largest file of settings, in bytes."""
MAX_BRACKETS = 1000
"""Most lists and mappings in brackets; the settings nest two levels."""
MAX_REASON_LENGTH = 120
"""Characters of a sentence of PyYAML that are shown."""
FLOAT_TAG = "tag:yaml.org,2002:float"
INT_TAG = "tag:yaml.org,2002:int"
EXPONENT = re.compile(r"[-+]?([0-9][0-9_]*(\.[0-9_]*)?|\.[0-9][0-9_]*)[eE][-+]?[0-9]+$")
"""Numbers that PyYAML takes for texts: YAML 1.1, which it reads, wants a dot and a sign. Without
the end, a text that begins as a number would be taken for one."""
SIXTIETHS = re.compile(r".*:")
"""Beginning of numbers that YAML 1.1 reads by hours, minutes and seconds: 1:30 is 90."""
OCTAL = re.compile(r"[-+]?0[0-9_]")
"""Beginning of whole numbers that YAML 1.1 reads with the base 8: 010 is 8."""


class SettingsLoader(yaml.SafeLoader):
    """Reads plain values only, and refuses what would be lost or become another number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; a name that is there twice is refused, as PyYAML keeps the last."""
        names: set[str] = set()
        # A tag such as !!map may be before anything, which the loader refuses.
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            # Other nodes, lists and mappings, are no names, and the loader refuses them.
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in names:
                problem = f"'{quote_value(key.value)}' is there twice"
                raise ConstructorError(None, None, problem, key.start_mark)
            names.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_int(self, node: yaml.ScalarNode) -> int:
        """Construct a whole number, unless it would be another one than its author meant."""
        refuse_number(node, SIXTIETHS)
        refuse_number(node, OCTAL)
        return self.construct_yaml_int(node)

    def construct_float(self, node: yaml.ScalarNode) -> float:
        """Construct a number, unless it would be another one than its author meant."""
        refuse_number(node, SIXTIETHS)
        return self.construct_yaml_float(node)


SettingsLoader.add_constructor(INT_TAG, SettingsLoader.construct_int)
SettingsLoader.add_constructor(FLOAT_TAG, SettingsLoader.construct_float)
SettingsLoader.add_implicit_resolver(FLOAT_TAG, EXPONENT, list("-+.0123456789"))


def refuse_number(node: yaml.ScalarNode, form: re.Pattern[str]) -> None:
    """Refuse a number of a form that is not decimal."""
    if form.match(node.value):
        problem = f"{quote_value(node.value)} is no decimal number"
        raise ConstructorError(None, None, problem, node.start_mark)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the mapping in a YAML file, limited to JSON values, or raise InputError."""
    name = f"The config {quote_value(path)}"
    data = read_bytes(path, MAX_CONFIG_BYTES)
    # PyYAML looks at all open brackets again for each new one: 60,000 take half a minute.
    if data.count(b"[") + data.count(b"{") > MAX_BRACKETS:
        raise InputError(f"{name} is nested too deeply.")
    try:
        text = data.decode()
        # Aliases can expand a short file endlessly.
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise yaml.YAMLError("aliases are not read; write the value out")
        values = yaml.load(text, SettingsLoader)
        # Through JSON: dates and other types of YAML become texts, which validation refuses.
        content = json.loads(json.dumps(values, default=str))
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
