"""Φ: the nearest photograph and a target camera -> the image that camera would take.

A generator says what it needs and answers requests; any callable of the form above is taken for one
(`as_generator`). The table of names serves the command line.
"""

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
    """One image that Φ is asked for."""

    nearest: View
    """The photograph taken closest to `target`."""
    target: Camera
    context: SceneContext
    """All photographs, and renders of the scene as it is; what Φ uses of it is its own affair."""


@dataclass(frozen=True)
class Synthesis:
    """What Φ answers."""

    image: Float[Tensor, "h w 3"]
    """In [0, 1], of the size of the target."""
    notes: tuple[str, ...] = ()
    """What a reader of the results should know of it, a sentence each."""
    disagrees: bool = False
    """Whether the photographs say that it shows something else."""


@runtime_checkable
class Generator(Protocol):
    """Φ of the paper: what it needs, and the images that it synthesizes."""

    @property
    def takes_margin(self) -> bool:
        """Whether it can draw more than a target's own image, which is then completed wider."""

    @property
    def at_once(self) -> int:
        """Most requests that it takes together; with 1 each sees what the ones before added."""

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """An answer for each of `requests`, in their order."""


ImageFunction = Callable[[View, Camera, SceneContext], Tensor | Synthesis]
"""Φ at its simplest: (nearest, target, context) -> an image [h, w, 3], or one with notes."""


@dataclass(frozen=True)
class OneByOne:
    """A plain function as a generator: one request at a time, with the margin."""

    function: ImageFunction
    takes_margin: bool = True
    at_once: int = 1

    def synthesize(self, requests: Sequence[Request]) -> list[Synthesis]:
        """What the function answers to each of `requests`."""
        answers = [self.function(r.nearest, r.target, r.context) for r in requests]
        return [a if isinstance(a, Synthesis) else Synthesis(a) for a in answers]


def as_generator(phi: Generator | ImageFunction) -> Generator:
    """`phi` itself, or the plain function that it is as a generator."""
    return phi if isinstance(phi, Generator) else OneByOne(phi)


def load_generator(
    name: str,
    seed: int = 0,
    photographs: Sequence[View] = (),
    device: str = "cpu",
    settings: GeneratorSettings | None = None,
) -> Generator:
    """The generator called `name`.

    Args:
        name: A name of the table.
        seed: Of everything random in it; the same seed gives the same image.
        photographs: True images of the targets, which only `oracle` looks at.
        device: Where its network runs, if it has one: cpu or cuda.
        settings: Of the class that the table has for it; None leaves all as it is. A network is
            loaded once in a process.

    Raises:
        InputError: where there is none of that name, packages or weights are missing, or settings
            are another generator's, or out of range.
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
    """The generator that has such settings. Its module is imported only now."""
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
