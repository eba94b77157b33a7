"""Checks of the numbers in tensors: finite, in range, and large enough to work on.

They read every number, so they run once, where a value enters: in the readers and writers of
splats, in `GSCompleter.begin` and `advance`, and on what Ψ and Φ return. Constructors, which run in
every step of an optimisation too, check types and shapes only (`tensor_checks`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.kernels.parallel import share
from gscompleter.numerics.kernels.splat_rows import mark_usable
from gscompleter.system.errors import InputError
from gscompleter.system.files.mapping import release_pages
from gscompleter.system.memory import check_image_memory
from gscompleter.system.tensor_checks import describe, name_dtype
from gscompleter.types import Camera, DepthMap, Gaussians, View

CHECKED_BLOCK = 500_000
"""Gaussians that are checked at a time."""
LARGEST = 1e18
"""Largest coordinate, scale and component of a quaternion: the sum of their squares is finite."""
LARGEST_SH = 1e6
"""Largest spherical harmonic; colours are in [0, 1], and 1e38 would add up to infinity."""
MIN_QUAT_LENGTH = 1e-12
"""Smallest length of a quaternion: `torch.nn.functional.normalize` divides by no less."""
MIN_PHOTOGRAPH_SIDE = 8
"""Smallest width and height of a photograph or target, in pixels; stereo needs as many."""
COLOR_TOLERANCE = 0.01
"""Largest tolerated excess of a colour beyond [0, 1], as resampling causes it."""


def find_finite(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Mark Gaussians of finite numbers below `LARGEST` whose quaternion is a rotation."""
    names = ("means", "quats", "scales", "opacities", "sh")
    values = [getattr(gaussians, name).detach() for name in names]
    if all(value.dtype == torch.float32 and value.device.type == "cpu" for value in values):
        # In one pass, without a copy of the harmonics that says which of them are too large.
        values[-1] = values[-1].flatten(1)
        arrays = [value.contiguous().numpy() for value in values]
        usable = np.empty(len(gaussians), np.bool_)
        bounds = [np.float32(bound) for bound in (LARGEST, LARGEST_SH, MIN_QUAT_LENGTH)]
        # Harmonics may lie in a file, of which no more than a block is kept in memory.
        for start in range(0, len(gaussians), CHECKED_BLOCK):
            parts = [array[start : start + CHECKED_BLOCK] for array in (*arrays, usable)]
            share(mark_usable, len(parts[0]), *parts[:-1], *bounds, parts[-1])
            release_pages(parts[-2])
        return torch.from_numpy(usable)
    good = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for name in names:
        good &= ~_find_infinite(getattr(gaussians, name), LARGEST_SH if name == "sh" else LARGEST)
    return good & (gaussians.quats.square().sum(1) >= MIN_QUAT_LENGTH**2)


def _find_infinite(values: Float[Tensor, "n *k"], largest: float) -> Bool[Tensor, "n"]:
    """Mark rows with NaN, infinity or a number beyond `largest`."""
    inside = values.abs() <= largest  # False for NaN
    return ~inside.flatten(1).all(1) if values.dim() > 1 else ~inside


def find_out_of_range(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Mark Gaussians with a negative scale or an opacity outside of [0, 1]."""
    opacities = gaussians.opacities
    return (gaussians.scales < 0).any(1) | (opacities < 0) | (opacities > 1)


def check_gaussians(gaussians: object, name: str) -> None:
    """Raise InputError unless these are Gaussians of float32 with numbers that a scene can have.

    `name` begins the sentence, such as "The scene". On a GPU this waits once.
    """
    if not isinstance(gaussians, Gaussians):
        raise InputError(
            f"{name} has to be Gaussians, such as gsc.load_splat returns, and is "
            f"{describe(gaussians)}."
        )
    _check_float32(gaussians.means, name)
    bad = ~find_finite(gaussians) | find_out_of_range(gaussians)
    count = int(bad.sum())
    if count > 0:
        raise InputError(
            f"{name} has {count:,} of {len(bad):,} Gaussians with {_describe_defect(gaussians)}; "
            "repair or remove them."
        )


def check_row_mask(mask: object, scene: Gaussians | None, name: str) -> None:
    """Raise InputError unless this is None, or has a truth value for each Gaussian of a scene."""
    if mask is None:
        return
    if scene is None:
        raise InputError(f"{name} marks Gaussians of a scene; give one, or leave the mask out.")
    shape = scene.opacities.shape
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape != shape:
        raise InputError(
            f"{name} needs a truth value for each of {len(scene):,} Gaussians, as a bool tensor, "
            f"and is {describe(mask)}."
        )


def _describe_defect(gaussians: Gaussians) -> str:
    """Describe the first property that holds numbers which no scene can have."""
    if _find_infinite(gaussians.means, LARGEST).any():
        return f"positions that are NaN or beyond {LARGEST:g}"
    if _find_infinite(gaussians.quats, LARGEST).any():
        return f"rotations that are NaN or beyond {LARGEST:g}"
    if _find_infinite(gaussians.scales, LARGEST).any() or (gaussians.scales < 0).any():
        return f"scales that are negative, NaN or beyond {LARGEST:g}"
    if _find_infinite(gaussians.sh, LARGEST_SH).any():
        return f"spherical harmonics that are NaN or beyond {LARGEST_SH:g}"
    if not ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all():
        return "opacities outside of [0, 1]"
    return "rotations of zeros"


def check_inputs(
    views: Sequence[View],
    scene: Gaussians | None,
    check_photos: Sequence[View],
    targets: Sequence[Camera],
) -> None:
    """Raise InputError for values that cannot be completed; arguments as in `GSCompleter`."""
    check_views(views, "context")
    check_views(check_photos, "check")
    if scene is not None:
        check_gaussians(scene, "The scene")
    for number, target in enumerate(targets):
        check_camera(target, f"Target {number}")
    # Before anything of this size is allocated.
    cameras = [*(view.camera for view in (*views, *check_photos)), *targets]
    check_image_memory(sum(camera.width * camera.height for camera in cameras), len(cameras))
    tensors = {f"context view {number}": view.image for number, view in enumerate(views)}
    tensors |= {f"check view {number}": view.image for number, view in enumerate(check_photos)}
    tensors |= {f"target {number}": target.K for number, target in enumerate(targets)}
    if scene is not None:
        tensors["scene"] = scene.means
    first = next(iter(tensors), "")
    for name, tensor in tensors.items():
        if tensor.device != tensors[first].device:
            raise InputError(
                f"The {first} is on {tensors[first].device} and the {name} on {tensor.device}; "
                "move all to one device."
            )


def check_view_list(views: object, name: str) -> None:
    """Raise InputError unless these are a list of `View`, whose numbers are not read."""
    if not isinstance(views, (list, tuple)):
        raise InputError(
            f"The {name} views have to be a list, such as gsc.load_views returns, and are "
            f"{describe(views)}."
        )
    for number, view in enumerate(views):
        if not isinstance(view, View):
            raise InputError(
                f"The {name} views have to be a list of View, and number {number} is "
                f"{describe(view)}."
            )


def check_given_views(views: object) -> None:
    """Raise InputError unless Ψ is given a list of at least one `View`."""
    check_view_list(views, "context")
    if not views:
        raise InputError("No view was given that could be reconstructed; give at least one.")


def check_views(views: object, name: str) -> None:
    """Raise InputError unless these are photographs to work on.

    They are a list of `View`, at least `MIN_PHOTOGRAPH_SIDE` pixels wide and high, with colours
    in [0, 1] and depths of at least 0. Some of them may be ignored everywhere, but not all. `name`
    is for the sentences, such as "context".
    """
    check_view_list(views, name)
    assert isinstance(views, (list, tuple))
    for number, view in enumerate(views):
        check_camera(view.camera, f"The camera of {name} view {number}")
        _check_float32(view.image, f"The image of {name} view {number}")
        check_colors(view.image, f"The image of {name} view {number}")
        for part in ("depth", "given_depth"):
            depth = getattr(view, part)
            if depth is not None and not bool(((depth >= 0) & depth.isfinite()).all()):
                raise InputError(
                    f"The {part.replace('_', ' ')} of {name} view {number} holds NaN, infinity or "
                    "negative numbers; write 0 where it is unknown."
                )
    if len(views) > 0 and not any(bool(view.valid_mask.any()) for view in views):
        raise InputError(
            f"The masks leave no pixel of the {name} views; give other masks or photographs."
        )


def check_depths(depths: object, views: Sequence[View]) -> None:
    """Raise InputError unless these are one depth map of its size for each view."""
    if not isinstance(depths, (list, tuple)) or len(depths) != len(views):
        found = f"{len(depths)}" if isinstance(depths, (list, tuple)) else describe(depths)
        raise InputError(
            f"The depth model has to return a list of {len(views)} depth maps, one for each view, "
            f"and returned {found}."
        )
    for depth, view in zip(depths, views, strict=True):
        check_depth(depth, view)


def check_notes(notes: object, model: str) -> None:
    """Raise InputError unless the notes of a model, such as the "generator", are sentences."""
    if not isinstance(notes, (tuple, list)) or not all(isinstance(note, str) for note in notes):
        raise InputError(
            f"The notes of the {model} have to be a tuple of sentences, and are {describe(notes)}."
        )


def check_depth(depth: object, view: View) -> None:
    """Raise InputError unless this is a depth map of the size of a view, above 0 where it is valid.

    Infinity is far away, as the sky is. On a GPU this waits once.
    """
    if not isinstance(depth, DepthMap):
        raise InputError(
            "The depth model has to return a gscompleter.types.DepthMap of depths and validity for "
            f"each view, and returned {describe(depth)}."
        )
    shape = tuple(view.image.shape[:2])
    if depth.depth.shape != shape:
        raise InputError(
            f"The depth model returned a depth map of shape {list(depth.depth.shape)} for a view "
            f"of shape {list(shape)}; resize it to the view."
        )
    known = depth.depth[depth.valid]
    if not bool((known > 0).all()):  # nor NaN
        raise InputError(
            "The depth model returned depths that are NaN or not above 0; mark these pixels as not "
            "valid."
        )


def check_camera(camera: object, name: str) -> None:
    """Raise InputError unless this is a camera of float32 whose image is large enough."""
    if not isinstance(camera, Camera):
        raise InputError(
            f"{name} has to be a Camera, such as gsc.load_camera returns, and is "
            f"{describe(camera)}."
        )
    _check_float32(camera.K, name)
    if min(camera.width, camera.height) < MIN_PHOTOGRAPH_SIDE:
        raise InputError(
            f"{name} has an image of {camera.width} × {camera.height} pixels, and at least "
            f"{MIN_PHOTOGRAPH_SIDE} × {MIN_PHOTOGRAPH_SIDE} are needed; choose a larger resolution."
        )
    camera.to("cpu")  # whose constructor reads the numbers, which it does not on a GPU


def check_colors(image: Float[Tensor, "h w 3"], name: str) -> None:
    """Raise InputError for colours outside of [0, 1], or NaN."""
    low, high = torch.stack(image.aminmax()).tolist()
    if not (low >= -COLOR_TOLERANCE and high <= 1 + COLOR_TOLERANCE):  # nor NaN
        raise InputError(
            f"{name} has values from {low:g} to {high:g}; colours in [0, 1] are needed."
        )


def _check_float32(tensor: Tensor, name: str) -> None:
    if tensor.dtype is not torch.float32:
        raise InputError(
            f"{name} holds {name_dtype(tensor.dtype)}, and float32 is needed; convert it by "
            ".float()."
        )
