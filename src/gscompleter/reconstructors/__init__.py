"""Ψ: posed views -> Gaussians and a depth map per view.

A reconstructor is anything callable with views. The table of names serves the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxtyping import Bool
from torch import Tensor

from gscompleter.errors import InputError, quoted
from gscompleter.types import Reconstruction, View
from gscompleter.weights.published import PUBLISHED


@runtime_checkable
class Reconstructor(Protocol):
    """Ψ of the paper.

    The views' cameras carry `near` and `far` in scene units when `GSCompleter` calls it. The
    Gaussians it returns lie in the world frame of the cameras and have its unit. All tensors it
    returns lie on the device of the views' images.
    """

    def __call__(self, views: Sequence[View]) -> Reconstruction: ...


@runtime_checkable
class Lifter(Protocol):
    """A Ψ that spares itself what a completion does not keep."""

    def lift(self, views: Sequence[View], wanted: Bool[Tensor, "h w"]) -> Reconstruction:
        """As a call, but of the Gaussians only those of the pixels `wanted` of the first view, a
        synthesized image."""


def reconstructed(
    reconstructor: Reconstructor,
    views: Sequence[View],
    wanted: Bool[Tensor, "h w"] | None = None,
) -> Reconstruction:
    """What Ψ makes of `views`, once all of it is seen to lie on the device of their images.

    Args:
        reconstructor: Ψ.
        views: Photographs, or a synthesized image and its anchor.
        wanted: Pixels of the first view whose Gaussians are enough; a Ψ may give all of them.

    Raises:
        ValueError: where a tensor lies elsewhere; the sentence names it.
    """
    if wanted is not None and isinstance(reconstructor, Lifter):
        found = reconstructor.lift(views, wanted)
    else:
        found = reconstructor(views)
    device = views[0].image.device
    for name, tensor in tensors_in(found, "the reconstruction"):
        if tensor.device != device:
            raise ValueError(
                f"the reconstructor returned {name} on {tensor.device}, and its views lie on "
                f"{device}; it must return all tensors on the device of the views' images"
            )
    return found


def tensors_in(value: object, name: str) -> Iterator[tuple[str, Tensor]]:
    """All tensors that a frozen value holds, each with the expression that leads to it."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from tensors_in(item, f"{name}[{i}]")
    elif is_dataclass(value):
        for field in fields(value):
            yield from tensors_in(getattr(value, field.name), f"{name}.{field.name}")


def _plane_sweep(weights: Path | None, device: str) -> Reconstructor:
    from gscompleter.reconstructors.plane_sweep import PlaneSweep

    if weights is not None:
        raise InputError(f"plane-sweep learned nothing and takes no weights; leave out {weights}.")
    return PlaneSweep()


def _feed_forward(name: str, weights: Path | None, device: str) -> Reconstructor:
    from gscompleter.reconstructors.feed_forward.build import build

    return build(name, weights, device)


RECONSTRUCTORS: dict[str, Callable[[Path | None, str], Reconstructor]] = {
    "plane-sweep": _plane_sweep,
    **{name: partial(_feed_forward, name) for name, w in PUBLISHED.items() if w.is_reconstructor},
}
"""How each reconstructor is made, from the path of its weights (None takes the published ones) and
the device that it runs on."""


def check_reconstructor(name: str) -> None:
    """Raise InputError where there is no reconstructor of that name."""
    if name not in RECONSTRUCTORS:
        raise InputError(
            f"There is no reconstructor '{quoted(name)}'; choose one of "
            f"{', '.join(RECONSTRUCTORS)}."
        )


def load_reconstructor(
    name: str, weights: Path | str | None = None, device: str = "cpu"
) -> Reconstructor:
    """The reconstructor called `name`.

    Args:
        name: One of RECONSTRUCTORS.
        weights: The file of its weights; None takes the published ones, which are downloaded
            where they are not on this machine.
        device: Where a network runs. `plane-sweep` computes on the CPU, wherever its views lie.

    Raises:
        InputError: where there is none of that name, it takes no weights and some are given, or
            they cannot be had or do not fit.
    """
    check_reconstructor(name)
    return RECONSTRUCTORS[name](None if weights is None else Path(weights), device)
