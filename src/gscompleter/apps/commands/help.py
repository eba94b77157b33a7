"""Help pages: `--help` shows the options that people use, `--help-all` all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from gscompleter.apps.commands.generator_options import GeneratorOptions
from gscompleter.apps.commands.options import (
    BatchOptions,
    BenchOptions,
    CleanOptions,
    CompleteOptions,
    EvaluateOptions,
    LiveOptions,
)
from gscompleter.config import CompleterConfig
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
    GeneratorOptions: ("generator",),
}
"""Fields that the short help shows, in their order. It shows all of other commands."""

CONFIG = StructFieldSpec(
    "config",
    str,
    "default",
    "Settings of the method: default, paper, an ablation such as no-sa, or a YAML file. Single "
    "settings are changed by options such as --config.holes.dilation 5.",
)
ALL = StructFieldSpec("help_all", bool, False, "Show all options and exit.")

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
        is_short = kind in COMMON and not show_all
        fields = select_common_fields(kind, spec.fields) if is_short else spec.fields
        return replace(spec, fields=tuple(map(tidy_field, fields)))

    return rule


def select_common_fields(kind: type, fields: Sequence[StructFieldSpec]) -> list[StructFieldSpec]:
    """Select the common fields of a class; the settings of the method become one option."""
    by_name = {field.name: field for field in fields}
    chosen = [by_name[name] for name in COMMON[kind]]
    chosen = [CONFIG if isinstance(f.default, CompleterConfig) else f for f in chosen]
    return chosen if kind is GeneratorOptions else [*chosen, ALL]


def tidy_field(field: StructFieldSpec) -> StructFieldSpec:
    """Join the lines of a help text, and hide a default that says nothing."""

    def text() -> str | None:
        found = field.helptext() if callable(field.helptext) else field.helptext
        return None if found is None else " ".join(found.split())

    kind: Any = field.type
    if field.default is None or field.default is False or field.default == ():
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return replace(field, helptext=text, type=kind)
