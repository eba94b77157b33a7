"""Completion by 3DGS optimization (Kerbl et al., 2023) with the synthesized view added.

All attributes are fitted (`distill`), optionally with adaptive density control (`densify`).
Learning rates are those of 3DGS; its 30,000 iterations are cut to a few hundred.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.geometry import compute_z_depths, quats_to_rotations
from gscompleter.progress import track
from gscompleter.render import Renderer
from gscompleter.ssim import ssim_map
from gscompleter.types import Camera, Gaussians, View, merge


@dataclass(frozen=True)
class OptimizationConfig:
    """Settings of the 3DGS optimization."""

    iterations: int = 800
    density_rounds: int = 10
    """Rounds of cloning, splitting and pruning; 0 for `distill`."""
    position_rate: float = 1.6e-4
    """Step size of positions, in camera extents."""
    color_rate: float = 2.5e-3
    opacity_rate: float = 0.05
    scale_rate: float = 5e-3
    rotation_rate: float = 1e-3
    dssim_weight: float = 0.2
    """Weight of 1 - SSIM in the loss; the rest is L1."""
    gradient_threshold: float = 2e-4
    """Mean image gradient, per half image width, from which Gaussians are added."""
    dense_share: float = 0.01
    """Largest size of a cloned Gaussian, in camera extents; larger ones are split."""
    min_opacity: float = 0.005
    """Opacity below which Gaussians are pruned."""


def optimize(
    scene: Gaussians,
    views: Sequence[View],
    renderer: Renderer,
    seed: int = 0,
    config: OptimizationConfig = OptimizationConfig(),
) -> Gaussians:
    """Fit all attributes of `scene` to `views`; `seed` sets their order and the splitting."""
    random = torch.Generator().manual_seed(seed)
    extent = compute_extent([view.camera for view in views])
    state = Parameters.from_scene(scene, config, extent)
    gradients = counts = torch.zeros_like(scene.opacities)
    rounds = list_density_rounds(config)
    order: list[int] = []
    for number in track(range(1, config.iterations + 1), "Optimising"):
        order = order or torch.randperm(len(views), generator=random).tolist()
        view = views[order.pop()]
        gaussians = state.make_gaussians()
        image = view.fill_ignored(renderer.render(gaussians, view.camera).image)
        loss = (1 - config.dssim_weight) * (image - view.image).abs().mean()
        loss = loss + config.dssim_weight * (1 - ssim_map(image, view.image).mean())
        state.optimizer.zero_grad()
        loss.backward()
        gradient, seen = compute_image_gradients(gaussians.means, state.means.grad, view.camera)
        gradients, counts = gradients + gradient, counts + seen
        state.optimizer.step()
        if number in rounds:
            crowded = gradients / counts.clamp_min(1) >= config.gradient_threshold
            dense = control_density(state.make_gaussians(), crowded, extent, random, config)
            state = Parameters.from_scene(dense, config, extent)
            gradients = counts = torch.zeros_like(dense.opacities)
    with torch.no_grad():  # so that the result is detached from the parameters
        return state.make_gaussians()[:]


def list_density_rounds(config: OptimizationConfig) -> set[int]:
    """List the iterations with density control, evenly over the first 80 %."""
    last = 0.8 * config.iterations
    return {math.ceil(last * (i + 1) / config.density_rounds) for i in range(config.density_rounds)}


@dataclass(frozen=True)
class Parameters:
    """Optimized parameters of 3DGS: log-scales and opacity logits."""

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logits: Tensor
    sh: Tensor
    generated: Tensor
    is_antialiased: bool
    optimizer: torch.optim.Adam

    @staticmethod
    def from_scene(scene: Gaussians, config: OptimizationConfig, extent: float) -> Parameters:
        """Create the parameters; Adam restarts after each round of density control."""
        rates = (
            (scene.means, config.position_rate * extent),
            (scene.quats, config.rotation_rate),
            (scene.scales.clamp_min(1e-12).log(), config.scale_rate),
            (scene.opacities.logit(eps=1e-4), config.opacity_rate),
            (scene.sh, config.color_rate),
        )
        leaves = [value.detach().clone().requires_grad_() for value, _ in rates]
        groups = [
            {"params": [leaf], "lr": rate} for leaf, (_, rate) in zip(leaves, rates, strict=True)
        ]
        optimizer = torch.optim.Adam(groups, eps=1e-15)
        means, quats, log_scales, logits, sh = leaves
        kept = scene.generated, scene.is_antialiased
        return Parameters(means, quats, log_scales, logits, sh, *kept, optimizer)

    def make_gaussians(self) -> Gaussians:
        """Assemble the scene, differentiable in the parameters."""
        scales, opacities = self.log_scales.exp(), self.logits.sigmoid()
        leaves = self.means, self.quats, scales, opacities, self.sh, self.generated
        return Gaussians(*leaves, is_antialiased=self.is_antialiased)


def compute_extent(cameras: Sequence[Camera]) -> float:
    """Compute 1.1 times the largest camera distance from the mean centre, in scene units."""
    centers = torch.stack([camera.center for camera in cameras])
    return 1.1 * (centers - centers.mean(dim=0)).norm(dim=-1).max().item()


def compute_image_gradients(
    means: Float[Tensor, "n 3"], gradient: Float[Tensor, "n 3"] | None, camera: Camera
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Compute the norm of each image position gradient, and 1 for rendered Gaussians."""
    if gradient is None:
        return torch.zeros_like(means[:, 0]), torch.zeros_like(means[:, 0])
    with torch.no_grad():
        z = compute_z_depths(means, camera)
        across = gradient @ camera.c2w[:3, :2]
        focal = torch.stack([camera.K[0, 0], camera.K[1, 1]])
        halves = focal.new_tensor([camera.width / 2, camera.height / 2])
        lengths = (across * z[:, None] / focal * halves).norm(dim=-1)
        seen = (gradient != 0).any(dim=-1)
        return torch.where(seen, lengths, 0.0), seen.float()


def control_density(
    scene: Gaussians,
    crowded: Bool[Tensor, "n"],
    extent: float,
    random: torch.Generator,
    config: OptimizationConfig,
) -> Gaussians:
    """Clone small `crowded` Gaussians, split large ones and prune faint ones."""
    with torch.no_grad():
        large = scene.scales.amax(dim=-1) > config.dense_share * extent
        clones, parents = scene[crowded & ~large], scene[crowded & large]
        kept = scene[~(crowded & large)]
        children = []
        for _ in range(2):
            normal = torch.randn(len(parents), 3, generator=random).to(parents.means.device)
            offset = parents.scales * normal
            moved = parents.means + (quats_to_rotations(parents.quats) @ offset[..., None])[..., 0]
            children.append(replace(parents, means=moved, scales=parents.scales / 1.6))
        dense = merge([kept, clones, *children])
        return dense[dense.opacities >= config.min_opacity]
