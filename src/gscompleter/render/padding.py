"""Gaussians beside a padded image, drawn as in the image that it pads.

3DGS linearises the perspective at each Gaussian, at most 15 % beyond the border of the image: far
outside it would make huge splats. So an image with a wider border shows other splats in the pixels
that both have, and a hole of the one may be covered in the other.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.numerics.geometry import quats_to_rotations
from gscompleter.types import Camera, Gaussians

TANGENT_MARGIN = 0.15
"""Border at which the perspective Jacobian is clamped, relative to the image size."""

TangentRange = tuple[Float[Tensor, ""], Float[Tensor, ""]]
"""Smallest and largest tangent of a ray along one axis of the camera."""


def compute_tangent_limits(
    K: Float[Tensor, "3 3"], size: tuple[int, int], padding: tuple[int, int]
) -> list[TangentRange]:
    """Compute the ranges of x/z and y/z in the camera at which the Jacobian is evaluated.

    They end `TANGENT_MARGIN` beside the image without its padding; `size` is the width and height
    with it. Lengths are in pixels.
    """
    limits = []
    for axis, (side, pad) in enumerate(zip(size, padding, strict=True)):
        focal = K[axis, axis]
        inner_center = K[axis, 2] - pad
        inner_side = side - 2 * pad
        margin = TANGENT_MARGIN * inner_side
        lowest = -(inner_center + margin) / focal
        highest = (inner_side - inner_center + margin) / focal
        limits.append((lowest, highest))
    return limits


def compute_covariances(gaussians: Gaussians, camera: Camera) -> Float[Tensor, "n 6"]:
    """Compute covariances that a kernel draws in a padded image as in the one that it pads.

    They are for kernels that clamp tangents by the size of the image they draw. Where `drawn` is
    the tangent that such a kernel takes and `wanted` that of the smaller image, x of the Gaussian
    is sheared by (drawn - wanted) z in the camera: the z column of the Jacobian, -f drawn / z,
    becomes -f wanted / z. Returns upper triangles in world axes.
    """
    viewmat = camera.viewmat.to(gaussians.means)
    rotation = viewmat[:3, :3]
    points = gaussians.means @ rotation.T + viewmat[:3, 3]
    # Nothing nearer is drawn, and a division by 0 would give its gradient NaN.
    z = points[:, 2].clamp_min(camera.near_plane)
    K = camera.K.to(gaussians.means)
    size = (camera.width, camera.height)
    drawn = compute_tangent_limits(K, size, (0, 0))
    wanted = compute_tangent_limits(K, size, camera.padding)
    shears = []
    for axis in range(2):
        tangent = points[:, axis] / z
        shears.append(tangent.clamp(*drawn[axis]) - tangent.clamp(*wanted[axis]))

    # Columns are the axes of each Gaussian, in the camera.
    axes = rotation @ (quats_to_rotations(gaussians.quats) * gaussians.scales[:, None, :])
    sheared = axes[:, :2] + torch.stack(shears, dim=-1)[..., None] * axes[:, 2:]
    in_world = rotation.T @ torch.cat([sheared, axes[:, 2:]], dim=1)
    covariances = in_world @ in_world.transpose(1, 2)
    return torch.cat([covariances[:, 0], covariances[:, 1, 1:], covariances[:, 2, 2:]], dim=-1)
