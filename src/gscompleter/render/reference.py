"""The image formation in plain PyTorch, slow and short, to test the fast renderers against."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gscompleter.numerics.geometry import quats_to_rotations
from gscompleter.render.padding import compute_tangent_limits
from gscompleter.render.redraw import RedrawnScene
from gscompleter.render.spherical_harmonics import evaluate_colors
from gscompleter.types import Camera, Gaussians, Render

MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4


@dataclass(frozen=True)
class ReferenceRenderer:
    """Renders on any device and in the dtype of the Gaussians."""

    max_elements: int = 1 << 22
    """Gaussians times pixels that are held in memory at once."""

    def render(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Render `gaussians` from `camera`."""
        splats = project_gaussians(gaussians, camera)
        camera = camera.to(gaussians.means.device)
        x = torch.arange(camera.width, device=camera.K.device) + 0.5
        y = torch.arange(camera.height, device=camera.K.device) + 0.5
        grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        pixels = grid.reshape(-1, 2).to(gaussians.means.dtype)
        per_chunk = max(1, self.max_elements // max(1, len(splats.depths)))
        # Checkpoints keep the backward pass within the same bound as the forward pass.
        chunks = [
            checkpoint(composite_splats, splats, chunk, use_reentrant=False)
            for chunk in pixels.split(per_chunk)
        ]
        size = (camera.height, camera.width)
        color, weighted_depth, alpha = [torch.cat(parts) for parts in zip(*chunks, strict=True)]
        # The inner `where` keeps a division by 0, whose gradient would be NaN, out of the graph.
        seen = alpha > 0
        depth = torch.where(seen, weighted_depth / torch.where(seen, alpha, 1), 0)
        return Render(color.view(*size, 3), depth.view(size), alpha.view(size))

    def freeze(self, context: Gaussians, camera: Camera) -> RedrawnScene:
        """Prepare `context` for many renders from `camera`."""
        return RedrawnScene(self, context, camera)


@dataclass(frozen=True)
class ProjectedSplats:
    """Gaussians projected to the image, front to back."""

    centers: Float[Tensor, "m 2"]
    """In pixels."""
    precisions: Float[Tensor, "m 2 2"]
    """Inverse covariances, in px⁻²."""
    depths: Float[Tensor, "m"]
    opacities: Float[Tensor, "m"]
    colors: Float[Tensor, "m 3"]


def project_gaussians(gaussians: Gaussians, camera: Camera) -> ProjectedSplats:
    """Project the Gaussians beyond the near plane by the affine EWA approximation, sorted by z."""
    dtype = gaussians.means.dtype
    device = gaussians.means.device
    c2w = camera.c2w.to(device, dtype)
    K = camera.K.to(device, dtype)
    camera_from_world = torch.linalg.inv(c2w[:3, :3])
    points = (gaussians.means - c2w[:3, 3]) @ camera_from_world.T

    # Gradients pass through the points, and not through their order.
    z = points[:, 2].detach()
    order = torch.argsort(z, stable=True)
    order = order[z[order] > max(camera.near_plane, 0.0)]
    gaussians = gaussians[order]
    points = points[order]

    # EWA splatting (Zwicker et al. 2001): the covariance in the image, in px², is
    # J W R S Sᵀ Rᵀ Wᵀ Jᵀ, and `flat` is its factor J W R S [n, 2, 3].
    axes = quats_to_rotations(gaussians.quats) * gaussians.scales[:, None, :]
    flat = compute_jacobians(points, camera) @ camera_from_world @ axes
    covariances = flat @ flat.transpose(1, 2) + camera.blur * torch.eye(
        2, dtype=dtype, device=device
    )
    opacities = gaussians.opacities
    if gaussians.is_antialiased:
        opacities = opacities * compute_compensations(flat, covariances)
    return ProjectedSplats(
        centers=points[:, :2] / points[:, 2:] * K.diagonal()[:2] + K[:2, 2],
        precisions=invert_2x2(covariances),
        depths=points[:, 2],
        opacities=opacities,
        colors=evaluate_colors(gaussians.sh, gaussians.means, c2w[:3, 3]),
    )


def compute_jacobians(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 2 3"]:
    """Compute the Jacobian of the projection at points in the camera, with clamped tangents."""
    K = camera.K.to(points)
    fx, fy = K[0, 0], K[1, 1]
    x, y, z = points.unbind(-1)
    # Far outside the image the linearization would make huge splats; its tangents end at a margin.
    size = (camera.width, camera.height)
    limits_x, limits_y = compute_tangent_limits(K, size, camera.padding)
    tan_x = (x / z).clamp(*limits_x)
    tan_y = (y / z).clamp(*limits_y)
    zero = torch.zeros_like(z)
    rows = [
        torch.stack([fx / z, zero, -fx * tan_x / z], dim=-1),
        torch.stack([zero, fy / z, -fy * tan_y / z], dim=-1),
    ]
    return torch.stack(rows, dim=1)


def invert_2x2(matrices: Float[Tensor, "n 2 2"]) -> Float[Tensor, "n 2 2"]:
    """Invert symmetric matrices."""
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    adjugates = torch.stack([c, -b, -b, a], dim=-1).view(-1, 2, 2)
    return adjugates / (a * c - b * b)[:, None, None]


def compute_compensations(
    flat: Float[Tensor, "n 2 3"], covariances: Float[Tensor, "n 2 2"]
) -> Float[Tensor, "n"]:
    """Compute the factors on opacities that compensate for the low-pass when antialiased.

    The low-pass widens `flat @ flat.T` to `covariances`.
    """
    # Lagrange's identity gives the determinant of `flat @ flat.T` without cancellation.
    area = torch.linalg.cross(flat[:, 0], flat[:, 1]).norm(dim=-1)
    return area / torch.linalg.det(covariances).sqrt()


def composite_splats(
    splats: ProjectedSplats, pixels: Float[Tensor, "p 2"]
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p"], Float[Tensor, "p"]]:
    """Sum weight times colour, weight times depth, and weight over the splats."""
    offsets = pixels - splats.centers[:, None]
    sigma = 0.5 * torch.einsum("mpi,mij,mpj->mp", offsets, splats.precisions, offsets)
    alpha = (splats.opacities[:, None] * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
    # As in the rasterizer of 3DGS, faint splats are not drawn.
    alpha = torch.where((alpha >= MIN_ALPHA) & (sigma >= 0), alpha, 0)

    # Transmittance falls monotonically, so that what comes after the stop is masked as well.
    alive = torch.cumprod(1 - alpha.detach(), dim=0) > MIN_TRANSMITTANCE
    alpha = torch.where(alive, alpha, 0)
    behind = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones_like(behind[:1]), behind[:-1]])
    weights = alpha * before
    return weights.T @ splats.colors, weights.T @ splats.depths, weights.sum(dim=0)
