"""Help pages: `--help` shows the options that people use, `--help-all` all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from gscompleter.apps.commands.generator_options import GeneratorOptions, make_generator_field
from gscompleter.apps.commands.options import (
    BatchOptions,
    BenchOptions,
    CleanOptions,
    CompleteOptions,
    EvaluateOptions,
    LiveOptions,
)
from gscompleter.config import CompleterConfig
from gscompleter.config.generators import GeneratorSettings
from gscompleter.config.settings import Settings

HELP = ("-h", "--help")
HELP_ALL = "--help-all"

COMMON: dict[type, tuple[str, ...]] = {
    CompleteOptions: (
        *("folder", "out", "context", "target", "auto", "scene", "resolution", "synthesis"),
        *("config", "device", "overwrite"),
    ),
    LiveOptions: (
        *("folder", "out", "context", "scene", "resolution", "synthesis", "config", "device"),
        *("port", "host", "no_open", "overwrite"),
    ),
    EvaluateOptions: (
        *("paths", "out", "protocol", "methods", "resolution", "reconstructor", "synthesis"),
        *("rerun", "one_per_scene", "limit", "device"),
    ),
    BatchOptions: ("manifest", "out", "each", "engine", "workers", "retries", "rerun"),
    CleanOptions: ("folder", "scene", "out", "context", "resolution", "device", "overwrite"),
    BenchOptions: ("folder", "context", "target", "cases", "methods", "repeats", "quick", "out"),
}
"""Fields that the help of a command shows, in their order. Other commands show all of theirs."""

CONFIG = StructFieldSpec(
    "config",
    str,
    "default",
    "Settings of the method: default, paper, an ablation such as no-sa, or a YAML file. Single "
    "settings are changed by options such as --config.holes.dilation 5.",
)
ALL = StructFieldSpec("help_all", bool, False, "Show all options and exit.")

METAVARS: dict[Any, str] = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
"""Placeholders for values by their type."""

Rule = Callable[[StructTypeInfo], StructConstructorSpec | None]


def asks_for_help(words: Sequence[str]) -> bool:
    """Return True if a command line asks for one of the two help pages."""
    return any(word in (*HELP, HELP_ALL) for word in words)


def make_help_rule(show_all: bool) -> Rule:
    """Return a rule by which tyro writes help pages. No option can be parsed with it."""
    entered: list[type] = []

    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        kind: Any = info.type
        if not is_shown(kind) or kind in entered:
            return None
        entered.append(kind)
        spec = ConstructorRegistry.get_struct_spec(info)
        entered.remove(kind)
        if not isinstance(spec, StructConstructorSpec):
            return None
        fields = (
            spec.fields
            if show_all or kind not in COMMON
            else select_common_fields(kind, spec.fields)
        )
        return replace(spec, fields=tuple(map(tidy_field, fields)))

    return rule


def is_shown(kind: Any) -> bool:
    """Return True for our classes of options. Settings of generators become options elsewhere."""
    if not isinstance(kind, type) or issubclass(kind, GeneratorSettings):
        return False
    return issubclass(kind, (Settings, GeneratorOptions))


def select_common_fields(kind: type, fields: Sequence[StructFieldSpec]) -> list[StructFieldSpec]:
    """Select the common fields of a command; groups of settings become one option."""
    by_name = {field.name: field for field in fields}
    chosen = [by_name[name] for name in COMMON[kind]]
    return [*map(collapse_group, chosen), ALL]


def collapse_group(field: StructFieldSpec) -> StructFieldSpec:
    """Replace a group of settings by the option that selects all of them."""
    if isinstance(field.default, CompleterConfig):
        return CONFIG
    return make_generator_field() if isinstance(field.default, GeneratorOptions) else field


def format_metavar(kind: Any) -> str:
    """Return the placeholder for the value of an option that may be left out."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    parts = [part for part in get_args(kind) if part is not NoneType]
    if get_origin(kind) is Literal:
        return "|".join(map(str, parts))
    if get_origin(kind) is tuple:
        several = parts[-1] is Ellipsis
        one = format_metavar(parts[0])
        return f"{one} [{one} ...]" if several else " ".join(map(format_metavar, parts))
    return "|".join(map(format_metavar, parts)) if parts else METAVARS[kind]


def tidy_field(field: StructFieldSpec) -> StructFieldSpec:
    """Join the lines of a help text, and hide a default that says nothing."""
    given = field.helptext

    def text() -> str | None:
        found = given() if callable(given) else given
        return None if found is None else " ".join(found.split())

    kind: Any = field.type
    if field.default is None:
        kind = Annotated[kind, tyro.conf.arg(metavar=format_metavar(kind))]
    if field.default is None or field.default is False or field.default == ():
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return replace(field, helptext=text, type=kind)
