"""Ψ: posed views -> Gaussians and a depth map per view.

A reconstructor is anything callable with views. The table of names serves the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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


def _plane_sweep() -> Reconstructor:
    from gscompleter.reconstructors.plane_sweep import PlaneSweep

    return PlaneSweep()


RECONSTRUCTORS: dict[str, Callable[[], Reconstructor]] = {
    "plane-sweep": _plane_sweep,
}


def load_reconstructor(name: str) -> Reconstructor:
    """The reconstructor called `name`.

    Raises:
        InputError: where there is none of that name.
    """
    if name not in RECONSTRUCTORS:
        raise InputError(
            f"There is no reconstructor {name!r}; choose one of {', '.join(RECONSTRUCTORS)}."
        )
    return RECONSTRUCTORS[name]()
