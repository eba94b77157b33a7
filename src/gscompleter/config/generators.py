"""Settings of each generator, by its name. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval, MinLen

from gscompleter.config.settings import Settings
from gscompleter.errors import InputError, quote_value
from gscompleter.plugins import load_plugins

Text = Annotated[str, MinLen(1)]
Steps = Annotated[int, Interval(ge=1, le=1000)]


@dataclass(frozen=True)
class GeneratorSettings(Settings):
    """Settings of a generator; each is an option that the class `GeneratorOptions` explains."""


@dataclass(frozen=True)
class WarpInpaintSettings(GeneratorSettings):
    """Photographs warped to the target, with holes filled by patches (needs no weights)."""


@dataclass(frozen=True)
class OracleSettings(GeneratorSettings):
    """The real photograph of the target, for measurements."""


@dataclass(frozen=True)
class DiffusionSettings(GeneratorSettings):
    """Settings of a generator with weights."""

    weights: Text | None = None
    retries: Annotated[int, Interval(ge=0, le=100)] = 0
    offload: bool = False


@dataclass(frozen=True)
class PEFieldSettings(DiffusionSettings):
    """The paper's diffusion transformer."""

    steps: Steps = 4
    depth: Text | None = None
    batch_size: Annotated[int, Interval(ge=1, le=1000)] = 4


@dataclass(frozen=True)
class DiffusersInpaintSettings(DiffusionSettings):
    """Any inpainting pipeline of diffusers."""

    steps: Steps | None = None
    prompt: Text = "a photograph"


GENERATORS: dict[str, type[GeneratorSettings]] = {
    "warp-inpaint": WarpInpaintSettings,
    "oracle": OracleSettings,
    "pe-field": PEFieldSettings,
    "diffusers-inpaint": DiffusersInpaintSettings,
}

PLUGINS = "gscompleter.generators"
"""Group of entry points that name tables of further generators, from name to loader."""


def get_settings_class(name: str) -> type[GeneratorSettings]:
    """Return the class of a generator's settings, or raise InputError for an unknown name."""
    if name in GENERATORS:
        return GENERATORS[name]
    others = load_plugins(PLUGINS)
    if name in others:
        return GeneratorSettings
    raise InputError(
        f"There is no generator '{quote_value(name)}'; choose one of "
        f"{', '.join(dict.fromkeys([*GENERATORS, *others]))}.",
        "generator",
    )
