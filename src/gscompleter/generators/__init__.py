"""Φ: the nearest photograph and a target camera -> the image that camera would take.

A generator is any callable of that form. The table of names serves the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
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


@dataclass(frozen=True)
class GeneratorRequest:
    """What a generator of the table may be made from."""

    seed: int = 0
    """Of everything random in it; the same seed gives the same image."""
    photographs: Sequence[View] = ()
    """True images of the targets, which only `oracle` looks at."""
    path: str | None = None
    """Folder or hub id of its weights; None takes the published ones."""
    device: str = "cpu"
    """Where its network runs."""
    offload: bool = False
    """Keep on the GPU only the part of the network that is at work."""


def _warp_inpaint(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.warp_inpaint import WarpInpaint

    return WarpInpaint(seed=request.seed)


def _oracle(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.oracle import Oracle

    return Oracle(request.photographs)


def _pe_field(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.diffusion.loading import load_kontext
    from gscompleter.generators.diffusion.pe_field import PEField

    return PEField(load_kontext(request.path, request.device, request.offload), request.seed)


def _diffusers_inpaint(request: GeneratorRequest) -> Generator:
    from gscompleter.generators.diffusion.inpaint import DiffusersInpaint, load_painter

    return DiffusersInpaint(
        load_painter(request.path, request.device, request.offload), request.seed
    )


GENERATORS: dict[str, Callable[[GeneratorRequest], Generator]] = {
    "warp-inpaint": _warp_inpaint,
    "oracle": _oracle,
    "pe-field": _pe_field,
    "diffusers-inpaint": _diffusers_inpaint,
}
WITH_WEIGHTS = ("pe-field", "diffusers-inpaint")
"""Those that load weights, and so can be told where these lie."""


def load_generator(
    name: str,
    seed: int = 0,
    photographs: Sequence[View] = (),
    path: str | None = None,
    device: str = "cpu",
    offload: bool = False,
) -> Generator:
    """The generator called `name`.

    Args:
        name: A name of the table.
        seed: Of everything random in it; the same seed gives the same image.
        photographs: True images of the targets, which only `oracle` looks at.
        path: Folder or hub id of its weights, for those that have any; None takes the published
            ones.
        device: Where its network runs, if it has one: cpu or cuda.
        offload: Keep on a GPU only the part of it that is at work: slower, and less memory.

    Raises:
        InputError: where there is none of that name, packages or weights are missing, or a path
            is given to one that has no weights.
    """
    if name not in GENERATORS:
        raise InputError(f"There is no generator {name!r}; choose one of {', '.join(GENERATORS)}.")
    if path is not None and name not in WITH_WEIGHTS:
        raise InputError(
            f"The generator {name!r} has no weights to load from {path}; leave --generator-path "
            f"out, or choose one of {', '.join(WITH_WEIGHTS)}."
        )
    return GENERATORS[name](GeneratorRequest(seed, photographs, path, device, offload))
