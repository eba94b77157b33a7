"""Nearest-neighbour fields of patches, and the vote for pixel colours, as operations of torch.

The twin of `kernels/patchmatch.py`, for a GPU. All queries go through the trials of a round
together: first their own match and the eight that neighbours propose, of which none depends on
another, then the random ones in turn. Random numbers, candidates and the order of sums are those of
the kernel, and sums of products round once, as compiled loops do on processors that multiply and
add at once (x86-64 with AVX2). There, on tensors of a CPU, matches, costs, shifts and votes are
equal to the bit. Of loops compiled without that, costs differ by up to 1.2e-7 and colours by
2.4e-7 (of about 1), so that a match may differ where two cost the same to that.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor
from torch.nn.functional import pad

from gscompleter.numerics.kernels.patchmatch import (
    PATCHMATCH_RADIUS,
    PATCHMATCH_SIDE,
    Costs,
    PatchProblem,
)
from gscompleter.numerics.tensor_stereo import multiply_add, split_length

NEIGHBOUR_STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1), (4, 0), (-4, 0), (0, 4), (0, -4))
"""Rows and columns from a query to those that propose their offset, in the order of the kernel."""
MAP_BORDER = 4
"""Pixels around the map of queries. No neighbour, and no pixel of a patch, is farther away."""
RANDOM_TRIALS = range(8, 24)
"""Numbers of the random trials. One whose number three divides draws the source, too."""
HASH_STEP = 0x9E3779B97F4A7C15
"""Increment of a state of the random numbers before it is hashed."""
HASH_FACTORS = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
"""Factors of the hash."""

LAUNCHES_PER_ROUND = 694
"""Operations of a search with four random trials and of its vote, each of which a GPU is given
alone, where all patches are one part."""

PATCHES_BYTES = 2**28
"""Bytes that the comparison of some patches, or the vote for some pixels, holds at once. A GPU is
busy with them for longer than a launch takes."""
PAIR_BYTES = 3500
"""Most bytes that two patches hold while they are compared."""
VOTE_BYTES = 5500
"""Most bytes that a pixel holds while the patches over it vote."""


class TensorProblem(NamedTuple):
    """A `PatchProblem` of the kernels on a device, without its image, which changes every round."""

    weight: Float32[Tensor, "rows columns"]
    """Weights of pixels, with the border of `pad_border`."""
    inverse_total: Float32[Tensor, "q 1"]
    """Inverse of the sum of the weights in the patch of each query."""
    queries: Int64[Tensor, "2 q"]
    """Rows and columns of the pixels whose patches are matched."""
    query_at: Int64[Tensor, "map_rows map_columns"]
    """Query of each pixel, or -1, with a border of `MAP_BORDER`."""
    expected_log_depth: Float32[Tensor, "q"]
    sources: Float32[Tensor, "s source_h source_w+1 3"]
    """With the column of `pad_column`."""
    usable: Bool[Tensor, "s source_h source_w"]
    """True for valid patch centres, none of whose pixels lie outside of the source."""
    log_depth: Float32[Tensor, "s source_h source_w"]


class QueryPatches(NamedTuple):
    """Some of the queries, with their patches of the image."""

    queries: Int64[Tensor, "2 q"]
    colors: Float32[Tensor, "q side side 3"]
    weight: Float32[Tensor, "q side side 1"]
    inverse_total: Float32[Tensor, "q 1"]
    expected_log_depth: Float32[Tensor, "q"]


def upload_array(array: np.ndarray, device: str) -> Tensor:
    """Copy an array to a device, where rows follow each other; the host does not wait."""
    return torch.from_numpy(np.ascontiguousarray(array)).to(device, non_blocking=True)


def upload_problem(problem: PatchProblem, device: str) -> TensorProblem:
    """Copy all of a problem but its image to a device."""
    upload = partial(upload_array, device=device)
    return TensorProblem(
        # The same for all channels.
        weight=upload(problem.weight[..., 0]),
        inverse_total=1 / upload(problem.total).clamp_min(1e-12)[:, None],
        queries=upload(problem.queries.T),
        query_at=pad(upload(problem.query_at), (MAP_BORDER,) * 4, value=-1),
        expected_log_depth=upload(problem.expected_log_depth),
        sources=upload(problem.sources),
        usable=upload(problem.usable_mask),
        log_depth=upload(problem.log_depth),
    )


def improve_matches(
    problem: TensorProblem,
    costs: Costs,
    image: Float32[Tensor, "rows columns 3"],
    matches: Int64[Tensor, "3 q"],
    max_reach: int,
    seed: int,
) -> tuple[Int64[Tensor, "3 q"], Float32[Tensor, "q"], Float32[Tensor, "q 3"]]:
    """Improve the nearest source patch of every query once, as `search` of the kernels.

    `image` has the border of `pad_border`; matches are source, row and column. Returns the new
    matches, their costs and their shifts of colour. The host waits for nothing.
    """
    count = matches.shape[1]
    found = torch.empty_like(matches)
    cost = image.new_empty(count)
    shift = image.new_empty((count, 3))
    # Neighbours are read from the matches of the last round, so that parts may have any length.
    for part in split_length(count, PATCHES_BYTES // ((1 + len(NEIGHBOUR_STEPS)) * PAIR_BYTES)):
        patches = cut_patches(problem, image, part)
        given = propose_matches(problem, patches.queries, matches, part)
        given_cost, given_shift = compare_patches(problem, costs, patches, given)
        # Of equal costs the first one, as a match gives way to a better one alone.
        least, best = given_cost.min(dim=0)
        cost[part] = least
        found[:, part] = given.gather(1, best.expand(3, 1, -1))[:, 0]
        shift[part] = given_shift.gather(0, best[None, :, None].expand(1, -1, 3))[0]
    for part in split_length(count, PATCHES_BYTES // PAIR_BYTES):
        patches = cut_patches(problem, image, part)
        state = begin_random(patches.queries, seed)
        reach = max_reach
        for trial in RANDOM_TRIALS:
            if reach < 1:
                break
            state = hash_states(state + wrap_integer(HASH_STEP))
            drawn = draw_matches(problem, state, found[:, part], reach, trial % 3 == 0)
            drawn_cost, drawn_shift = compare_patches(problem, costs, patches, drawn)
            is_better = drawn_cost < cost[part]
            found[:, part] = drawn.where(is_better, found[:, part])
            shift[part] = drawn_shift.where(is_better[:, None], shift[part])
            cost[part] = drawn_cost.where(is_better, cost[part])
            reach = reach * 6 // 10
    return found, cost, shift


def cut_patches(
    problem: TensorProblem, image: Float32[Tensor, "rows columns 3"], part: slice
) -> QueryPatches:
    """Cut the patches of some queries out of the image."""
    queries = problem.queries[:, part]
    place = queries[0] * image.shape[1] + queries[1]
    return QueryPatches(
        queries,
        view_patches(image)[place],
        view_patches(problem.weight[..., None])[place],
        problem.inverse_total[part],
        problem.expected_log_depth[part],
    )


def view_patches(
    image: Float32[Tensor, "rows columns c"],
) -> Float32[Tensor, "places side side c"]:
    """View the patch that begins at each pixel, in memory order, as far as there is one.

    Of pixels near the right side it goes on in the next row, as that of a kernel would.
    """
    rows, columns, channels = image.shape
    places = (rows - PATCHMATCH_SIDE + 1) * columns - PATCHMATCH_SIDE + 1
    across = channels
    down = columns * channels
    return image.as_strided(
        (places, PATCHMATCH_SIDE, PATCHMATCH_SIDE, channels), (across, down, across, 1)
    )


def propose_matches(
    problem: TensorProblem,
    queries: Int64[Tensor, "2 part"],
    matches: Int64[Tensor, "3 q"],
    part: slice,
) -> Int64[Tensor, "3 n part"]:
    """Propose for some queries their own match, and the offset of each neighbour.

    Where there is no neighbour, it is the own match once more, which changes nothing.
    """
    steps = torch.tensor([(0, down, across) for down, across in NEIGHBOUR_STEPS]).T[..., None]
    steps = steps.to(matches.device, non_blocking=True)
    columns = problem.query_at.shape[1]
    place = (queries[0] + MAP_BORDER) * columns + queries[1] + MAP_BORDER
    neighbour = problem.query_at.flatten()[place + steps[1] * columns + steps[2]]
    own = matches[:, None, part]
    proposed = matches[:, neighbour.clamp_min(0)] - steps
    return torch.cat([own, proposed.where(neighbour >= 0, own)], dim=1)


def begin_random(queries: Int64[Tensor, "2 q"], seed: int) -> Int64[Tensor, "q"]:
    """Hash a seed of up to 64 bits, and the place of each query, to its first state."""
    return hash_states(queries[0] * 65537 + queries[1] + wrap_integer(seed * HASH_STEP))


def draw_matches(
    problem: TensorProblem,
    state: Int64[Tensor, "q"],
    around: Int64[Tensor, "3 q"],
    reach: int,
    draws_source: bool,
) -> Int64[Tensor, "3 q"]:
    """Draw a place within `reach` pixels of each match, and if need be a source of it."""
    span = 2 * reach + 1
    y = around[1] + (state & 0xFFFFFF) % span - reach
    x = around[2] + ((state >> 24) & 0xFFFFFF) % span - reach
    source = shift_right(state, 48) % len(problem.sources) if draws_source else around[0]
    return torch.stack([source, y, x])


def hash_states(value: Int64[Tensor, "q"]) -> Int64[Tensor, "q"]:
    """Mix the bits of numbers as the kernel does, whose 64 bits have no sign.

    Sums and products have the same lower 64 bits with a sign and without.
    """
    first, second = map(wrap_integer, HASH_FACTORS)
    value = (value ^ shift_right(value, 30)) * first
    value = (value ^ shift_right(value, 27)) * second
    return value ^ shift_right(value, 31)


def shift_right(value: Int64[Tensor, "q"], bits: int) -> Int64[Tensor, "q"]:
    """Shift to the right with zeros from the left, where torch repeats the sign."""
    return (value >> bits) & (2 ** (64 - bits) - 1)


def wrap_integer(value: int) -> int:
    """Return the number with a sign that has the same lower 64 bits."""
    return (value + 2**63) % 2**64 - 2**63


def compare_patches(
    problem: TensorProblem,
    costs: Costs,
    patches: QueryPatches,
    matches: Int64[Tensor, "3 *n q"],
) -> tuple[Float32[Tensor, "*n q"], Float32[Tensor, "*n q 3"]]:
    """Compute what matches of queries cost after the best shift, and that shift of each channel.

    A match that is not usable costs infinitely much.
    """
    source, y, x = matches
    _, height, width = problem.usable.shape
    # Places outside become places at the border, where nothing is usable either.
    y = y.clamp(0, height - 1)
    x = x.clamp(0, width - 1)
    row = source * height + y
    place = row * width + x
    is_usable = problem.usable.flatten()[place]
    nearer = patches.expected_log_depth - problem.log_depth.flatten()[place]
    down = y - patches.queries[0]
    across = x - patches.queries[1]
    prior = compute_priors(costs, nearer, down * down + across * across)

    all_patches = view_patches(problem.sources.flatten(0, 1))
    # Rows of the colours are longer by one pixel.
    corner = place + row - PATCHMATCH_RADIUS * (width + 2)
    error = patches.colors - all_patches[corner.clamp(0, len(all_patches) - 1)]
    weighted = patches.weight * error
    square = sum_squares(weighted, error)
    # Each lane over all rows first, as in the kernel.
    of_columns = sum_in_order(weighted, -3)
    mean = sum_in_order(of_columns, -2) * patches.inverse_total
    max_bias = float(costs.max_bias)
    bias = mean.clamp(-max_bias, max_bias)
    # b d and b² of mean difference d and shift b, by which the mean square falls: see the kernel.
    both = torch.stack([mean, bias])
    products = multiply_add(both[..., 0], bias[..., 0], both[..., 1] * bias[..., 1])
    with_mean, with_bias = multiply_add(both[..., 2], bias[..., 2], products)
    cost = multiply_add(square, patches.inverse_total[:, 0], with_bias - 2 * with_mean)
    cost = multiply_add(with_bias, float(costs.bias_penalty), cost)
    return (prior + cost).where(is_usable, torch.inf), bias


def compute_priors(
    costs: Costs, nearer: Float32[Tensor, "*n q"], squared_distance: Int64[Tensor, "*n q"]
) -> Float32[Tensor, "*n q"]:
    """Compute the cost of sources by depth and distance, whatever their colours are."""
    nearer = nearer.clamp_min(0)
    # Divided by a tensor, as the reciprocal of a number would round otherwise.
    diagonal = nearer.new_full((), float(costs.diagonal))
    far = (squared_distance.double().sqrt().float() / diagonal).clamp_max(1)
    of_depth = (nearer * nearer).clamp_max(1) * float(costs.depth_penalty)
    return multiply_add(far, float(costs.distance_penalty), of_depth)


def sum_squares(
    weighted: Float32[Tensor, "*n side side 3"], error: Float32[Tensor, "*n side side 3"]
) -> Float32[Tensor, "*n"]:
    """Sum the products of errors and weighted errors in the order of the kernel."""
    # Exact in double precision, so that each sum of a lane rounds once.
    products = weighted.double()
    products *= error
    lanes = products[..., 0, :, :].float()
    for row in range(1, PATCHMATCH_SIDE):
        torch.add(products[..., row, :, :], lanes, out=lanes)
    return sum_in_order(sum_in_order(lanes, -1), -1)


def sum_in_order(values: Float32[Tensor, "*n"], dim: int) -> Float32[Tensor, "*m"]:
    """Sum over a dimension from its first element to its last."""
    first, second, *others = values.unbind(dim)
    total = first + second
    for other in others:
        total += other
    return total


def vote_pixels(
    problem: TensorProblem,
    pixels: Int64[Tensor, "2 p"],
    votes: Float32[Tensor, "q"],
    matches: Int64[Tensor, "3 q"],
    shift: Float32[Tensor, "q 3"],
) -> tuple[Float32[Tensor, "p 3"], Float32[Tensor, "p"]]:
    """Compute the mean colour of the patches over some pixels, and their weight, as `vote` does.

    `pixels` are rows and columns; each pixel gathers from the patches around it, in the order in
    which the kernel spreads them.
    """
    _, height, width, _ = problem.sources.shape
    columns = problem.query_at.shape[1]
    source, y, x = matches
    centres = (source * height + y) * width + x
    within = torch.arange(-PATCHMATCH_RADIUS, PATCHMATCH_RADIUS + 1, device=matches.device)
    query_steps = (within[:, None] * columns + within).flatten()[:, None]
    source_steps = (within[:, None] * width + within).flatten()[:, None]
    sums = votes.new_empty((pixels.shape[1], 4))
    for part in split_length(len(sums), PATCHES_BYTES // VOTE_BYTES):
        place = (pixels[0, part] + MAP_BORDER) * columns + pixels[1, part] + MAP_BORDER
        query = problem.query_at.flatten()[place + query_steps]
        weight = votes[query.clamp_min(0)].where(query >= 0, 0.0)
        query = query.clamp_min(0)
        # Below the centre of a patch it shows what is above the centre of its match.
        colors = problem.sources.view(-1, 3)[centres[query] - source_steps] + shift[query]
        # The fourth channel sums the weights.
        products = pad(colors, (0, 1), value=1.0) * weight.double()[..., None]
        total = products[0].float()
        for product in products[1:]:
            torch.add(product, total, out=total)
        sums[part] = total
    return sums[:, :3] / sums[:, 3:].clamp_min(1e-12), sums[:, 3]
