"""Φ: the nearest photograph and a target camera -> the image that camera would take.

A generator is any callable of that form. The table of names serves the command line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.generator_settings import (
    DiffusersInpaintSettings,
    GeneratorSettings,
    OracleSettings,
    PEFieldSettings,
    WarpInpaintSettings,
    settings_class,
)
from gscompleter.settings import checked
from gscompleter.types import Camera, SceneContext, View


@runtime_checkable
class Generator(Protocol):
    """Φ of the paper: `image = generator(nearest, target, context)`.

    `nearest` is the photograph taken closest to `target`. What a generator uses of `context`
    (all photographs, and renders of the scene as it is) is its own affair.
    """

    def __call__(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> Float[Tensor, "h w 3"]: ...


@runtime_checkable
class NotingGenerator(Protocol):
    """A generator that also tells what to know of its image, a sentence each, for the report."""

    def __call__(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> Float[Tensor, "h w 3"]: ...

    def with_notes(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> tuple[Float[Tensor, "h w 3"], tuple[str, ...]]: ...


@runtime_checkable
class BatchGenerator(Protocol):
    """A generator that synthesizes several targets at once, none of which waits for another."""

    @property
    def at_once(self) -> int:
        """Most targets that it takes together."""

    def __call__(
        self, nearest: View, target: Camera, context: SceneContext
    ) -> Float[Tensor, "h w 3"]: ...

    def batch(
        self, calls: Sequence[tuple[View, Camera, SceneContext]]
    ) -> list[tuple[Tensor, tuple[str, ...]]]:
        """Image [h, w, 3] and notes for each of `calls`, in their order."""


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

            return load_diffusers_inpaint(seed, device, settings)
        case OracleSettings():
            from gscompleter.generators.oracle import Oracle

            return Oracle(photographs)
        case WarpInpaintSettings():
            from gscompleter.generators.warp_inpaint import WarpInpaint

            return WarpInpaint(seed)
    raise TypeError(f"no generator is made from {type(settings).__name__}")
