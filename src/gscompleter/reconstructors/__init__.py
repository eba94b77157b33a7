"""Ψ: posed views -> Gaussians and a depth map per view."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxtyping import Bool
from torch import Tensor

from gscompleter.errors import InputError, quote_value
from gscompleter.plugins import load_plugins
from gscompleter.reconstructors.depth_predictors import load_depth_predictor
from gscompleter.types import Reconstruction, View


@runtime_checkable
class Reconstructor(Protocol):
    """Interface of Ψ (paper, Eq. 5 and 7).

    The cameras carry `near` and `far` in scene units. The Gaussians have the frame and unit of the
    cameras, and all tensors are on the device of the view images.

    A Ψ that was trained on one depth range says so in an attribute `depth_range`, (near, far) in
    scene units; cameras without a range get it instead of an estimate.
    """

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct a scene from posed views."""
        ...


@runtime_checkable
class Lifter(Protocol):
    """Interface of a Ψ that can lift only some pixels of its first view."""

    def lift(self, views: Sequence[View], pixel_mask: Bool[Tensor, "h w"]) -> Reconstruction:
        """Reconstruct `views`, with the Gaussians of `pixel_mask` in the first view only."""


def run_reconstructor(
    reconstructor: Reconstructor,
    views: Sequence[View],
    pixel_mask: Bool[Tensor, "h w"] | None = None,
) -> Reconstruction:
    """Run Ψ on `views` and raise ValueError if its result is on another device.

    With `pixel_mask`, only these pixels of the first view need Gaussians; Ψ may return more.
    """
    if pixel_mask is not None and isinstance(reconstructor, Lifter):
        found = reconstructor.lift(views, pixel_mask)
    else:
        found = reconstructor(views)
    device = views[0].image.device
    for name, tensor in iterate_tensors(found, "the reconstruction"):
        if tensor.device != device:
            raise ValueError(
                f"the reconstructor returned {name} on {tensor.device}, and its views are on "
                f"{device}; it must return all tensors on the device of the views' images"
            )
    return found


def get_trained_range(reconstructor: Reconstructor) -> tuple[float, float] | None:
    """Return near and far that Ψ was trained on, in scene units; None if it adapts to any.

    Raise InputError if the attribute of Ψ is no such pair.
    """
    trained = getattr(reconstructor, "depth_range", None)
    if trained is None:
        return None
    refusal = InputError(
        f"The attribute depth_range of the reconstructor is {quote_value(trained)}; near and far "
        "z-depth are needed, positive and in this order, or None."
    )
    try:
        near, far = (float(bound) for bound in trained)
    except (TypeError, ValueError):
        raise refusal from None
    if not 0 < near < far:
        raise refusal
    return near, far


def iterate_tensors(value: object, name: str) -> Iterator[tuple[str, Tensor]]:
    """Yield every tensor inside nested dataclasses and tuples, with its attribute path."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from iterate_tensors(item, f"{name}[{i}]")
    elif is_dataclass(value):
        for field in fields(value):
            yield from iterate_tensors(getattr(value, field.name), f"{name}.{field.name}")


def _load_plane_sweep(weights: Path | None, device: str) -> Reconstructor:
    from gscompleter.reconstructors.plane_sweep import PlaneSweep

    if weights is not None:
        raise InputError(f"plane-sweep takes no weights; leave out {weights}.")
    return PlaneSweep()


RECONSTRUCTORS: dict[str, Callable[[Path | None, str], Reconstructor]] = {
    "plane-sweep": _load_plane_sweep
}
"""Loader of each built-in reconstructor: (weights path or None for the default, device) -> Ψ."""

PLUGINS = "gscompleter.reconstructors"
"""Group of entry points that name further tables of this form."""


def list_reconstructors() -> dict[str, Callable[[Path | None, str], Reconstructor]]:
    """List the loaders of all reconstructors, by name."""
    return RECONSTRUCTORS | load_plugins(PLUGINS)


def check_reconstructor(name: str) -> None:
    """Raise InputError if no reconstructor has this name."""
    if name not in RECONSTRUCTORS and name not in list_reconstructors():
        raise InputError(
            f"There is no reconstructor '{quote_value(name)}'; choose one of "
            f"{', '.join(list_reconstructors())}."
        )


def load_reconstructor(
    name: str,
    weights: Path | str | None = None,
    device: str = "cpu",
    depth: str = "none",
    depth_weights: Path | str | None = None,
) -> Reconstructor:
    """Load a reconstructor by name, with published weights unless others are given.

    Published weights are downloaded if needed. `device` is that of the networks; `plane-sweep`
    itself runs on the CPU. `depth` names the monocular depth that supports it.
    """
    check_reconstructor(name)
    load = RECONSTRUCTORS.get(name) or list_reconstructors()[name]
    made = load(None if weights is None else Path(weights), device)
    if depth == "none":
        return made
    if "predict_depth" not in getattr(made, "__dataclass_fields__", ()):
        raise InputError(
            f"The reconstructor '{name}' uses no monocular depth; leave it out.", "depth"
        )
    given = None if depth_weights is None else Path(depth_weights)
    return replace(made, predict_depth=load_depth_predictor(depth, given, device))  # type: ignore[type-var]
