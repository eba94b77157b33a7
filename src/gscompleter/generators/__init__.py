"""Φ: nearest photograph and target camera -> the image at the target (paper, Eq. 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gscompleter.config.generators import (
    DiffusersInpaintSettings,
    GeneratorSettings,
    OracleSettings,
    PEFieldSettings,
    WarpInpaintSettings,
    settings_class,
)
from gscompleter.config.settings import checked
from gscompleter.errors import InputError
from gscompleter.types import Camera, SceneContext, View


@dataclass(frozen=True)
class Request:
    """Input of Φ for one image."""

    nearest: View
    """Photograph taken closest to `target`."""
    target: Camera
    context: SceneContext
    """All photographs, and renders of the current scene."""


@dataclass(frozen=True)
class Synthesis:
    """Output of Φ for one image."""

    image: Float[Tensor, "h w 3"]
    """In [0, 1], of the size of the target."""
    notes: tuple[str, ...] = ()
    """Sentences about the image for a reader of the results."""
    disagrees: bool = False
    """True if the image does not show the scene of the photographs."""


@runtime_checkable
class Generator(Protocol):
    """Interface of Φ."""

    @property
    def takes_margin(self) -> bool:
        """True if Φ can synthesize a padded target image."""

    @property
    def at_once(self) -> int:
        """Largest batch; with 1, each request sees what the previous ones added."""

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """Synthesize one image per request, in order."""


ImageFunction = Callable[[View, Camera, SceneContext], Tensor | Synthesis]
"""Simplest form of Φ: (nearest, target, context) -> image [h, w, 3] or `GeneratorOutput`."""


@dataclass(frozen=True)
class OneByOne:
    """A plain function as a generator, with padding and without batches."""

    function: ImageFunction
    takes_margin: bool = True
    at_once: int = 1

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """Call the function once per request."""
        answers = [self.function(r.nearest, r.target, r.context) for r in requests]
        return [a if isinstance(a, Synthesis) else Synthesis(a) for a in answers]


def as_generator(phi: Generator | ImageFunction) -> Generator:
    """Return `phi`, wrapped as a `Generator` if it is a plain function."""
    return phi if isinstance(phi, Generator) else OneByOne(phi)


def load_generator(
    name: str,
    seed: int = 0,
    photographs: Sequence[View] = (),
    device: str = "cpu",
    settings: GeneratorSettings | None = None,
) -> Generator:
    """Load a generator by name.

    Args:
        name: Name of the generator.
        seed: Random seed; the same seed gives the same image.
        photographs: True images of the targets, used by `oracle` only.
        device: Device of the network, cpu or cuda.
        settings: Settings of this generator, or None for the defaults.

    Raises:
        InputError: The name is unknown, packages or weights are missing, or the settings do not
            fit.
    """
    kind = settings_class(name)
    if not isinstance(settings, kind | None):
        raise InputError(
            f"The generator {name!r} takes {kind.__name__}, got {type(settings).__name__}.",
            "generator",
        )
    settings = checked(settings or kind(), "generator_")
    if getattr(settings, "offload", False) and device == "cpu":
        raise InputError(
            "offload keeps parts of the generator off the GPU, and it runs on the CPU; leave it "
            "out, or choose the device cuda.",
            "generator_offload",
        )
    return _made(settings, seed, photographs, device)


def _made(
    settings: GeneratorSettings, seed: int, photographs: Sequence[View], device: str
) -> Generator:
    match settings:
        case PEFieldSettings():
            from gscompleter.generators.diffusion.pe_field import load_pe_field

            return load_pe_field(seed, device, settings)
        case DiffusersInpaintSettings():
            from gscompleter.generators.diffusion.inpaint import load_diffusers_inpaint

            return OneByOne(load_diffusers_inpaint(seed, device, settings))
        case OracleSettings():
            from gscompleter.generators.oracle import Oracle

            return Oracle(photographs)
        case WarpInpaintSettings():
            from gscompleter.generators.warp_inpaint import WarpInpaint

            return OneByOne(WarpInpaint(seed))
    raise TypeError(f"no generator is made from {type(settings).__name__}")
