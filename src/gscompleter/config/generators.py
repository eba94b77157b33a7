"""What each generator can be told, by its name. Nothing here needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval, MinLen

from gscompleter.config.settings import Settings
from gscompleter.errors import InputError, quoted

Text = Annotated[str, MinLen(1)]
Steps = Annotated[int, Interval(ge=1, le=1000)]


@dataclass(frozen=True)
class GeneratorSettings(Settings):
    """A generator that can be told nothing."""


@dataclass(frozen=True)
class WarpInpaintSettings(GeneratorSettings):
    """The photographs warped into the target and completed by patches, without weights"""


@dataclass(frozen=True)
class OracleSettings(GeneratorSettings):
    """The true photograph"""


@dataclass(frozen=True)
class DiffusionSettings(GeneratorSettings):
    """A generator with weights"""

    weights: Text | None = None
    """Its weights: a folder that diffusers saved, or USER/NAME or USER/NAME@COMMIT on the Hugging
    Face hub. Without it, the published ones of pe-field; diffusers-inpaint must be told."""
    retries: Annotated[int, Interval(ge=0, le=100)] = 0
    """How many further seeds are tried where its image disagrees with the photographs."""
    offload: bool = False
    """Keep on the GPU only the part of it that is at work, the rest in main memory."""


@dataclass(frozen=True)
class PEFieldSettings(DiffusionSettings):
    """The paper's diffusion transformer"""

    steps: Steps = 4
    """Evaluations of the transformer. The paper takes 4, its authors' demonstration 28."""
    depth: Text | None = None
    """Where it takes the depth of the photograph from: context, the scene itself; monocular, a
    published network; or the folder or hub id of another one. Left out, it is context, or
    monocular with the settings `paper`."""
    batch_size: Annotated[int, Interval(ge=1, le=1000)] = 4
    """How many targets it denoises together, at most. Fewer need less memory."""


@dataclass(frozen=True)
class DiffusersInpaintSettings(DiffusionSettings):
    """Any inpainting pipeline of diffusers"""

    steps: Steps | None = None
    """Its denoising steps. Without it, as many as the pipeline itself takes."""
    prompt: Text = "a photograph"
    """What it is told of the image, in words."""


GENERATORS: dict[str, type[GeneratorSettings]] = {
    "warp-inpaint": WarpInpaintSettings,
    "oracle": OracleSettings,
    "pe-field": PEFieldSettings,
    "diffusers-inpaint": DiffusersInpaintSettings,
}


def settings_class(name: str) -> type[GeneratorSettings]:
    """The class of the settings of the generator called `name`.

    Raises:
        InputError: where there is none of that name.
    """
    if name not in GENERATORS:
        raise InputError(
            f"There is no generator '{quoted(name)}'; choose one of {', '.join(GENERATORS)}.",
            "generator",
        )
    return GENERATORS[name]
