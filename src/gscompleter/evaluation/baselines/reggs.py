"""Registration by one similarity, after RegGS (Cheng et al., 2025).

Scale, rotation and translation of all lifted Gaussians are fitted to colour, depth and the entropic
Mixture-2-Wasserstein distance (Delon and Desolneux, 2020). RegGS also estimates the poses, which
are known here. Positions are in the frame and unit of the scene, unless a function says more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2
from torch import Tensor
from torch.autograd.function import once_differentiable

from gscompleter.numerics.geometry import multiply_quats, quats_to_rotations
from gscompleter.render.protocols import Renderer
from gscompleter.system.progress import track
from gscompleter.types import Camera, Gaussians, Render, View

EPSILON = 0.1
"""Entropic regularization, in squared scene units as the costs."""
MAX_ITERATIONS = 100
"""Largest number of updates of both potentials."""
POTENTIAL_TOLERANCE = 1e-5
"""Largest change of a converged potential, which is the logarithm of a factor."""
REGGS_RATES = (1e-3, 2e-4, 2e-3)
"""Step sizes of Adam for scale, quaternion and translation (in scene units), as in RegGS."""
DEPTH_WEIGHT = 0.1
"""Weight of the summed errors of depth, in scene units, relative to those of colours in [0, 1]."""
PATIENCE = 10
"""The mixture distance is dropped once it is no less than all of this many steps before."""
COVERAGE_POWER = 3
"""Power of the coverage by lifted Gaussians that weights errors of colours."""
MAX_BATCH = 2**14
"""Matrices whose eigenvalues are computed at a time."""
MIN_EIGENVALUE = 1e-6
"""Number that is added to the diagonal of matrices before their root, in their own unit: it keeps
the roots of flat Gaussians above 0."""


@dataclass(frozen=True)
class RegGSConfig:
    """Settings of the registration; the defaults are those of RegGS."""

    iterations: int = 400
    mixture_weight: float = 0.1
    """Weight of the mixture distance in the loss; 0 leaves it out."""
    components: int = 1000
    """Most clusters of each set of Gaussians, between which that distance is measured."""


@dataclass(frozen=True)
class Similarity:
    """Similarity that moves lifted Gaussians into the scene, with the camera centre c.

    x -> R^T (c + scale (x - c) - t). The other way the scene is only turned and moved, by R x + t;
    it is compared with lifted Gaussians that are scaled about the camera.
    """

    scale: Float[Tensor, ""]
    quaternion: Float[Tensor, "4"]
    """Rotation R (wxyz, of any length) from the scene to the lifted Gaussians."""
    translation: Float[Tensor, "3"]
    """Translation t, in scene units."""

    @property
    def rotation(self) -> Float[Tensor, "3 3"]:
        """Rotation matrix R."""
        return quats_to_rotations(self.quaternion)


def register_by_similarity(
    lifted: Gaussians,
    scene: Gaussians,
    reference: View,
    renderer: Renderer,
    seed: int = 42,
    config: RegGSConfig = RegGSConfig(),
) -> Gaussians:
    """Move `lifted` into the scene by the one similarity that fits best.

    Args:
        lifted: Gaussians of the reference, at a scale of their own; at least one.
        scene: The scene, at least one Gaussian.
        reference: The image that was lifted, with its camera, about which the scale is.
        renderer: Renders both, with gradients.
        seed: Seed of the clusters.
        config: Settings of the fit.

    Returns:
        The lifted Gaussians after the best of all steps. Their colours by direction are not turned.
    """
    camera = reference.camera
    own = renderer.render(lifted, camera)
    is_lifted = own.depth_map().valid
    # Pixels that the lifted Gaussians hardly cover say nothing about their place, so that colours
    # count less than in proportion there.
    coverage = own.alpha.detach()[..., None] ** COVERAGE_POWER

    # The pose is known, so that rotation and translation begin at none.
    ratio = measure_depth_ratio(own, renderer.render(scene, camera))
    scale = ratio.detach().clone().requires_grad_()
    quaternion = scale.detach().new_tensor([1.0, 0.0, 0.0, 0.0]).requires_grad_()
    translation = torch.zeros(3, device=scale.device, requires_grad=True)
    parameters = (scale, quaternion, translation)
    groups = [{"params": [p], "lr": rate} for p, rate in zip(parameters, REGGS_RATES, strict=True)]
    optimizer = torch.optim.Adam(groups, amsgrad=True)

    # The mixture distance takes time and memory of n × m 3×3 matrices, so it is one of clusters.
    small_lifted = cluster_gaussians(lifted, camera, config.components, seed)
    small_scene = cluster_gaussians(scene, camera, config.components, seed)
    best = None
    best_loss = np.inf
    distances: list[float] = []
    uses_mixtures = config.mixture_weight > 0
    for _ in track(range(config.iterations), "Registering"):
        # The scene is moved to the lifted Gaussians, whose camera stays in place.
        fit = Similarity(scale, quaternion, translation)
        moved = renderer.render(move_scene(scene, fit), camera)
        colour = ((moved.image - reference.image).abs() * coverage).sum()
        overlap = is_lifted & moved.depth_map().valid
        depth = (moved.depth - scale * own.depth.detach())[overlap].abs().sum()
        loss = colour + DEPTH_WEIGHT * depth

        if uses_mixtures:
            means = scale * small_lifted.means
            covariances = scale**2 * small_lifted.covariances
            scaled = Mixture(means, covariances, small_lifted.weights)
            distance = compute_mixture_wasserstein(scaled, move_mixture(small_scene, fit, camera))
            recent = distances[-PATIENCE:]
            if len(distances) >= PATIENCE and distance.item() >= max(recent):
                uses_mixtures = False
            else:
                loss = loss + config.mixture_weight * distance
            distances.append(distance.item())

        # The best of all steps, since the loss is not monotonous. Once the mixture distance is
        # dropped the loss lacks one summand, so that a step after that wins.
        if loss.item() < best_loss:
            best_loss = loss.item()
            best = Similarity(*(p.detach().clone() for p in parameters))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    similarity = best or Similarity(scale.detach(), quaternion.detach(), translation.detach())
    return move_into_scene(lifted, similarity, camera)


def measure_depth_ratio(lifted: Render, scene: Render) -> Float[Tensor, ""]:
    """Measure the ratio of the scene's median depth to that of the lifted where both are seen.

    1 if no pixel sees both.
    """
    both = lifted.depth_map().valid & scene.depth_map().valid
    if not both.any():
        return lifted.depth.new_ones(())
    return scene.depth[both].median() / lifted.depth[both].median()


def move_scene(scene: Gaussians, fit: Similarity) -> Gaussians:
    """Move the scene to the scaled lifted Gaussians, differentiable in `fit`."""
    unit = torch.nn.functional.normalize(fit.quaternion, dim=0)
    means = scene.means @ fit.rotation.T + fit.translation
    return replace(scene, means=means, quats=multiply_quats(unit, scene.quats), encoded=None)


def move_into_scene(lifted: Gaussians, fit: Similarity, camera: Camera) -> Gaussians:
    """Scale the lifted Gaussians about their camera and move them to the scene."""
    means = camera.center + fit.scale * (lifted.means - camera.center)
    unit = torch.nn.functional.normalize(fit.quaternion, dim=0)
    # The conjugate of a unit quaternion is its inverse.
    back = unit * unit.new_tensor([1.0, -1.0, -1.0, -1.0])
    return replace(
        lifted,
        means=(means - fit.translation) @ fit.rotation,
        quats=multiply_quats(back, lifted.quats),
        scales=lifted.scales * fit.scale,
        encoded=None,
    )


def cluster_gaussians(gaussians: Gaussians, camera: Camera, components: int, seed: int) -> Mixture:
    """Merge the Gaussians into at most `components` k-means clusters, in the axes of the camera.

    Weights are the softmax of the opacities: these lie in [0, 1], so that a faint Gaussian has at
    least a third of the weight of an opaque one.
    """
    rotation = camera.c2w[:3, :3]
    axes = rotation.T @ quats_to_rotations(gaussians.quats)
    # Covariance of each Gaussian: R S S R^T, with its axes as columns of R S.
    spread = axes * gaussians.scales[:, None, :]
    means = (gaussians.means - camera.center) @ rotation
    weights = gaussians.opacities.softmax(0)
    mixture = Mixture(means, spread @ spread.transpose(-1, -2), weights)
    if len(gaussians) <= components:
        return mixture
    points = mixture.means.double().cpu().numpy()
    _, labels = kmeans2(points, components, iter=10, minit="points", seed=seed)
    return reduce_mixture(mixture, torch.tensor(labels, device=camera.c2w.device).long())


def move_mixture(mixture: Mixture, fit: Similarity, camera: Camera) -> Mixture:
    """Move a mixture in the axes of the camera as `move_scene` moves the scene."""
    c2w = camera.c2w[:3, :3]
    # The similarity acts on world points; both mixtures are in camera axes, about the camera.
    rotation = c2w.T @ fit.rotation @ c2w
    offset = (fit.rotation @ camera.center + fit.translation - camera.center) @ c2w
    covariances = rotation @ mixture.covariances @ rotation.T
    return Mixture(mixture.means @ rotation.T + offset, covariances, mixture.weights)


@dataclass(frozen=True)
class Mixture:
    """A mixture of Gaussians; the weights sum to 1."""

    means: Float[Tensor, "n 3"]
    covariances: Float[Tensor, "n 3 3"]
    weights: Float[Tensor, "n"]


def reduce_mixture(mixture: Mixture, clusters: Int[Tensor, "n"]) -> Mixture:
    """Merge each cluster into one component with its mean and covariance; drop empty ones.

    `clusters` has the number of the cluster of each component, from 0.
    """
    count = int(clusters.max()) + 1
    weight = mixture.weights.new_zeros(count).index_add(0, clusters, mixture.weights)
    filled = weight > 0
    share = mixture.weights / weight[clusters]
    means = mixture.means.new_zeros(count, 3)
    means = means.index_add(0, clusters, share[:, None] * mixture.means)
    # Moments of a mixture: the mean of the covariances plus the covariance of the means.
    offset = mixture.means - means[clusters]
    spread = mixture.covariances + offset[:, :, None] * offset[:, None, :]
    covariances = mixture.means.new_zeros(count, 3, 3)
    covariances = covariances.index_add(0, clusters, share[:, None, None] * spread)
    weights = weight[filled] / weight[filled].sum()
    return Mixture(means[filled], covariances[filled], weights)


def compute_pairwise_costs(a: Mixture, b: Mixture) -> Float[Tensor, "n m"]:
    """Compute squared 2-Wasserstein distances between components, in squared scene units.

    |μ_i - μ_j|² + tr Σ_i + tr Σ_j - 2 tr (Σ_i^½ Σ_j Σ_i^½)^½
    """
    offsets = a.means[:, None] - b.means[None]
    root = compute_matrix_root(a.covariances)
    middle = root[:, None] @ b.covariances[None] @ root[:, None]
    traces = torch.diagonal(a.covariances, dim1=-2, dim2=-1).sum(-1)[:, None]
    traces = traces + torch.diagonal(b.covariances, dim1=-2, dim2=-1).sum(-1)[None]
    crossed = torch.diagonal(compute_matrix_root(middle), dim1=-2, dim2=-1).sum(-1)
    return offsets.square().sum(-1) + traces - 2 * crossed


def compute_matrix_root(matrices: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3 3"]:
    """Compute square roots of positive matrices, differentiable at equal eigenvalues."""
    # The gradient of `eigh` divides by differences of eigenvalues, which are 0 for round Gaussians;
    # `_MatrixRoot` divides by sums of their roots.
    identity = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    return _MatrixRoot.apply(matrices + MIN_EIGENVALUE * identity)


class _MatrixRoot(torch.autograd.Function):
    """R with R R = M by eigenvalues; the gradient solves dM = R dR + dR R."""

    @staticmethod
    def forward(ctx: Any, matrices: Tensor) -> Tensor:
        # In parts: on a GPU the solver takes some 260 KB of memory for each matrix of a batch.
        parts = [torch.linalg.eigh(part) for part in matrices.flatten(0, -3).split(MAX_BATCH)]
        values = torch.cat([part.eigenvalues for part in parts]).view(matrices.shape[:-1])
        vectors = torch.cat([part.eigenvectors for part in parts]).view(matrices.shape)
        roots = values.clamp_min(0).sqrt()
        ctx.save_for_backward(roots, vectors)
        return vectors @ (roots[..., None] * vectors.transpose(-1, -2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        roots, vectors = ctx.saved_tensors
        # In the basis of the eigenvectors, dM = R dR + dR R is dM_ij = (r_i + r_j) dR_ij.
        sums = (roots[..., :, None] + roots[..., None, :]).clamp_min(1e-6)
        inner = (vectors.transpose(-1, -2) @ gradient @ vectors) / sums
        return vectors @ inner @ vectors.transpose(-1, -2)


def compute_mixture_wasserstein(a: Mixture, b: Mixture) -> Float[Tensor, ""]:
    """Compute Σ plan * cost by Sinkhorn iterations.

    The plan is scaled so that its largest entry is 1, as in RegGS; its sum is then not 1.
    """
    cost = compute_pairwise_costs(a, b)
    log_a = (a.weights + 1e-10).log()
    log_b = (b.weights + 1e-10).log()
    # Sinkhorn's iterations in the logarithm: exp(-cost / ε) vanishes for distant components.
    log_kernel = -cost / EPSILON
    log_u = torch.zeros_like(log_a)
    log_v = torch.zeros_like(log_b)
    for _ in range(MAX_ITERATIONS):
        log_u = log_a - torch.logsumexp(log_kernel + log_v[None], dim=1)
        before = log_v
        log_v = log_b - torch.logsumexp(log_kernel + log_u[:, None], dim=0)
        if (log_v - before).abs().max() < POTENTIAL_TOLERANCE:
            break
    log_plan = log_u[:, None] + log_kernel + log_v[None]
    return ((log_plan - log_plan.max()).exp() * cost).sum()
