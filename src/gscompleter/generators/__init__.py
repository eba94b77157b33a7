"""Φ: the nearest photograph and a target camera -> the image that camera would take.

A generator is any callable of that form. The table of names serves the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


def _warp_inpaint(seed: int, photographs: Sequence[View]) -> Generator:
    from gscompleter.generators.warp_inpaint import WarpInpaint

    return WarpInpaint(seed=seed)


def _oracle(seed: int, photographs: Sequence[View]) -> Generator:
    from gscompleter.generators.oracle import Oracle

    return Oracle(photographs)


GENERATORS: dict[str, Callable[[int, Sequence[View]], Generator]] = {
    "warp-inpaint": _warp_inpaint,
    "oracle": _oracle,
}


def load_generator(name: str, seed: int = 0, photographs: Sequence[View] = ()) -> Generator:
    """The generator called `name`.

    Args:
        name: A name of the table.
        seed: Of everything random in it; the same seed gives the same image.
        photographs: True images of the targets, which only `oracle` looks at.

    Raises:
        InputError: where there is none of that name.
    """
    if name not in GENERATORS:
        raise InputError(f"There is no generator {name!r}; choose one of {', '.join(GENERATORS)}.")
    return GENERATORS[name](seed, photographs)
