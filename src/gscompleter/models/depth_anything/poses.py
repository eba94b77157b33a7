"""Cameras as nine parameters, the form in which the networks of Depth Anything 3 use them.

They are the centre, a quaternion of the rotation from camera to world axes, and the vertical and
the horizontal field of view in radians. The principal point is none of them: it is taken to be the
middle of the image. Camera axes are x right, y down, z forward, and sizes are height, then width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.geometry import quats_to_rotations, rotations_to_quats

MIN_TANGENT = 1e-6
"""Smallest tangent of half a field of view, as predicted angles may be 0."""


@dataclass(frozen=True)
class Poses:
    """The cameras of b scenes with v views each."""

    c2w: Float[Tensor, "b v 4 4"]
    """Transforms from camera to world axes."""
    K: Float[Tensor, "b v 3 3"]
    """Intrinsics in pixels of the network's images."""

    @property
    def centers(self) -> Float[Tensor, "b v 3"]:
        """Camera centres in world axes."""
        return self.c2w[..., :3, 3]


def invert_rigid(transforms: Float[Tensor, "*n 4 4"]) -> Float[Tensor, "*n 4 4"]:
    """Invert rigid transforms."""
    # [R t; 0 1] inverts to [R^T -R^T t; 0 1].
    rotations = transforms[..., :3, :3].transpose(-1, -2)
    inverse = transforms.clone()
    inverse[..., :3, :3] = rotations
    inverse[..., :3, 3:] = -rotations @ transforms[..., :3, 3:]
    return inverse


def encode_poses(poses: Poses, size: tuple[int, int]) -> Float[Tensor, "b v 9"]:
    """Encode centre, xyzw quaternion with w >= 0, and vertical and horizontal field of view.

    `size` is that of the images to which the intrinsics belong.
    """
    quats = rotations_to_quats(poses.c2w[..., :3, :3])
    # Of both quaternions of a rotation, that with w >= 0; then wxyz to xyzw.
    quats = torch.where(quats[..., :1] < 0, -quats, quats).roll(-1, -1)
    focal = torch.stack([poses.K[..., 1, 1], poses.K[..., 0, 0]], dim=-1)
    angles = 2 * torch.atan(focal.new_tensor(size) / 2 / focal)
    return torch.cat([poses.centers, quats, angles], dim=-1)


def decode_poses(numbers: Float[Tensor, "b v 9"], size: tuple[int, int]) -> Poses:
    """Decode nine parameters into cameras with central principal points.

    The quaternions, xyzw, may have any length but zero.
    """
    centers, quats, angles = numbers.split([3, 4, 2], dim=-1)
    # xyzw to wxyz; the fourth row and column of the transform are 0 until they are set.
    c2w = F.pad(quats_to_rotations(quats.roll(1, -1)), (0, 1, 0, 1))
    c2w[..., :3, 3] = centers
    c2w[..., 3, 3] = 1
    half = numbers.new_tensor(size) / 2
    focal = half / (angles / 2).tan().clamp_min(MIN_TANGENT)
    # To x before y.
    K = torch.diag_embed(F.pad(focal.flip(-1), (0, 1), value=1.0))
    K[..., :2, 2] = half.flip(-1)
    return Poses(c2w, K)
