"""Help pages: `--help` shows the options of a command, `--help-all` every setting too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from inspect import get_annotations
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from gscompleter.config import CompleterConfig
from gscompleter.config.settings import Settings

HELP = ("-h", "--help")
HELP_ALL = "--help-all"

CONFIG = StructFieldSpec(
    "config",
    str,
    "default",
    "Settings of the method: default, paper, an ablation such as no-sa, or a YAML file. Single "
    f"settings are changed by options such as --config.holes.dilation 5; {HELP_ALL} lists them.",
)

Rule = Callable[[StructTypeInfo], StructConstructorSpec | None]


def make_help_rule(show_all: bool) -> Rule:
    """Return a rule by which tyro writes help pages. No option can be parsed with it."""
    entered: list[type] = []

    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        kind: Any = info.type
        if not isinstance(kind, type) or not issubclass(kind, Settings) or kind in entered:
            return None
        entered.append(kind)
        spec = ConstructorRegistry.get_struct_spec(info)
        entered.remove(kind)
        if not isinstance(spec, StructConstructorSpec):
            return None
        own = get_annotations(kind)
        fields = sorted(spec.fields, key=lambda field: field.name not in own)
        return replace(spec, fields=tuple(tidy_field(field, show_all) for field in fields))

    return rule


def tidy_field(field: StructFieldSpec, show_all: bool) -> StructFieldSpec:
    """Join the lines of a help text, and hide a default that says nothing.

    Unless `show_all` is set, the settings of the method become one option.
    """
    if isinstance(field.default, CompleterConfig) and not show_all:
        return CONFIG

    def text() -> str | None:
        found = field.helptext() if callable(field.helptext) else field.helptext
        return None if found is None else " ".join(found.split())

    kind: Any = field.type
    if field.default is None or field.default is False or field.default == ():
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return replace(field, helptext=text, type=kind)
