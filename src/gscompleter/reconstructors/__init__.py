"""Ψ: posed views -> Gaussians and a depth map per view.

A reconstructor is anything callable with views. The table of names serves the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from gscompleter.errors import InputError
from gscompleter.types import Reconstruction, View


@runtime_checkable
class Reconstructor(Protocol):
    """Ψ of the paper.

    The views' cameras carry `near` and `far` in scene units when `GSCompleter` calls it. The
    Gaussians it returns lie in the world frame of the cameras and have its unit.
    """

    def __call__(self, views: Sequence[View]) -> Reconstruction: ...


def _plane_sweep(weights: Path | None) -> Reconstructor:
    from gscompleter.reconstructors.plane_sweep import PlaneSweep

    if weights is not None:
        raise InputError(f"plane-sweep learned nothing and takes no weights; leave out {weights}.")
    return PlaneSweep()


RECONSTRUCTORS: dict[str, Callable[[Path | None], Reconstructor]] = {
    "plane-sweep": _plane_sweep,
}
"""How each reconstructor is made, from the path of its weights or, without one, the published
ones."""


def load_reconstructor(name: str, weights: Path | None = None) -> Reconstructor:
    """The reconstructor called `name`.

    Args:
        name: One of RECONSTRUCTORS.
        weights: The file of its weights; None takes the published ones, which are downloaded
            where they are not on this machine.

    Raises:
        InputError: where there is none of that name, it takes no weights and some are given, or
            they cannot be had or do not fit.
    """
    if name not in RECONSTRUCTORS:
        raise InputError(
            f"There is no reconstructor {name!r}; choose one of {', '.join(RECONSTRUCTORS)}."
        )
    return RECONSTRUCTORS[name](weights)
