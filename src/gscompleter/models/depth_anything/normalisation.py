"""Frame and unit of the camera poses that the networks receive."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.models.depth_anything.poses import Poses, invert_rigid
from gscompleter.system.errors import InputError

MIN_UNIT = 0.1
"""Smallest unit in the authors' code, in scene units."""


def normalize_poses(poses: Poses, units: Float[Tensor, "b"]) -> Poses:
    """Transform each scene to the axes of its first camera and to `units` (in scene units)."""
    c2w = poses.c2w.double()
    # The first camera becomes the origin and the axes, whatever world the poses were in.
    relative = invert_rigid(c2w[:, :1]) @ c2w
    relative[..., :3, 3] /= units.double()[:, None, None]
    return replace(poses, c2w=relative.to(poses.c2w.dtype))


def compute_scene_units(centers: Float[Tensor, "b v 3"]) -> Float[Tensor, "b"]:
    """Compute the lower median distance from the first camera; of two views, their distance.

    It scales with the scene, unlike the authors' own unit (`compute_authors_units`).

    Raises:
        InputError: All cameras of a scene are at one position, or one is not finite.
    """
    apart = measure_first_distances(centers)
    if not apart.isfinite().all():
        raise InputError("The position of a camera is not finite; correct its pose.")
    least = apart.where(apart > 0, torch.inf).amin(dim=1)
    if least.isinf().any():
        raise InputError(
            f"All {apart.shape[1]} cameras stand in one place, and depth needs a baseline between "
            "them; give photographs taken from different positions."
        )
    # Of two cameras the lower median is that of the first one, 0; then the other one counts.
    return torch.maximum(apart.median(dim=1).values, least)


def compute_authors_units(centers: Float[Tensor, "b v 3"]) -> Float[Tensor, "b"]:
    """Compute the same median, but at least 0.1 scene units, as in the authors' inference."""
    return measure_first_distances(centers).median(dim=1).values.clamp_min(MIN_UNIT)


def measure_first_distances(centers: Float[Tensor, "b v 3"]) -> Float[Tensor, "b v"]:
    """Measure the distance of each camera from the first camera of its scene."""
    return (centers.double() - centers[:, :1].double()).norm(dim=-1).to(centers.dtype)
