"""Checks of what Ψ returns: it fits its views, and holds numbers that a scene can have."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from gscompleter.numerics.value_checks import check_gaussians, check_notes
from gscompleter.system.errors import InputError
from gscompleter.system.tensor_checks import describe, is_whole_number, iterate_tensors, name_dtype
from gscompleter.types import Reconstruction, View


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
