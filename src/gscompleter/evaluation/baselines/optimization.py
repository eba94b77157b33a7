"""Completion by 3DGS optimization (Kerbl et al., 2023) with the synthesized view added.

All attributes are fitted (`distill`), optionally with adaptive density control (`densify`).
Learning rates are those of 3DGS; its 30,000 iterations are cut to a few hundred. So what 3DGS does
over thousands of them is left out: its decay of the rate of positions, new bands of harmonics (all
are fitted from the first iteration on, at one rate), the reset of opacities, and the pruning of
large Gaussians.
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
    """Fit all attributes of `scene` to `views`; `seed` sets their order and the splitting.

    The result has no gradient.
    """
    random = torch.Generator().manual_seed(seed)
    extent = compute_extent([view.camera for view in views])
    parameters = SceneParameters(scene, extent)
    # Of each Gaussian since the last round of density control: the sum of its image gradients, and
    # the number of renders that it was seen in.
    gradients = torch.zeros_like(scene.opacities)
    counts = torch.zeros_like(scene.opacities)
    # Iterations after which such a round follows, evenly over the first 80 % of them.
    last_round = 0.8 * config.iterations
    num_rounds = config.density_rounds
    rounds = {math.ceil(last_round * (i + 1) / num_rounds) for i in range(num_rounds)}
    order: list[int] = []
    for number in track(range(1, config.iterations + 1), "Optimising"):
        # Each view once in random order, then all again.
        order = order or torch.randperm(len(views), generator=random).tolist()
        view = views[order.pop()]
        gaussians = parameters.make_gaussians()
        image = view.fill_ignored(renderer.render(gaussians, view.camera).image)
        loss = (1 - DSSIM_WEIGHT) * (image - view.image).abs().mean()
        loss = loss + DSSIM_WEIGHT * (1 - ssim_map(image, view.image).mean())
        parameters.optimizer.zero_grad()
        loss.backward()

        gradient, seen = compute_image_gradients(
            gaussians.means, parameters.means.grad, view.camera
        )
        gradients = gradients + gradient
        counts = counts + seen
        parameters.optimizer.step()
        if number in rounds:
            crowded = gradients / counts.clamp_min(1) >= config.gradient_threshold
            dense = control_density(parameters.make_gaussians(), crowded, extent, random)
            parameters = SceneParameters(dense, extent)
            gradients = torch.zeros_like(dense.opacities)
            counts = torch.zeros_like(dense.opacities)
    return parameters.make_gaussians().detach()


class SceneParameters:
    """Optimized parameters of 3DGS: means, quats, log-scales, opacity logits and SH.

    Adam restarts with each round of density control.
    """

    def __init__(self, scene: Gaussians, extent: float) -> None:
        self.scene = scene
        self.means = make_parameter(scene.means)
        self.quats = make_parameter(scene.quats)
        self.log_scales = make_parameter(scene.scales.clamp_min(1e-12).log())
        self.logits = make_parameter(scene.opacities.logit(eps=1e-4))
        self.sh = make_parameter(scene.sh)
        self.optimizer = torch.optim.Adam(
            [
                {"params": [self.means], "lr": POSITION_RATE * extent},
                {"params": [self.quats], "lr": ROTATION_RATE},
                {"params": [self.log_scales], "lr": SCALE_RATE},
                {"params": [self.logits], "lr": OPTIMIZED_OPACITY_RATE},
                {"params": [self.sh], "lr": COLOR_RATE},
            ],
            eps=1e-15,
        )

    def make_gaussians(self) -> Gaussians:
        """Assemble the scene, differentiable in the parameters."""
        return replace(
            self.scene,
            means=self.means,
            quats=self.quats,
            scales=self.log_scales.exp(),
            opacities=self.logits.sigmoid(),
            sh=self.sh,
            encoded=None,
        )


def make_parameter(values: Float[Tensor, "n *c"]) -> Float[Tensor, "n *c"]:
    """Make a variable that begins with given values."""
    return values.detach().clone().requires_grad_()


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
