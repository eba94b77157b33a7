"""The settings of the method as they are typed: the name of a config, and changes of its settings.

Which config `default` is depends on other words, such as those that name a splat. So what is typed
stays apart from the config that a command decides on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, TypedDict, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from gscompleter.config import CompleterConfig, load_config, read_file_changes
from gscompleter.config.settings import Settings, apply_changes

CONFIG_OPTION = "config"
"""The option that names a config; its settings have this word before them."""


@dataclass(frozen=True)
class ChosenConfig(Settings):
    """A config by its name, and settings that differ from it."""

    name: str = "default"
    """A name that `load_config` knows, or a YAML file."""
    changes: dict[str, Any] = field(default_factory=dict)
    """Values of settings by name; those of a group are a mapping of their own."""

    def decide(
        self,
        is_splat: bool,
        has_photographs: bool,
        adapt: Callable[[CompleterConfig], CompleterConfig] = lambda config: config,
    ) -> CompleterConfig:
        """Load the config for an input, and apply the changes.

        `adapt` changes the preset to what the command does, such as a removal. What the user gives,
        in a YAML file or as `changes`, wins over it.
        """
        config = load_config(self.name, is_splat, has_photographs, adapt)
        where = f"{CONFIG_OPTION}."
        return apply_changes(config, self.changes, where, where) if self.changes else config

    def gives(self, group: str, name: str) -> bool:
        """Check whether the user gives a setting, be it the one of the preset.

        The config was decided on before, so that a YAML file is there and intact.
        """
        places = (self.changes, read_file_changes(self.name) or {})
        return any(name in place.get(group, {}) for place in places)


def make_parsing_rule(
    has_settings: bool,
) -> Callable[[StructTypeInfo], StructConstructorSpec | None]:
    """Return a rule by which tyro parses `--config NAME`, and settings that are typed alone.

    Without `has_settings` it knows none of these: to prepare them takes tyro a tenth of a second.
    """
    named = Annotated[str, tyro.conf.arg(name=CONFIG_OPTION, prefix_name=False)]

    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if info.type is not ChosenConfig:
            return None
        name = StructFieldSpec("name", named, ChosenConfig.name, "")
        if not has_settings:
            return StructConstructorSpec(collect_changes, (name,))
        settings = make_changes_type(CompleterConfig)
        spec = ConstructorRegistry.get_struct_spec(
            StructTypeInfo.make(settings, tyro.MISSING, False)
        )
        assert isinstance(spec, StructConstructorSpec)
        return StructConstructorSpec(collect_changes, (name, *spec.fields))

    return rule


@cache
def make_changes_type(config: type) -> Any:
    """Make the type of a mapping with some settings of a group, by which tyro parses them.

    None has a default, so that tyro hands over those that were typed and no others.
    """
    hints = get_type_hints(config, include_extras=True)
    kinds = {
        one.name: make_changes_type(hints[one.name]) if has_group(one.default) else hints[one.name]
        for one in fields(config)
    }
    return TypedDict(config.__name__, kinds, total=False)  # type: ignore[operator]


def has_group(default: object) -> bool:
    """Return True if the default of a setting is a group of further ones; no group lacks one."""
    return default is not MISSING and is_dataclass(default)


def collect_changes(name: str, **settings: Any) -> ChosenConfig:
    """Collect the settings that were typed, and leave out groups without any."""
    return ChosenConfig(name, drop_empty(settings))


def drop_empty(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out groups without a setting."""
    inner = {
        name: drop_empty(value) if isinstance(value, dict) else value
        for name, value in settings.items()
    }
    return {name: value for name, value in inner.items() if value != {}}


def make_showing_rule(
    config: CompleterConfig,
) -> Callable[[StructTypeInfo], StructConstructorSpec | None]:
    """Return a rule by which help pages show the settings with the values of a config."""

    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if info.type is not ChosenConfig:
            return None
        spec = ConstructorRegistry.get_struct_spec(
            StructTypeInfo.make(CompleterConfig, config, False)
        )
        assert isinstance(spec, StructConstructorSpec)
        return spec

    return rule
