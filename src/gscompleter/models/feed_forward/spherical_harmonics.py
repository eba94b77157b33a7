"""Rotation of spherical harmonics (SH) in the basis of e3nn.

MVSplat and DepthSplat rotate SH from camera to world axes in the basis of e3nn, where degree 1 is
(x, y, z), but render them in the basis of 3DGS, where it is (-y, z, -x). This does not rotate
colours correctly, but the published weights were trained with it.
"""

from __future__ import annotations

from functools import cache
from math import factorial, isqrt, pi, prod, sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from gscompleter.models.feed_forward.cameras import disable_autocast

NUM_DIRECTIONS = 64
"""Number of sample directions for the least-squares fit; 2 * degree + 1 is the minimum."""


def rotate_sh(
    sh: Float[Tensor, "b v h w k 3"], rotations: Float[Tensor, "b v 3 3"]
) -> Float[Tensor, "b v h w k 3"]:
    """Rotate k = (degree + 1)² SH coefficients in the basis of e3nn."""
    rotated = [sh[..., :1, :]]
    with disable_autocast(sh):
        for degree in range(1, isqrt(sh.shape[-2])):
            part = sh[..., degree**2 : (degree + 1) ** 2, :]
            matrices = compute_wigner_matrices(degree, rotations)
            rotated.append(torch.einsum("bvij,bvhwjc->bvhwic", matrices, part))
    return torch.cat(rotated, dim=-2)


def compute_wigner_matrices(
    degree: int, rotations: Float[Tensor, "*n 3 3"]
) -> Float[Tensor, "*n m m"]:
    """Compute Wigner matrices D with `Y(R d) = D Y(d)` for all directions d, by least squares."""
    # Y(R d) as a combination of Y(d), fitted at the sample directions. In float64 on the CPU: the
    # GPU of a Mac has none.
    directions, inverse = sample_harmonics(degree)
    rotated = directions @ rotations.cpu().double().transpose(-1, -2)
    matrices = inverse @ evaluate_harmonics(degree, rotated)
    return matrices.transpose(-1, -2).to(rotations.dtype).to(rotations.device)


@cache
def sample_harmonics(degree: int) -> tuple[Float64[Tensor, "d 3"], Float64[Tensor, "m d"]]:
    """Sample directions on the sphere, with the pseudo-inverse of the SH at them."""
    # A golden spiral: evenly spread, so that the fit is well conditioned.
    number = torch.arange(NUM_DIRECTIONS, dtype=torch.float64)
    y = 1 - (2 * number + 1) / NUM_DIRECTIONS
    azimuth = number * pi * (3 - sqrt(5))
    radius = (1 - y * y).sqrt()
    directions = torch.stack([radius * azimuth.sin(), y, radius * azimuth.cos()], dim=-1)
    return directions, torch.linalg.pinv(evaluate_harmonics(degree, directions))


def evaluate_harmonics(degree: int, directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n m"]:
    """Evaluate real SH of orders -degree to degree at unit directions, with polar axis y."""
    x, y, z = directions.unbind(-1)
    values = {}
    # cos and sin of order * azimuth, counted from z to x, times (1 - y²)^(order / 2).
    cosine = torch.ones_like(x)
    sine = torch.zeros_like(x)
    for order in range(degree + 1):
        ratio = factorial(degree - order) / factorial(degree + order)
        norm = sqrt((2 * degree + 1) / (4 * pi) * ratio * (2 if order else 1))
        polar = norm * evaluate_legendre(degree, order, y)
        values[-order] = polar * sine
        values[order] = polar * cosine
        # Angle addition: from one order to the next.
        cosine, sine = z * cosine - x * sine, z * sine + x * cosine
    return torch.stack([values[order] for order in range(-degree, degree + 1)], dim=-1)


def evaluate_legendre(degree: int, order: int, t: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Evaluate `P(t) / (1 - t²)^(order / 2)` without the Condon-Shortley sign."""
    # From degree = order upwards, by the recurrence of three terms.
    before = torch.zeros_like(t)
    value = torch.full_like(t, prod(range(1, 2 * order, 2)))
    for n in range(order + 1, degree + 1):
        following = ((2 * n - 1) * t * value - (n + order - 1) * before) / (n - order)
        before = value
        value = following
    return value
