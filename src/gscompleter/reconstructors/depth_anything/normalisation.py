"""The frame and unit in which the networks are told the cameras."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.reconstructors.depth_anything.poses import Poses, inverse_of

MIN_UNIT = 0.1
"""Least unit of the authors, in scene units."""


def seen_from_first(poses: Poses, units: Float[Tensor, "b"]) -> Poses:
    """The cameras of each scene in the axes of its first one, and in its unit (in scene units)."""
    c2w = poses.c2w.double()
    relative = inverse_of(c2w[:, :1]) @ c2w
    relative[..., :3, 3] /= units.double()[:, None, None]
    return replace(poses, c2w=relative.to(poses.c2w.dtype))


def scene_units(centers: Float[Tensor, "b v 3"]) -> Float[Tensor, "b"]:
    """The lower median of the distances between the first camera and all, itself included; of two
    views, where that is 0, their distance.

    It follows the unit of the scene, so that the network is told the same of a scene in metres and
    in millimetres. The authors' own (`authors_units`) differs for two views, which it puts 10
    units apart for each scene unit, and for scenes smaller than a tenth of a unit.

    Raises:
        InputError: where all cameras of a scene stand in one place, or one nowhere.
    """
    apart = distances_from_first(centers)
    if not apart.isfinite().all():
        raise InputError("The place of a camera is not finite; correct its pose.")
    least = apart.where(apart > 0, torch.inf).amin(dim=1)
    if least.isinf().any():
        raise InputError(
            f"All {apart.shape[1]} cameras stand in one place, and depth needs a baseline between "
            "them; give photographs taken from different positions."
        )
    return torch.maximum(apart.median(dim=1).values, least)


def authors_units(centers: Float[Tensor, "b v 3"]) -> Float[Tensor, "b"]:
    """The lower median of the distances between the first camera and all, itself included, and
    0.1 scene units at least, as in the authors' inference."""
    return distances_from_first(centers).median(dim=1).values.clamp_min(MIN_UNIT)


def distances_from_first(centers: Float[Tensor, "b v 3"]) -> Float[Tensor, "b v"]:
    """How far each camera of a scene stands from its first one."""
    return (centers.double() - centers[:, :1].double()).norm(dim=-1).to(centers.dtype)
