"""Ψ: posed views -> Gaussians and a depth map per view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.numerics.value_checks import check_gaussians, check_notes
from gscompleter.reconstructors.depth_predictors import DepthPredictor, load_depth_predictor
from gscompleter.reconstructors.own_models import load_own_model
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.plugins import is_in_file, load_plugins
from gscompleter.system.tensor_checks import describe, is_whole_number, iterate_tensors, name_dtype
from gscompleter.types import ChooseMasks, Reconstruction, View


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
    """Interface of a Ψ that can fit its scene to photographs that it makes no Gaussians of."""

    def reconstruct_and_fit(
        self, views: Sequence[View], check_views: Sequence[View]
    ) -> Reconstruction:
        """Reconstruct a scene from `views`, and fit it to `check_views`, too."""


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
        return accept_reconstruction(reconstructor.lift(views, pixel_mask), views)
    return accept_reconstruction(reconstructor(views), views)


def run_part_reconstructor(
    reconstructor: Reconstructor, views: Sequence[View], choose_masks: ChooseMasks
) -> Reconstruction:
    """Run Ψ on `views`, of which only what any shows in its mask needs Gaussians.

    Ψ may return more. Raises InputError as `run_reconstructor`.
    """
    if isinstance(reconstructor, PartReconstructor):
        return accept_reconstruction(reconstructor.reconstruct_part(views, choose_masks), views)
    return accept_reconstruction(reconstructor(views), views)


def run_fitting_reconstructor(
    reconstructor: Reconstructor, views: Sequence[View], check_views: Sequence[View]
) -> Reconstruction:
    """Run Ψ on `views`, and let it fit the scene to `check_views`, too; there may be none.

    Raises InputError as `run_reconstructor`, and for check views that Ψ cannot use.
    """
    if not check_views:
        return run_reconstructor(reconstructor, views)
    if not isinstance(reconstructor, FittingReconstructor):
        raise InputError(
            "Check views need a scene that they check, or a reconstructor that fits its own to "
            "them, such as plane-sweep; leave them out."
        )
    return accept_reconstruction(reconstructor.reconstruct_and_fit(views, check_views), views)


def accept_reconstruction(reconstruction: Reconstruction, views: Sequence[View]) -> Reconstruction:
    """Check what Ψ returns for `views`, and detach it."""
    check_reconstruction(reconstruction, views)
    return replace(
        reconstruction,
        gaussians=reconstruction.gaussians.detach(),
        depths=tuple(depth.detach() for depth in reconstruction.depths),
    )


def check_reconstruction(output: object, views: Sequence[View]) -> None:
    """Raise InputError if the output of Ψ does not fit its views, or holds impossible numbers.

    On a GPU this waits a few times.
    """
    if not isinstance(output, Reconstruction):
        raise InputError(
            f"The reconstructor has to return a Reconstruction, and returned {describe(output)}."
        )
    device = views[0].image.device
    for name, tensor in iterate_tensors(output, "the reconstruction"):
        if tensor.device != device:
            raise InputError(
                f"the reconstructor returned {name} on {tensor.device}, and its views are on "
                f"{device}; it must return all tensors on the device of the views' images"
            )
    check_gaussians(output.gaussians, "The reconstruction")
    if bool((output.gaussians.generated != 0).any()):
        raise InputError(
            "The reconstruction labels Gaussians as generated, and all of them are observed; "
            "return zeros in `generated`."
        )
    _check_depths(output, views)
    _check_contradicted(output, views)
    _check_pixels(output, views)
    _check_gains(output, views)
    check_notes(output.notes, "reconstructor")


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


def _check_depths(output: Reconstruction, views: Sequence[View]) -> None:
    if len(output.depths) != len(views):
        raise InputError(
            f"The reconstructor got {len(views)} views and returned {len(output.depths)} depth "
            "maps; return one for each."
        )
    for number, (depth, view) in enumerate(zip(output.depths, views, strict=True)):
        if depth.depth.shape != view.image.shape[:2]:
            raise InputError(
                f"Depth map {number} of the reconstruction has the shape "
                f"{list(depth.depth.shape)}, and its view {list(view.image.shape[:2])}; return one "
                "of the same size."
            )
        if depth.depth.dtype is not torch.float32:
            raise InputError(
                f"Depth map {number} of the reconstruction holds {name_dtype(depth.depth.dtype)}; "
                "convert it to float32."
            )
        possible = (depth.depth > 0) & depth.depth.isfinite()
        if not bool((possible | ~depth.valid).all()):
            raise InputError(
                f"Depth map {number} of the reconstruction is NaN, infinite or not positive where "
                "it is valid; mark such pixels as invalid."
            )


def _check_contradicted(output: Reconstruction, views: Sequence[View]) -> None:
    wrong = output.contradicted_depths
    is_listed = isinstance(wrong, (tuple, list))
    if not is_listed or not all(is_whole_number(n) and 0 <= n < len(views) for n in wrong):
        raise InputError(
            f"The contradicted_depths of the reconstruction have to be indices of its "
            f"{len(views)} views, counted from 0, and are {describe(wrong)}."
        )


def _check_pixels(output: Reconstruction, views: Sequence[View]) -> None:
    if output.view_index is None or output.pixel_index is None:
        return
    counts = {len(output.gaussians), len(output.view_index), len(output.pixel_index)}
    if len(counts) > 1:
        raise InputError(
            f"The reconstruction has {len(output.gaussians)} Gaussians, {len(output.view_index)} "
            f"view indices and {len(output.pixel_index)} pixel indices; return as many of each."
        )
    if len(output.gaussians) == 0:
        return
    sizes = [view.camera.width * view.camera.height for view in views]
    view_index = output.view_index.long()
    is_view = (view_index >= 0) & (view_index < len(views))
    # An impossible view index must not be looked up; it has view 0 here and is refused below.
    limits = torch.tensor(sizes, device=view_index.device)[view_index.where(is_view, 0)]
    is_pixel = (output.pixel_index >= 0) & (output.pixel_index < limits)
    if not bool((is_view & is_pixel).all()):
        raise InputError(
            f"The reconstruction names views or pixels that there are not: it got {len(views)} "
            f"views of {sizes[0]} pixels, counted from 0."
        )


def _check_gains(output: Reconstruction, views: Sequence[View]) -> None:
    gains = output.exposure_gains
    if gains is None:
        return
    is_positive = bool(((gains > 0) & gains.isfinite()).all())
    if len(gains) != len(views) or gains.dtype is not torch.float32 or not is_positive:
        raise InputError(
            f"The exposure gains of the reconstruction have to be {len(views)} rows of three "
            "positive float32 numbers; correct or leave them out."
        )


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
