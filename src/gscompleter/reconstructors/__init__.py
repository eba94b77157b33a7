"""Ψ: posed views -> Gaussians and a depth map per view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.reconstruction_checks import check_reconstruction
from gscompleter.reconstructors.depth_predictors import DepthPredictor, load_depth_predictor
from gscompleter.reconstructors.own_models import load_own_model
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.plugins import is_in_file, load_plugins
from gscompleter.types import Camera, ChooseMasks, Reconstruction, View


@runtime_checkable
class Reconstructor(Protocol):
    """Interface of Ψ (paper, Eq. 5 and 7).

    The cameras carry `near` and `far` in scene units. The Gaussians have the frame and unit of the
    cameras, and all tensors are on the device of the view images.

    A Ψ that was trained on one depth range says so in an attribute `depth_range`, (near, far) in
    scene units; cameras without a range get it instead of an estimate. A range that is given is
    widened to what features show, unless Ψ has that attribute or says `keeps_range = True`.
    """

    def __call__(self, views: Sequence[View]) -> Reconstruction:
        """Reconstruct a scene from posed views."""
        ...


@runtime_checkable
class Lifter(Protocol):
    """Interface of a Ψ that can lift only some pixels of its first view."""

    def lift(self, views: Sequence[View], pixel_mask: Bool[Tensor, "h w"]) -> Reconstruction:
        """Reconstruct `views`, with the Gaussians of `pixel_mask` in the first view only."""


@runtime_checkable
class PartReconstructor(Protocol):
    """Interface of a Ψ that can reconstruct only what some pixels of its views show."""

    def reconstruct_part(self, views: Sequence[View], choose_masks: ChooseMasks) -> Reconstruction:
        """Reconstruct the depth of `views`, and the Gaussians that any shows in its mask.

        Depth comes first, and tells which pixels need Gaussians; there may be none.
        """


@runtime_checkable
class FittingReconstructor(Protocol):
    """Interface of a Ψ that can fit its scene to more than the photographs that it comes from."""

    def reconstruct_and_fit(
        self, views: Sequence[View], check_views: Sequence[View], targets: Sequence[Camera]
    ) -> Reconstruction:
        """Reconstruct a scene from `views`, and fit it to `check_views`, too.

        Photographs near `targets`, from which the scene will be looked at, count most. There may be
        none of either.
        """


@runtime_checkable
class NearPlaneFinder(Protocol):
    """Interface of a Ψ that tells from its matches that surfaces stand before the near plane."""

    def find_near_plane(self, views: Sequence[View], near: float, far: float) -> float:
        """Find a near plane, in scene units, that no surface stands before; at most `near`."""


@runtime_checkable
class DepthAware(Protocol):
    """Interface of a Ψ that lets monocular depth support its stereo."""

    predict_depth: DepthPredictor
    """Depth where stereo measures nothing, and the only one of a single photograph."""


def run_reconstructor(
    reconstructor: Reconstructor,
    views: Sequence[View],
    pixel_mask: Bool[Tensor, "h w"] | None = None,
) -> Reconstruction:
    """Run Ψ on `views`, and raise InputError if it returns what no scene can be.

    With `pixel_mask`, only these pixels of the first view need Gaussians; Ψ may return more.
    """
    if pixel_mask is not None and isinstance(reconstructor, Lifter):
        made = reconstructor.lift(views, pixel_mask)
    else:
        made = reconstructor(views)
    return accept_reconstruction(made, views)


def run_part_reconstructor(
    reconstructor: Reconstructor, views: Sequence[View], choose_masks: ChooseMasks
) -> Reconstruction:
    """Run Ψ on `views`, of which only what any shows in its mask needs Gaussians.

    Ψ may return more. Raises InputError as `run_reconstructor`.
    """
    if isinstance(reconstructor, PartReconstructor):
        made = reconstructor.reconstruct_part(views, choose_masks)
    else:
        made = reconstructor(views)
    return accept_reconstruction(made, views)


def run_fitting_reconstructor(
    reconstructor: Reconstructor,
    views: Sequence[View],
    check_views: Sequence[View],
    targets: Sequence[Camera],
) -> Reconstruction:
    """Run Ψ on `views`, and let it fit the scene to `check_views`, too, and for `targets`.

    There may be none of either. Raises InputError as `run_reconstructor`, and for check views that
    Ψ cannot use; a Ψ that cannot favour targets makes the same scene for all.
    """
    if isinstance(reconstructor, FittingReconstructor):
        made = reconstructor.reconstruct_and_fit(views, check_views, targets)
    elif check_views:
        raise InputError(
            "Check views need a scene that they check, or a reconstructor that fits its own to "
            "them, such as plane-sweep; leave them out."
        )
    else:
        made = reconstructor(views)
    return accept_reconstruction(made, views)


def accept_reconstruction(reconstruction: Reconstruction, views: Sequence[View]) -> Reconstruction:
    """Check what Ψ returns for `views`, and detach it."""
    check_reconstruction(reconstruction, views)
    return replace(
        reconstruction,
        gaussians=reconstruction.gaussians.detach(),
        depths=tuple(depth.detach() for depth in reconstruction.depths),
    )


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
        near, far = [float(bound) for bound in trained]
    except (TypeError, ValueError):
        raise refusal from None
    if not 0 < near < far:
        raise refusal
    return near, far


def keeps_given_range(reconstructor: Reconstructor) -> bool:
    """Return True if Ψ gets a given range of depths as it is, even if features contradict it.

    Learned models do: their authors' evaluation gives them one range for all scenes.
    """
    is_trained = get_trained_range(reconstructor) is not None
    return is_trained or bool(getattr(reconstructor, "keeps_range", False))


def _load_plane_sweep(weights: Path | None, device: str) -> Reconstructor:
    from gscompleter.reconstructors.plane_sweep import PlaneSweep

    if weights is not None:
        raise InputError(f"plane-sweep takes no weights; leave out {quote_value(weights)}.")
    return PlaneSweep(device=device)


RECONSTRUCTORS: dict[str, Callable[[Path | None, str], Reconstructor]] = {
    "plane-sweep": _load_plane_sweep
}
"""Loader of each built-in reconstructor: (weights path or None for the default, device) -> Ψ."""

RECONSTRUCTOR_PLUGINS = "gscompleter.reconstructors"
"""Group of entry points that name further tables of this form."""


def list_reconstructors() -> dict[str, Callable[[Path | None, str], Reconstructor]]:
    """List the loaders of all reconstructors, by name."""
    return RECONSTRUCTORS | load_plugins(RECONSTRUCTOR_PLUGINS)


def find_loader(name: str) -> Callable[[Path | None, str], Reconstructor] | None:
    """Find the loader of a reconstructor; None if there is none.

    A name such as `ffgs:FAMILY/VARIANT` in the table stands for all that begin with `ffgs:`; its
    loader takes the rest as `variant`.
    """
    if name in RECONSTRUCTORS:
        return RECONSTRUCTORS[name]
    loaders: dict[str, Any] = dict(list_reconstructors())
    family, colon, variant = name.partition(":")
    for known, load in loaders.items():
        if colon and variant and known.startswith(f"{family}:"):
            return partial(load, variant=variant)
    return loaders.get(name)


def check_reconstructor(name: str) -> None:
    """Raise InputError if no reconstructor has this name, or a named file has none."""
    if is_in_file(name):
        load_own(name, None)
        return
    if not isinstance(name, str) or find_loader(name) is None:
        raise InputError(
            f"There is no reconstructor '{quote_value(name)}'; choose one of "
            f"{', '.join(list_reconstructors())}, or name a function as file.py:function."
        )


def load_own(name: str, weights: Path | str | None) -> Reconstructor:
    """Load a reconstructor from `file.py:function`; errors as of `load_own_model`."""
    form = "views to a Reconstruction"
    reconstructor: Reconstructor = load_own_model(name, "reconstructor", form, weights, "weights")
    return reconstructor


def load_reconstructor(
    name: str,
    weights: Path | str | None = None,
    device: str = "cpu",
    depth: str = "none",
    depth_weights: Path | str | None = None,
) -> Reconstructor:
    """Load a reconstructor by name or from `file.py:function`.

    The named ones have published weights unless others are given.

    Published weights are downloaded if needed. `device` is that of the networks, on which
    `plane-sweep` matches photographs, too. `depth` names the monocular depth that supports it.
    """
    if is_in_file(name):
        reconstructor = load_own(name, weights)
    else:
        check_reconstructor(name)
        load = find_loader(name)
        assert load is not None
        reconstructor = load(None if weights is None else Path(weights), device)
    if depth == "none":
        if depth_weights is not None:
            raise InputError(
                f"No monocular depth is chosen that could take {quote_value(depth_weights)}; "
                "choose one, or leave the weights out.",
                "depth-weights",
            )
        return reconstructor
    if not isinstance(reconstructor, DepthAware) or not is_dataclass(reconstructor):
        raise InputError(
            f"The reconstructor '{name}' uses no monocular depth; leave it out.", "depth"
        )
    predictor = load_depth_predictor(
        depth, None if depth_weights is None else Path(depth_weights), device
    )
    # Loaders return frozen dataclasses.
    return replace(reconstructor, predict_depth=predictor)
