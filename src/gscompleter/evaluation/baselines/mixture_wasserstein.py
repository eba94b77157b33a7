"""Entropic Mixture-2-Wasserstein distance (Delon and Desolneux, 2020), in the form of RegGS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

EPSILON = 0.1
"""Entropic regularization, in squared units of length."""
MAX_ITERATIONS = 100
"""Largest number of updates of both potentials."""
TOLERANCE = 1e-5
"""Largest change of a converged potential."""


@dataclass(frozen=True)
class Mixture:
    """A mixture of Gaussians; the weights sum to 1."""

    means: Float[Tensor, "n 3"]
    covariances: Float[Tensor, "n 3 3"]
    weights: Float[Tensor, "n"]


def reduce_mixture(mixture: Mixture, clusters: Int[Tensor, "n"]) -> Mixture:
    """Merge each cluster into one component with its mean and covariance."""
    count = int(clusters.max()) + 1
    weight = mixture.weights.new_zeros(count).index_add(0, clusters, mixture.weights)
    filled = weight > 0
    share = mixture.weights / weight[clusters]
    means = mixture.means.new_zeros(count, 3)
    means = means.index_add(0, clusters, share[:, None] * mixture.means)
    offset = mixture.means - means[clusters]
    spread = mixture.covariances + offset[:, :, None] * offset[:, None, :]
    covariances = mixture.means.new_zeros(count, 3, 3)
    covariances = covariances.index_add(0, clusters, share[:, None, None] * spread)
    weights = weight[filled] / weight[filled].sum()
    return Mixture(means[filled], covariances[filled], weights)


def compute_pairwise_costs(a: Mixture, b: Mixture) -> Float[Tensor, "n m"]:
    """Compute squared 2-Wasserstein distances between components.

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
    identity = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    return _MatrixRoot.apply(matrices + 1e-6 * identity)


class _MatrixRoot(torch.autograd.Function):
    """R with R R = M by eigenvalues; the gradient solves dM = R dR + dR R."""

    @staticmethod
    def forward(ctx: Any, matrices: Tensor) -> Tensor:
        values, vectors = torch.linalg.eigh(matrices)
        roots = values.clamp_min(0).sqrt()
        ctx.save_for_backward(roots, vectors)
        return vectors @ (roots[..., None] * vectors.transpose(-1, -2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        roots, vectors = ctx.saved_tensors
        sums = (roots[..., :, None] + roots[..., None, :]).clamp_min(1e-6)
        inner = (vectors.transpose(-1, -2) @ gradient @ vectors) / sums
        return vectors @ inner @ vectors.transpose(-1, -2)


def compute_mixture_wasserstein(a: Mixture, b: Mixture) -> Float[Tensor, ""]:
    """Compute Σ plan * cost by Sinkhorn iterations; the largest plan entry is 1 as in RegGS."""
    cost = compute_pairwise_costs(a, b)
    log_a, log_b = (a.weights + 1e-10).log(), (b.weights + 1e-10).log()
    log_kernel = -cost / EPSILON
    log_u, log_v = torch.zeros_like(log_a), torch.zeros_like(log_b)
    for _ in range(MAX_ITERATIONS):
        log_u = log_a - torch.logsumexp(log_kernel + log_v[None], dim=1)
        before = log_v
        log_v = log_b - torch.logsumexp(log_kernel + log_u[:, None], dim=0)
        if (log_v - before).abs().max() < TOLERANCE:
            break
    log_plan = log_u[:, None] + log_kernel + log_v[None]
    return ((log_plan - log_plan.max()).exp() * cost).sum()
