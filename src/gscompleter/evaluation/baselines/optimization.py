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

from gscompleter.numerics.geometry import compute_z_depths, quats_to_rotations
from gscompleter.numerics.image_ops import ssim_map
from gscompleter.render.protocols import Renderer
from gscompleter.system.progress import track
from gscompleter.types import Camera, Gaussians, View, merge

POSITION_RATE = 1.6e-4
"""Step size of positions, in camera extents."""

# Step sizes of the other parameters, in their own units.
ROTATION_RATE = 1e-3
SCALE_RATE = 5e-3
OPTIMIZED_OPACITY_RATE = 0.05
COLOR_RATE = 2.5e-3

DSSIM_WEIGHT = 0.2
"""Weight of 1 - SSIM in the loss; the rest is L1."""
DENSE_SHARE = 0.01
"""Largest size of a cloned Gaussian, in camera extents; larger ones are split."""
PRUNED_OPACITY = 0.005
"""Opacity below which Gaussians are pruned."""


@dataclass(frozen=True)
class OptimizationConfig:
    """Settings of the 3DGS optimization."""

    iterations: int = 800
    density_rounds: int = 10
    """Rounds of cloning, splitting and pruning; 0 for `distill`."""
    gradient_threshold: float = 2e-4
    """Mean image gradient, per half image width, from which Gaussians are added."""


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
    state = SceneParameters(scene, extent)
    # Sum of the image gradients of each Gaussian since the last round, and of its views.
    gradients = torch.zeros_like(scene.opacities)
    counts = torch.zeros_like(scene.opacities)
    # Rounds of density control, evenly over the first 80 % of the iterations.
    last = 0.8 * config.iterations
    total = config.density_rounds
    rounds = {math.ceil(last * (i + 1) / total) for i in range(total)}
    order: list[int] = []
    for number in track(range(1, config.iterations + 1), "Optimising"):
        # Each view once in random order, then all again.
        order = order or torch.randperm(len(views), generator=random).tolist()
        view = views[order.pop()]
        gaussians = state.make_gaussians()
        image = view.fill_ignored(renderer.render(gaussians, view.camera).image)
        loss = (1 - DSSIM_WEIGHT) * (image - view.image).abs().mean()
        loss = loss + DSSIM_WEIGHT * (1 - ssim_map(image, view.image).mean())
        state.optimizer.zero_grad()
        loss.backward()

        gradient, seen = compute_image_gradients(gaussians.means, state.leaves[0].grad, view.camera)
        gradients = gradients + gradient
        counts = counts + seen
        state.optimizer.step()
        if number in rounds:
            crowded = gradients / counts.clamp_min(1) >= config.gradient_threshold
            dense = control_density(state.make_gaussians(), crowded, extent, random)
            state = SceneParameters(dense, extent)
            gradients = torch.zeros_like(dense.opacities)
            counts = torch.zeros_like(dense.opacities)
    with torch.no_grad():  # so that the result is detached from the parameters
        return state.make_gaussians()[:]


class SceneParameters:
    """Optimized parameters of 3DGS: means, quats, log-scales, opacity logits and SH.

    Adam restarts with each round of density control.
    """

    def __init__(self, scene: Gaussians, extent: float) -> None:
        self.scene = scene
        log_scales = scene.scales.clamp_min(1e-12).log()
        values = (scene.means, scene.quats, log_scales, scene.opacities.logit(eps=1e-4), scene.sh)
        rates = (
            POSITION_RATE * extent,
            ROTATION_RATE,
            SCALE_RATE,
            OPTIMIZED_OPACITY_RATE,
            COLOR_RATE,
        )
        self.leaves = [value.detach().clone().requires_grad_() for value in values]
        both = zip(self.leaves, rates, strict=True)
        groups = [{"params": [leaf], "lr": rate} for leaf, rate in both]
        self.optimizer = torch.optim.Adam(groups, eps=1e-15)

    def make_gaussians(self) -> Gaussians:
        """Assemble the scene, differentiable in the parameters."""
        means, quats, log_scales, logits, sh = self.leaves
        leaves = means, quats, log_scales.exp(), logits.sigmoid(), sh, self.scene.generated
        return Gaussians(
            *leaves, is_antialiased=self.scene.is_antialiased, origin=self.scene.origin
        )


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
        # The rasteriser of 3DGS gives the gradient at the image position. Here it follows from that
        # of the mean: a move by one pixel is one by z / focal across the view, and half a width
        # counts as 1.
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
) -> Gaussians:
    """Clone small `crowded` Gaussians, split large ones and prune faint ones."""
    with torch.no_grad():
        # 3DGS clones where a small Gaussian has to cover more, and splits where a large one covers
        # what it should not: it is replaced by two samples of itself, smaller by its factor 1.6.
        large = scene.scales.amax(dim=-1) > DENSE_SHARE * extent
        clones = scene[crowded & ~large]
        parents = scene[crowded & large]
        kept = scene[~(crowded & large)]
        children = []
        for _ in range(2):
            normal = torch.randn(len(parents), 3, generator=random).to(parents.means.device)
            offset = parents.scales * normal
            moved = parents.means + (quats_to_rotations(parents.quats) @ offset[..., None])[..., 0]
            children.append(replace(parents, means=moved, scales=parents.scales / 1.6))
        dense = merge([kept, clones, *children])
        return dense[dense.opacities >= PRUNED_OPACITY]
