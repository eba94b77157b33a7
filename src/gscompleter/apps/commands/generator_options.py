"""Options `--generator NAME` and `--generator-SETTING VALUE`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, cast

from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from gscompleter.config.generators import GENERATORS, GeneratorSettings, get_settings_class
from gscompleter.errors import InputError, quote_value

PREFIX = "generator_"
DEFAULT = "warp-inpaint"


@dataclass(frozen=True)
class GeneratorOptions:
    """Choice of the generator."""

    name: str = DEFAULT
    given: Mapping[str, Any] = field(default_factory=dict)

    def make_settings(self) -> GeneratorSettings:
        """Return the settings, or raise InputError if one is unknown to the generator."""
        kind = get_settings_class(self.name)
        for setting, value in self.given.items():
            knowing = [name for name, kind in GENERATORS.items() if hasattr(kind, setting)]
            if self.name not in knowing:
                raise InputError(
                    f"The generator {self.name!r} has no setting {setting} ({quote_value(value)}); "
                    f"leave it out, or choose {' or '.join(knowing)}.",
                    PREFIX + setting,
                )
        return kind(**self.given)

    def describe(self) -> dict[str, Any]:
        """Describe the generator for `summary.json`."""
        settings = asdict(self.make_settings())
        return {"generator": self.name, **{PREFIX + name: settings[name] for name in settings}}


def make_generator_spec(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Tell tyro to read GeneratorOptions as the union of all generators' settings."""
    if info.type is not GeneratorOptions:
        return None
    known: dict[str, list[tuple[str, StructFieldSpec]]] = {}
    for name, kind in GENERATORS.items():
        for spec in get_fields(kind):
            known.setdefault(spec.name, []).append((name, spec))
    return StructConstructorSpec(
        make_generator_options, (make_generator_field(), *map(merge_fields, known.values()))
    )


def make_generator_field() -> StructFieldSpec:
    """Return the option `--generator`."""
    kinds = "; ".join(
        f"{name}: {(kind.__doc__ or '').rstrip('.')}" for name, kind in GENERATORS.items()
    )
    sentence = f"Model that synthesizes the image at a target. {kinds}."
    return StructFieldSpec("generator", str, DEFAULT, sentence)


def get_fields(kind: type[GeneratorSettings]) -> tuple[StructFieldSpec, ...]:
    """Return the fields of a class of settings."""
    spec = ConstructorRegistry.get_struct_spec(StructTypeInfo.make(kind, kind(), False))
    assert isinstance(spec, StructConstructorSpec)
    return spec.fields


def merge_fields(known: Sequence[tuple[str, StructFieldSpec]]) -> StructFieldSpec:
    """Merge the fields of several generators with one name into one optional option."""
    first = known[0][1]
    sentences: dict[str, list[str]] = {}
    for name, spec in known:
        text = spec.helptext() if callable(spec.helptext) else spec.helptext
        default = f" ({spec.default})" if spec.default else ""
        sentences.setdefault(" ".join((text or "").split()), []).append(name + default)
    switch = first.type is bool
    return StructFieldSpec(
        PREFIX + first.name,
        first.type if switch else cast(type, first.type | None),
        False if switch else None,
        " ".join(f"{', '.join(names)}: {text}" for text, names in sentences.items()),
    )


def make_generator_options(generator: str, **values: Any) -> GeneratorOptions:
    """Create the options from those values that were given."""
    given = {
        name.removeprefix(PREFIX): value
        for name, value in values.items()
        if value is not None and value is not False
    }
    return GeneratorOptions(generator, given)
