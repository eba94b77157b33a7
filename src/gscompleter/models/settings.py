"""Settings of the generators with weights; `GeneratorOptions` has an option for each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval, MinLen

from gscompleter.config.generators import GeneratorSettings

Text = Annotated[str, MinLen(1)]
Steps = Annotated[int, Interval(ge=1, le=1000)]


@dataclass(frozen=True)
class FileSettings(GeneratorSettings):
    """Settings of a generator with weights."""

    weights: Text | None = None


@dataclass(frozen=True)
class DiffusionSettings(FileSettings):
    """Settings of a generator that denoises."""

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


@dataclass(frozen=True)
class Flux2KleinSettings(DiffusersInpaintSettings):
    """FLUX.2 [klein], which edits the painted-over image beside the nearest photograph."""

    weights: str | None = (
        "black-forest-labs/FLUX.2-klein-4B@e7b7dc27f91deacad38e78976d1f2b499d76a294"
    )
    steps: int | None = 4
