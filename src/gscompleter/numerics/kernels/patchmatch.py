"""Nearest-neighbour fields of patches over several images, and the vote for pixel colours.

Pixels read the field of the last round and hash random numbers: any thread count gives one result.
"""

from typing import NamedTuple

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.parallel import share

PATCHMATCH_RADIUS = 3
"""Radius of a patch of 2 * radius + 1 pixels; a compile-time constant for vectorised rows."""
PATCHMATCH_SIDE = 2 * PATCHMATCH_RADIUS + 1
"""Side of a patch, in pixels."""
LANES = 24
"""Values per row of a patch: 3 per pixel, with one pixel of padding to fill whole registers."""


class PatchProblem(NamedTuple):
    """The image to complete, and the sources of its patches."""

    image: np.ndarray
    """float32 [h + 2 r, w + 2 r + 1, 3], r of `PATCHMATCH_RADIUS`: padded by `pad_border`."""
    weight: np.ndarray
    """float32, same shape: weight of each value."""
    total: np.ndarray
    """float32 [q]: sum of the pixel weights of each query's patch."""
    queries: np.ndarray
    """Pixels (y, x) whose patches are matched [q, 2]."""
    query_at: np.ndarray
    """Index of the query of each pixel, or -1 [h, w]."""
    expected_log_depth: np.ndarray
    """float32 [q]: logarithm of the expected depth of each query."""
    sources: np.ndarray
    """float32 [s, H, W + 1, 3]: source images, padded by `pad_column`."""
    usable_mask: np.ndarray
    """bool [s, H, W]: True for valid patch centres."""
    log_depth: np.ndarray
    """float32 [s, H, W]: logarithm of the source depths."""


class Costs(NamedTuple):
    """Costs of a match in addition to its difference."""

    max_bias: np.float32
    """Largest shift of a colour channel between two patches."""
    bias_penalty: np.float32
    """Cost of a squared shift of 1."""
    depth_penalty: np.float32
    """Largest cost of a source in front of the expected depth."""
    distance_penalty: np.float32
    """Largest cost of a source far away in the image."""
    diagonal: np.float32
    """Distance of the largest cost, in pixels."""


@njit(inline="always")
def _hash(value):
    """Mix the bits of a 64-bit number (the finaliser of splitmix64)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


def pad_border(image):
    """Pad `image` [h, w, 3] with zeros for the patches around its corners."""
    return np.pad(
        image,
        (
            (PATCHMATCH_RADIUS, PATCHMATCH_RADIUS),
            (PATCHMATCH_RADIUS, PATCHMATCH_RADIUS + 1),
            (0, 0),
        ),
    )


def pad_column(images):
    """Pad images [s, H, W, 3] with a column of zeros on the right, as kernels read them."""
    return np.pad(images, ((0, 0), (0, 0), (0, 1), (0, 0)))


@njit(inline="always")
def _copy(image, y, x, patch):
    """Copy a patch of a padded image, its pixels and channels side by side in each row."""
    numbers = image.reshape(-1)
    stride = np.uintp(3 * image.shape[1])
    start = np.uintp(y) * stride + np.uintp(3 * x)
    for lane in range(LANES):
        for row in range(PATCHMATCH_SIDE):
            patch[row, lane] = numbers[start + np.uintp(row) * stride + np.uintp(lane)]


@njit(inline="always")
def _compute_patch_cost(costs, patch, weight, total, sources, s, sy, sx, sums, bias):
    """Compute the mean squared difference of `patch` and (s, sy, sx) after the best shift."""
    max_bias = costs.max_bias
    bias_penalty = costs.bias_penalty
    numbers = sources.reshape(-1)
    H, W = sources.shape[1:3]
    # Unsigned, so that no index is checked for negative values.
    stride = np.uintp(3 * W)
    start = np.uintp(3 * ((s * H + sy - PATCHMATCH_RADIUS) * W + sx - PATCHMATCH_RADIUS))
    # Each lane sums its column of the patch over all rows, so that lanes are vectorised.
    for lane in range(LANES):
        square = difference = np.float32(0)
        for row in range(PATCHMATCH_SIDE):
            e = patch[row, lane] - numbers[start + np.uintp(row) * stride + np.uintp(lane)]
            weighted = weight[row, lane] * e
            difference += weighted
            square += weighted * e
        sums[0, lane], sums[1, lane] = square, difference
    square = d0 = d1 = d2 = np.float32(0)
    for column in range(PATCHMATCH_SIDE):
        square += sums[0, 3 * column] + sums[0, 3 * column + 1] + sums[0, 3 * column + 2]
        d0 += sums[1, 3 * column]
        d1 += sums[1, 3 * column + 1]
        d2 += sums[1, 3 * column + 2]
    inverse = np.float32(1) / max(total, np.float32(1e-12))
    cost = square * inverse
    d0 *= inverse
    d1 *= inverse
    d2 *= inverse
    # With mean difference d and shift b, the mean square falls by 2 b d - b²: d is the best shift,
    # as far as it is allowed.
    b0 = min(max(d0, -max_bias), max_bias)
    b1 = min(max(d1, -max_bias), max_bias)
    b2 = min(max(d2, -max_bias), max_bias)
    cost -= np.float32(2) * (b0 * d0 + b1 * d1 + b2 * d2) - (b0 * b0 + b1 * b1 + b2 * b2)
    cost += bias_penalty * (b0 * b0 + b1 * b1 + b2 * b2)
    bias[0], bias[1], bias[2] = b0, b1, b2
    return cost


@njit(fastmath={"contract"})
def _compute_prior(costs, nearer, dy, dx):
    """Compute the cost of a source by its depth and distance, whatever its colours are.

    nearer: logarithm of the expected depth over that of the source.
    """
    distance = np.float32(np.sqrt(float(dy**2 + dx**2)))
    nearer = max(nearer, np.float32(0))
    return costs.depth_penalty * min(nearer * nearer, np.float32(1)) + (
        costs.distance_penalty * min(distance / costs.diagonal, np.float32(1))
    )


def search(problem, costs, field, max_reach, seed):
    """Improve the nearest source patch of every query once, by propagation and random search.

    field: matches (source, y, x) [q, 3], all of them usable; updated in place.
    max_reach: radius of the random search at its start, in pixels.
    Returns the cost of every match [q] and its shift of colour [q, 3].
    """
    count = len(problem.queries)
    cost = np.full(count, np.inf, np.float32)
    shift = np.zeros((count, 3), np.float32)
    share(_improve, count, problem, costs, max_reach, seed, field.copy(), field, cost, shift)
    return cost, shift


@njit(nogil=True, fastmath={"contract"})
def _improve(begin, end, problem, costs, max_reach, seed, before, field, cost, shift):
    """Improve the queries begin..end; `before` is the previous field."""
    usable = problem.usable_mask
    query_at = problem.query_at
    num_sources, H, W = usable.shape
    h, w = query_at.shape
    patch = np.empty((PATCHMATCH_SIDE, LANES), np.float32)
    weight = np.empty((PATCHMATCH_SIDE, LANES), np.float32)
    sums = np.empty((2, LANES), np.float32)
    bias = np.empty(3, np.float32)
    for i in range(begin, end):
        y, x = problem.queries[i, 0], problem.queries[i, 1]
        _copy(problem.image, y, x, patch)
        _copy(problem.weight, y, x, weight)
        best = cost[i]
        state = _hash(np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(y * 65537 + x))
        reach = max_reach
        for trial in range(-1, 24):
            if trial < 0:
                # The cost of the initial match is not known yet.
                s = field[i, 0]
                sy = field[i, 1]
                sx = field[i, 2]
            elif trial < 8:
                # Neighbours one and four pixels away propose their own offset.
                step = 1 if trial < 4 else 4
                side = trial % 4
                ny = y + (step if side == 0 else (-step if side == 1 else 0))
                nx = x + (step if side == 2 else (-step if side == 3 else 0))
                if ny < 0 or ny >= h or nx < 0 or nx >= w or query_at[ny, nx] < 0:
                    continue
                j = query_at[ny, nx]
                s = before[j, 0]
                sy = before[j, 1] + y - ny
                sx = before[j, 2] + x - nx
            else:
                # Random search around the best match so far, in shrinking windows.
                if reach < 1:
                    break
                state = _hash(state + np.uint64(0x9E3779B97F4A7C15))
                s = field[i, 0]
                if trial % 3 == 0:
                    s = np.int64((state >> np.uint64(48)) % np.uint64(num_sources))
                span = np.uint64(2 * reach + 1)
                sy = field[i, 1] + np.int64((state & np.uint64(0xFFFFFF)) % span) - reach
                other = (state >> np.uint64(24)) & np.uint64(0xFFFFFF)
                sx = field[i, 2] + np.int64(other % span) - reach
                reach = reach * 6 // 10
            if sy < 0 or sy >= H or sx < 0 or sx >= W or not usable[s, sy, sx]:
                continue
            if trial >= 0 and s == field[i, 0] and sy == field[i, 1] and sx == field[i, 2]:
                continue
            nearer = problem.expected_log_depth[i] - problem.log_depth[s, sy, sx]
            prior = _compute_prior(costs, nearer, sy - y, sx - x)
            # Costs only add to it, so that the patch need not be compared.
            if prior >= best:
                continue
            proposed = prior + _compute_patch_cost(
                costs, patch, weight, problem.total[i], problem.sources, s, sy, sx, sums, bias
            )
            if proposed < best:
                best = proposed
                field[i, 0], field[i, 1], field[i, 2] = s, sy, sx
                cost[i] = proposed
                for c in range(3):
                    shift[i, c] = bias[c]


def vote(query_at, vote_weight, sources, field, shift):
    """Compute the weighted mean colour of all patches over each pixel, and the total weight.

    query_at [h, w]: query of each pixel, or -1. vote_weight [q]: weight of its patch.
    field, shift: match of each query, and the shift added to its colours.
    """
    h, w = query_at.shape
    # Wider than the image, so that patches over its sides need not be cut.
    colors = np.zeros((h, w + 2 * PATCHMATCH_RADIUS, 3), np.float32)
    totals = np.zeros((h, w + 2 * PATCHMATCH_RADIUS), np.float32)
    share(_vote, h, query_at, vote_weight, sources, field, shift, colors, totals)
    inner = np.s_[:, PATCHMATCH_RADIUS:-PATCHMATCH_RADIUS]
    return colors[inner] / np.maximum(totals[inner], 1e-12)[..., None], totals[inner]


@njit(nogil=True, fastmath={"contract"})
def _vote(begin, end, query_at, vote_weight, sources, field, shift, colors, totals):
    h, w = query_at.shape
    # A thread writes its own rows alone, and reads the patches that reach into them from outside.
    for y in range(max(begin - PATCHMATCH_RADIUS, 0), min(end + PATCHMATCH_RADIUS, h)):
        for x in range(w):
            q = query_at[y, x]
            if q < 0:
                continue
            a = vote_weight[q]
            s = field[q, 0]
            sy = field[q, 1]
            sx = field[q, 2]
            for dy in range(
                max(-PATCHMATCH_RADIUS, begin - y), min(PATCHMATCH_RADIUS, end - 1 - y) + 1
            ):
                source_row = sources[s, sy + dy]
                sums = colors[y + dy]
                for column in range(PATCHMATCH_SIDE):
                    for c in range(3):
                        color = source_row[sx - PATCHMATCH_RADIUS + column, c] + shift[q, c]
                        sums[x + column, c] += a * color
                    totals[y + dy, x + column] += a
