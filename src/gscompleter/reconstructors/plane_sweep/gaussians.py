"""One disc-shaped Gaussian per pixel, oriented like the surface."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.geometry import rotations_to_quats
from gscompleter.types import Gaussians, View, make_observed, sh_from_rgb

THICKNESS = 0.15
"""Standard deviation along the normal, relative to that across the viewing ray."""
MAX_STRETCH = 3.0
"""Largest elongation of a disc on a slanted surface, relative to a frontal one."""
OPACITY = 0.98
"""Initial opacity of every disc."""


def make_discs(
    view: View, depth: Float[Tensor, "h w"], normals: Float[Tensor, "h w 3"], sigma: float
) -> Gaussians:
    """Create one Gaussian per pixel of `view`, row by row, at z-depth `depth`.

    `normals` are in camera axes, towards the camera; `sigma` is the standard deviation across the
    viewing ray, in pixels.
    """
    camera = view.camera
    rays = camera.z_rays()
    means = (camera.center + depth[..., None] * rays).reshape(-1, 3)
    pixel = depth.reshape(-1) * 2 / (camera.K[0, 0] + camera.K[1, 1])

    normal = normals.reshape(-1, 3) @ camera.c2w[:3, :3].T
    towards = -torch.nn.functional.normalize(rays, dim=-1).reshape(-1, 3)
    cosine = (normal * towards).sum(-1, keepdim=True).clamp_min(1 / MAX_STRETCH)
    # On a slanted surface the disc is elongated, so that its projection stays round.
    across = torch.linalg.cross(normal, towards)
    flat = across.norm(dim=-1, keepdim=True) < 1e-3
    across = torch.where(flat, camera.c2w[:3, 0].expand_as(across), across)
    across = across - (across * normal).sum(-1, keepdim=True) * normal
    across = torch.nn.functional.normalize(across, dim=-1)
    along = torch.linalg.cross(normal, across)
    axes = torch.stack([across, along, normal], dim=-1)
    sizes = torch.cat(
        [torch.ones_like(cosine), 1 / cosine, torch.full_like(cosine, THICKNESS)], dim=-1
    )
    return make_observed(
        means=means,
        quats=rotations_to_quats(axes),
        scales=sizes * (sigma * pixel)[:, None],
        opacities=torch.full_like(pixel, OPACITY),
        sh=sh_from_rgb(view.image.reshape(-1, 3)),
    )


def compute_normals(depth: Float[Tensor, "h w"], view: View) -> Float[Tensor, "h w 3"]:
    """Compute normals in camera axes, towards the camera, by one-sided differences."""
    camera = view.camera
    rays = camera.z_rays() @ camera.c2w[:3, :3]
    # Scale by a power of two, which is exact, so that squares neither overflow nor vanish.
    unit = 2.0 ** depth.median().log2().round().item()
    points = rays * (depth / unit)[..., None]

    def difference(p: Float[Tensor, "a b 3"]) -> Float[Tensor, "a b 3"]:
        step = p[:, 1:] - p[:, :-1]
        after = torch.cat([step, step[:, -1:]], 1)
        before = torch.cat([step[:, :1], step], 1)
        nearer = before[..., 2:].abs() < after[..., 2:].abs()
        return torch.where(nearer, before, after)

    dx = difference(points)
    dy = difference(points.transpose(0, 1)).transpose(0, 1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(dy, dx), dim=-1)
    facing = (normal * rays).sum(-1, keepdim=True) < 0
    return torch.where(facing, normal, -normal)
