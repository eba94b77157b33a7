"""Rounds of search and vote on one level: which patches fill a hole, and what they show there.

Two implementations: the kernels of the CPU, and tensors for a GPU (decision 155).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray
from torch import Tensor

from gscompleter.numerics.kernels import patchmatch
from gscompleter.numerics.kernels.patchmatch import PATCHMATCH_RADIUS, Costs, PatchProblem
from gscompleter.numerics.tensor_patchmatch import (
    improve_matches,
    upload_array,
    upload_problem,
    vote_pixels,
)

VOTE_SHARPNESS = 8
"""Decay of a vote with its cost; at 1, averaged patches lose a quarter of their detail."""
USUAL_PERCENT = 75
"""Percentile of the costs that they are relative to."""
LEAST_USUAL = 1e-6
"""Smallest such cost."""
MIN_VOTE = 1e-6
"""Smallest vote: a pixel whose patches all fit badly gets their mean."""
FINEST_SPACING = 2
"""Only every second patch is matched on the finest level, as the white squares of a chessboard."""
ROUND_SEED_STEP = 31
"""Difference of the seeds of two rounds, a prime."""


@dataclass(frozen=True)
class PatchRounds:
    """The rounds of search and vote on one level, and where they begin."""

    problem: PatchProblem
    """Its image shows a first guess at the unknown pixels."""
    costs: Costs
    known: Bool[ndarray, "h w"]
    center_weight: Float32[ndarray, "q"]
    """Weight of the pixel of each query, which its vote has for any cost."""
    matches: Int64[ndarray, "q 3"]
    """Source, row and column of the first match of each query; each is usable."""
    is_refined: bool
    """True if a coarser level found the matches, so that they vote before the first search."""
    reach: int
    """Radius of the random search at its start, in pixels."""
    num_rounds: int
    seed: int


RunRounds = Callable[[PatchRounds], tuple[Float32[ndarray, "h w 3"], Int64[ndarray, "q 3"]]]
"""Function that runs rounds and returns the filled image and the matches."""


def run_with_kernels(
    rounds: PatchRounds,
) -> tuple[Float32[ndarray, "h w 3"], Int64[ndarray, "q 3"]]:
    """Run the rounds in compiled loops."""
    problem = rounds.problem._replace(image=rounds.problem.image.copy())
    matches = rounds.matches.copy()
    unknown = ~rounds.known
    image = crop_border(problem.image)

    # Every pixel of the hole is the mean of what the patches over it show there, each with its
    # colour shift and weighted by its vote.
    def vote_colors(
        votes: Float32[ndarray, "q"], shift: Float32[ndarray, "q 3"]
    ) -> Float32[ndarray, "p 3"]:
        colors, _ = patchmatch.vote(problem.query_at, votes, problem.sources, matches, shift)
        return colors[unknown]

    if rounds.is_refined:
        # Before the first search all matches are equally likely.
        no_shift = np.zeros((len(matches), 3), np.float32)
        image[unknown] = vote_colors(rounds.center_weight, no_shift)
    for number in range(rounds.num_rounds):
        seed = rounds.seed + ROUND_SEED_STEP * number
        # Improves `matches` in place.
        cost, shift = patchmatch.search(problem, rounds.costs, matches, rounds.reach, seed)
        image[unknown] = vote_colors(rounds.center_weight * compute_likelihood(cost), shift)
    return image.copy(), matches


def run_with_tensors(
    rounds: PatchRounds, device: str
) -> tuple[Float32[ndarray, "h w 3"], Int64[ndarray, "q 3"]]:
    """Run the rounds on a device, with the terms of `run_with_kernels`.

    The host waits for the result alone.
    """
    problem = upload_problem(rounds.problem, device)
    image = upload_array(rounds.problem.image, device)
    center_weight = upload_array(rounds.center_weight, device)
    matches = upload_array(rounds.matches.T, device)
    unknown = upload_array(np.argwhere(~rounds.known).T, device)
    places = (unknown[0] + PATCHMATCH_RADIUS) * image.shape[1] + unknown[1] + PATCHMATCH_RADIUS

    def show_votes(
        votes: Float32[Tensor, "q"], shift: Float32[Tensor, "q 3"]
    ) -> Float32[Tensor, "rows columns 3"]:
        colors, _ = vote_pixels(problem, unknown, votes, matches, shift)
        return image.flatten(0, 1).index_copy(0, places, colors).view_as(image)

    if rounds.is_refined:
        image = show_votes(center_weight, image.new_zeros((len(center_weight), 3)))
    for number in range(rounds.num_rounds):
        seed = rounds.seed + ROUND_SEED_STEP * number
        matches, cost, shift = improve_matches(
            problem, rounds.costs, image, matches, rounds.reach, seed
        )
        image = show_votes(center_weight * compute_likelihood_there(cost), shift)
    return crop_border(image.cpu().numpy()).copy(), matches.T.cpu().numpy()


def crop_border(image: Float32[ndarray, "rows columns 3"]) -> Float32[ndarray, "h w 3"]:
    """View an image without what `pad_border` adds."""
    return image[PATCHMATCH_RADIUS:-PATCHMATCH_RADIUS, PATCHMATCH_RADIUS : -PATCHMATCH_RADIUS - 1]


def compute_likelihood(cost: Float32[ndarray, "q"]) -> Float32[ndarray, "q"]:
    """Convert costs to vote weights (Wexler et al. 2007, Sec. 3.2)."""
    usual = max(float(np.percentile(cost, USUAL_PERCENT)), LEAST_USUAL)
    likely = np.exp(-VOTE_SHARPNESS * cost / (2 * usual))
    return np.maximum(likely, MIN_VOTE).astype(np.float32)


def compute_likelihood_there(cost: Float32[Tensor, "q"]) -> Float32[Tensor, "q"]:
    """Compute the same on the device of the costs."""
    # The percentile lies between two of the sorted costs, to quarters.
    ascending = cost.sort().values
    whole, percent = divmod(USUAL_PERCENT * (len(cost) - 1), 100)
    upper = ascending[min(whole + 1, len(cost) - 1)]
    usual = torch.lerp(ascending[whole], upper, percent / 100).clamp_min(LEAST_USUAL)
    # Exponentials of single precision differ from one device to the next.
    exponent = -VOTE_SHARPNESS * cost / (2 * usual)
    return exponent.double().exp().float().clamp_min(MIN_VOTE)
