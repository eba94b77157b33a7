"""Help pages: the options of a command in groups, and its description with an example."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from types import UnionType
from typing import Annotated, Any, ClassVar, Union, get_args, get_origin

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from gscompleter.apps.command_line.chosen_config import ChosenConfig
from gscompleter.apps.command_line.command_list import HELP_ALL
from gscompleter.apps.command_line.field_texts import find_field_text
from gscompleter.config.settings import Settings

CONFIG = StructFieldSpec(
    "config",
    str,
    "default",
    "Settings of the method: default, paper, an ablation such as no-sa, or a YAML file. Single "
    f"settings are changed by options such as --config.holes.dilation 5; {HELP_ALL} lists them.",
)

Rule = Callable[[StructTypeInfo], StructConstructorSpec | None]


@dataclass(frozen=True)
class Group:
    """A box of options on a help page, whose title is its name and the word `options`."""

    name: str
    description: str
    options: tuple[str, ...]
    """Names of the fields, in the order of the page."""


# fmt: off
HELP_GROUPS = (
    Group("input", "What is given, and how it is read.", (
        "scene", "cameras", "up", "photos", "geometry", "context", "format", "frames",
        "resolution", "near", "far", "no_given_depth", "no_refine_poses", "no_masks", "ignore",
        "invert_masks", "large_masks", "ignore_moving", "no_ego_mask", "drop_nonfinite",
        "ignore_properties",
    )),
    Group("computing", "Models, settings, and where they run.", (
        "reconstructor", "weights", "depth", "depth_weights", "config", "device",
        "renderer_device", "network_device", "threads", "seed", "engine", "workers", "retries",
        "address", "gpus", "slurm", "shard",
    )),
)
"""Options that stand in boxes of their own; all others say what to do, and come first."""
# fmt: on
LAST = ("overwrite", "quiet", "json")
"""Options that end the first box."""


class GroupedOptions:
    """The type of a group on a help page; each group has a subclass with its fields."""

    fields: ClassVar[tuple[StructFieldSpec, ...]] = ()


def make_help_rule(show_all: bool) -> Rule:
    """Return a rule by which tyro writes help pages. No option can be parsed with it."""
    # Classes whose own specification is being made: for them the rule gives way to tyro's.
    entered: list[type] = []

    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        kind: Any = info.type
        if isinstance(kind, type) and issubclass(kind, GroupedOptions):
            return StructConstructorSpec(kind, kind.fields)
        if not isinstance(kind, type) or not issubclass(kind, Settings) or kind in entered:
            return None
        entered.append(kind)
        spec = ConstructorRegistry.get_struct_spec(info)
        entered.remove(kind)
        if not isinstance(spec, StructConstructorSpec):
            return None
        # The options of a command itself come first, those that it shares with others after them.
        own = inspect.get_annotations(kind)
        ordered = sorted(spec.fields, key=lambda field: (field.name in LAST, field.name not in own))
        fields = [tidy_field(kind, field, show_all) for field in ordered]
        return replace(spec, fields=tuple(group_fields(fields)))

    return rule


def group_fields(fields: Sequence[StructFieldSpec]) -> list[StructFieldSpec]:
    """Put the fields of a command into the boxes of `HELP_GROUPS`.

    Settings within the options, such as those of the method, have boxes already and come last.
    """
    structures = [field for field in fields if isinstance(field.default, Settings)]
    first = [field for field in fields if is_positional(field)]
    left = {field.name: field for field in fields if field not in (*structures, *first)}
    boxes = []
    for group in HELP_GROUPS:
        inside = tuple(left.pop(name) for name in group.options if name in left)
        if not inside:
            continue
        # tyro writes the docstring of a structure above its options.
        members = {"fields": inside, "__doc__": group.description}
        kind: Any = type(GroupedOptions.__name__, (GroupedOptions,), members)
        kind = Annotated[kind, tyro.conf.OmitArgPrefixes]
        boxes.append(StructFieldSpec(group.name, kind, tyro.MISSING, group.description))
    return [*first, *left.values(), *boxes, *structures]


def is_positional(field: StructFieldSpec) -> bool:
    """Check whether a field is given by its place, as SCENE."""
    return tyro.conf.Positional in get_args(field.type)[1:]


def tidy_field(owner: type, field: StructFieldSpec, show_all: bool) -> StructFieldSpec:
    """Join the lines of the help text of a field, and hide a default that says nothing.

    Unless `show_all` is set, the settings of the method become one option.
    """
    if isinstance(field.default, ChosenConfig) and not show_all:
        return CONFIG

    def text() -> str | None:
        # Docstrings are wrapped in the source; tyro wraps them again to the terminal's width.
        # Fields of another class may be shown as those of `owner`.
        if any(field.name == own.name for own in fields(owner)):
            original = find_field_text(owner, field.name)
        else:
            original = field.helptext() if callable(field.helptext) else field.helptext
        return None if original is None else " ".join(original.split())

    kind: Any = field.type
    if field.default is None or field.default is False or field.default == ():
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    elif is_positional(field) and field.default is tyro.MISSING_NONPROP:
        # tyro shows an empty default of those that take several values.
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="(required)")]
    return replace(field, helptext=text, type=make_plain_type(kind))


def make_plain_type(kind: Any) -> Any:
    """Make a type that tyro shows as `kind` and does not compare a default with.

    For unions and tuples it imports typeguard to do so, which takes a third of the time of a page.
    """
    inner, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    if get_origin(inner) not in (UnionType, Union, tuple):
        return kind
    # The one mark of those that `call_tyro` sets for all options that changes how a type is shown.
    info = PrimitiveTypeInfo.make(kind, {tyro.conf.DisallowNone})
    spec = ConstructorRegistry.get_primitive_spec(info)
    assert isinstance(spec, PrimitiveConstructorSpec)
    plain: Any = Annotated[object, spec]
    for mark in marks:
        plain = Annotated[plain, mark]
    return plain


def describe_command(kind: type) -> str:
    """Return the description of a command: the paragraphs of its docstring, one a line."""
    paragraphs = inspect.cleandoc(kind.__doc__ or "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
