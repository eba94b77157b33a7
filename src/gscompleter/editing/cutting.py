"""Gaussians cut at the border of a region, so that what lies outside of it stays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.numerics.geometry import quats_to_rotations
from gscompleter.types import Gaussians, merge

Region = Callable[[Float[Tensor, "n 3"]], Bool[Tensor, "n"]]
"""Finds the points that lie in a region."""

GAUSSIAN_REACH = 3.0
"""Standard deviations up to which a Gaussian reaches."""
PIECE_DEVIATION = 1 / 3
"""Standard deviation of a piece, relative to that of its Gaussian."""
PIECE_DISTANCE = 2 / 3
"""Distance of neighbouring pieces, in standard deviations of their Gaussian."""
PIECES_PER_SIDE = 4
"""Pieces on either side of the middle one, along an axis."""
CUT_BLOCK = 4096
"""Gaussians that are divided at a time, which bounds the memory."""
MIN_LENGTH = 0.25
"""Length, relative to the longest axis, from which on the second axis is divided as well."""
MAX_DIVIDED_OPACITY = 0.99
"""Largest opacity that is divided: every power of a transmittance of 0 is 0, so that each piece of
an opaque Gaussian would be opaque."""
MIN_PIECE_OPACITY = 1 / 255
"""Smallest opacity that is rendered."""


def cut(gaussians: Gaussians, contains: Region) -> tuple[Gaussians, Gaussians]:
    """Cut Gaussians that were chosen, at the border of the region that their centres lie in.

    Returns what is chosen, and the rest of what was cut: pieces in the region, and those outside.
    Gaussians whose centre lies outside were chosen by something else than the region, and belong
    to the first as a whole.
    """
    # A Gaussian lies in the region as a whole if the six ends of its axes do.
    ends = GAUSSIAN_REACH * torch.cat([torch.eye(3), -torch.eye(3)]).to(gaussians.means)
    is_inside = torch.stack([contains(move(gaussians, end)) for end in ends]).all(dim=0)
    is_whole = is_inside | ~contains(gaussians.means)

    # Of a Gaussian there are up to 81 pieces, most of them too faint to be drawn.
    divided = gaussians[~is_whole]
    inner = [gaussians[is_whole]]
    outer = []
    # There is a block even without any, so that there is something to merge.
    for start in range(0, max(len(divided), 1), CUT_BLOCK):
        pieces = split(divided[start : start + CUT_BLOCK])
        is_piece_inside = contains(pieces.means)
        inner.append(pieces[is_piece_inside])
        outer.append(pieces[~is_piece_inside])
    return merge(inner), merge(outer)


def move(
    gaussians: Gaussians, steps: Float[Tensor, "3"] | Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Return centres moved by standard deviations along the axes."""
    rotations = quats_to_rotations(gaussians.quats)
    return gaussians.means + (rotations @ (steps * gaussians.scales)[..., None])[..., 0]


def split(gaussians: Gaussians) -> Gaussians:
    """Split Gaussians along their two longest axes into pieces that together look the same.

    Pieces at the steps of a grid, with the weights of a Gaussian of variance 1 - PIECE², add up to
    one of variance 1. What adds up when they are composited are logarithms of transmittance.
    """
    # A cell is a step along the longest and one along the second axis, in standard deviations.
    steps = PIECE_DISTANCE * torch.arange(-PIECES_PER_SIDE, PIECES_PER_SIDE + 1)
    grid = torch.cartesian_prod(steps, steps).to(gaussians.means)

    # Needles are divided along their longest axis alone: they take the cells without a second step.
    longest, order = gaussians.scales.sort(dim=1, descending=True, stable=True)
    is_wide = longest[:, 1] > MIN_LENGTH * longest[:, 0]
    row, cell = (is_wide[:, None] | (grid[:, 1] == 0)).nonzero().unbind(dim=1)

    # One row per piece from here on. `order` names the axes that the steps and factors belong to.
    whole = gaussians[row]
    num_axes = 1 + is_wide[row].long()
    divided = order[row, :2]
    step = torch.zeros_like(whole.scales).scatter(1, divided, grid[cell])
    is_divided = num_axes[:, None] > torch.arange(2).to(num_axes)
    factors = torch.where(is_divided, PIECE_DEVIATION, 1.0).to(step)
    shrunk = torch.ones_like(step).scatter(1, divided, factors)

    # Convolved with a piece of variance PIECE², these weights give a Gaussian of variance 1. The
    # division by the root of the variance, per axis, keeps its height at 1.
    variance = 1 - PIECE_DEVIATION**2
    weights = (-(step**2).sum(dim=1) / (2 * variance)).exp() / variance ** (num_axes / 2)
    transmittance = 1 - (weights * whole.opacities).clamp_max(MAX_DIVIDED_OPACITY)
    # About PIECE_DEVIATION / PIECE_DISTANCE * sqrt(2 pi) pieces overlap at a point of an axis.
    share = (PIECE_DISTANCE / PIECE_DEVIATION / math.sqrt(2 * math.pi)) ** num_axes
    pieces = replace(
        whole,
        means=move(whole, step),
        scales=whole.scales * shrunk,
        opacities=1 - transmittance**share,
        encoded=None,
    )
    return pieces[pieces.opacities > MIN_PIECE_OPACITY]
