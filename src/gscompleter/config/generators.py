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
    """Settings of a generator that has none."""


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
    """Weights: a folder saved by diffusers, or USER/NAME or USER/NAME@COMMIT on the Hugging Face
    hub. By default the published ones of pe-field; diffusers-inpaint needs this option."""
    retries: Annotated[int, Interval(ge=0, le=100)] = 0
    """Further seeds to try if the image disagrees with the photographs."""
    offload: bool = False
    """Keep only the active part of the model on the GPU, which needs less GPU memory."""


@dataclass(frozen=True)
class PEFieldSettings(DiffusionSettings):
    """The paper's diffusion transformer."""

    steps: Steps = 4
    """Denoising steps. The paper uses 4, its authors' demo 28."""
    depth: Text | None = None
    """Depth of the photograph: context (rendered from the scene), monocular (a published network),
    or the folder or hub id of another network. By default context, or monocular with the config
    `paper`."""
    batch_size: Annotated[int, Interval(ge=1, le=1000)] = 4
    """Most target images to denoise together. Fewer need less memory."""


@dataclass(frozen=True)
class DiffusersInpaintSettings(DiffusionSettings):
    """Any inpainting pipeline of diffusers."""

    steps: Steps | None = None
    """Denoising steps; the pipeline's own number if not given."""
    prompt: Text = "a photograph"
    """Text prompt."""


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
