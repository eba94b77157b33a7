"""Nearest-neighbour fields of patches over several images, and the vote that turns them to pixels.

Every pixel reads the field of the previous round only and draws its own random numbers from a
hash, so that the result does not depend on the number of threads.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from gscompleter.kernels.sharing import share


class Matched(NamedTuple):
    """What is matched with what."""

    image: np.ndarray
    """float32 [h, w, 3]: what is being completed."""
    weight: np.ndarray
    """float32 [h, w]: how much each of its pixels counts."""
    queries: np.ndarray
    """Pixels (y, x) whose patches are matched [q, 2]."""
    query_at: np.ndarray
    """For each pixel the index of its query, or -1 [h, w]."""
    expected: np.ndarray
    """float32 [q]: logarithm of the depth that each query should have."""
    sources: np.ndarray
    """float32 [s, H, W, 3]: images that patches are taken from."""
    usable: np.ndarray
    """bool [s, H, W]: the centres that a patch may have there."""
    log_depth: np.ndarray
    """float32 [s, H, W]: logarithm of the depths there."""


class Costs(NamedTuple):
    """What a match costs, besides its difference."""

    radius: int
    """Of a patch, in pixels."""
    max_bias: np.float32
    """Largest shift of a colour channel between two patches."""
    bias_penalty: np.float32
    """Cost of such a shift, squared."""
    depth_penalty: np.float32
    """Largest cost of a source that lies before the expected depth."""
    distance_penalty: np.float32
    """Largest cost of a source far away in the image."""
    diagonal: np.float32
    """Pixels that are far away."""


@njit(cache=True, inline="always")
def _hash(value):
    """A well mixed 64-bit number (the finaliser of splitmix64)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, fastmath={"contract"})
def _patch_cost(matched, costs, y, x, s, sy, sx, bias):
    """Mean squared difference of two patches after the best small shift of each colour channel.

    The shift is written to `bias`. Pixels of the patch outside of the image do not count.
    """
    image, weight, sources = matched.image, matched.weight, matched.sources
    radius, max_bias, bias_penalty = costs.radius, costs.max_bias, costs.bias_penalty
    h, w = weight.shape
    total = square = np.float32(0)
    d0 = d1 = d2 = np.float32(0)
    for dy in range(max(-radius, -y), min(radius, h - 1 - y) + 1):
        for dx in range(max(-radius, -x), min(radius, w - 1 - x) + 1):
            a = weight[y + dy, x + dx]
            e0 = image[y + dy, x + dx, 0] - sources[s, sy + dy, sx + dx, 0]
            e1 = image[y + dy, x + dx, 1] - sources[s, sy + dy, sx + dx, 1]
            e2 = image[y + dy, x + dx, 2] - sources[s, sy + dy, sx + dx, 2]
            total += a
            square += a * (e0 * e0 + e1 * e1 + e2 * e2)
            d0 += a * e0
            d1 += a * e1
            d2 += a * e2
    inverse = np.float32(1) / max(total, np.float32(1e-12))
    cost = square * inverse
    d0 *= inverse
    d1 *= inverse
    d2 *= inverse
    b0 = min(max(d0, -max_bias), max_bias)
    b1 = min(max(d1, -max_bias), max_bias)
    b2 = min(max(d2, -max_bias), max_bias)
    cost -= np.float32(2) * (b0 * d0 + b1 * d1 + b2 * d2) - (b0 * b0 + b1 * b1 + b2 * b2)
    cost += bias_penalty * (b0 * b0 + b1 * b1 + b2 * b2)
    bias[0], bias[1], bias[2] = b0, b1, b2
    return cost


@njit(cache=True, fastmath={"contract"})
def _prior(costs, nearer, dy, dx):
    """What a source costs for lying before the expected depth, and for being far away."""
    distance = np.float32(np.sqrt(float(dy**2 + dx**2)))
    nearer = max(nearer, np.float32(0))
    return costs.depth_penalty * min(nearer * nearer, np.float32(1)) + (
        costs.distance_penalty * min(distance / costs.diagonal, np.float32(1))
    )


def search(matched, costs, field, rounds, max_reach, seed):
    """Improve the nearest source patch of every query, by propagation and random search.

    Args:
        matched, costs: What is matched, and what matches cost.
        field: Matches (source, y, x) [q, 3]; all of them usable. Written to.
        rounds: Passes of propagation and random search.
        max_reach: Pixels within which the random search begins; it shrinks from there.
        seed: Of the random search.

    Returns:
        The cost of every match [q] and its shift of colour [q, 3].
    """
    count = len(matched.queries)
    cost, shift = np.empty(count, np.float32), np.empty((count, 3), np.float32)
    share(_rate, count, matched, costs, field, cost, shift)
    for number in range(rounds):
        chance = (number, max_reach, seed)
        share(_improve, count, matched, costs, *chance, field.copy(), field, cost, shift)
    return cost, shift


@njit(cache=True, nogil=True, fastmath={"contract"})
def _rate(begin, end, matched, costs, field, cost, shift):
    """Fill in what the matches of the queries from `begin` to `end` cost."""
    bias = np.empty(3, np.float32)
    for i in range(begin, end):
        y, x = matched.queries[i, 0], matched.queries[i, 1]
        s, sy, sx = field[i, 0], field[i, 1], field[i, 2]
        difference = _patch_cost(matched, costs, y, x, s, sy, sx, bias)
        nearer = matched.expected[i] - matched.log_depth[s, sy, sx]
        cost[i] = difference + _prior(costs, nearer, sy - y, sx - x)
        for c in range(3):
            shift[i, c] = bias[c]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _improve(begin, end, matched, costs, number, max_reach, seed, before, field, cost, shift):
    """Pass `number` over the queries from `begin` to `end`; `before` is the field of the one
    before."""
    usable, query_at = matched.usable, matched.query_at
    num_sources, H, W = usable.shape
    h, w = query_at.shape
    bias = np.empty(3, np.float32)
    for i in range(begin, end):
        y, x = matched.queries[i, 0], matched.queries[i, 1]
        best = cost[i]
        state = _hash(
            np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15)
            + np.uint64(number * 1000003)
            + np.uint64(y * 65537 + x)
        )
        reach = max_reach
        for trial in range(24):
            if trial < 8:
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
                sx = (
                    field[i, 2]
                    + np.int64(((state >> np.uint64(24)) & np.uint64(0xFFFFFF)) % span)
                    - reach
                )
                reach = reach * 6 // 10
            if sy < 0 or sy >= H or sx < 0 or sx >= W or not usable[s, sy, sx]:
                continue
            if s == field[i, 0] and sy == field[i, 1] and sx == field[i, 2]:
                continue
            nearer = matched.expected[i] - matched.log_depth[s, sy, sx]
            prior = _prior(costs, nearer, sy - y, sx - x)
            if prior >= best:
                continue
            proposed = prior + _patch_cost(matched, costs, y, x, s, sy, sx, bias)
            if proposed < best:
                best = proposed
                field[i, 0], field[i, 1], field[i, 2] = s, sy, sx
                cost[i] = proposed
                for c in range(3):
                    shift[i, c] = bias[c]


def vote(pixels, query_at, vote_weight, sources, field, shift, radius):
    """Weighted mean of what all patches over a pixel say about it, for `pixels` [p, 2].

    Returns:
        Colours [p, 3] and the sum of their weights [p].
    """
    colours = np.zeros((len(pixels), 3), np.float32)
    totals = np.zeros(len(pixels), np.float32)
    given = (pixels, query_at, vote_weight, sources, field, shift, radius)
    share(_vote, len(pixels), *given, colours, totals)
    return colours, totals


@njit(cache=True, nogil=True, fastmath={"contract"})
def _vote(
    begin, end, pixels, query_at, vote_weight, sources, field, shift, radius, colours, totals
):
    """Fill in the pixels from `begin` to `end`."""
    h, w = query_at.shape
    for p in range(begin, end):
        y, x = pixels[p, 0], pixels[p, 1]
        total = r = g = b = np.float32(0)
        for dy in range(max(-radius, -y), min(radius, h - 1 - y) + 1):
            for dx in range(max(-radius, -x), min(radius, w - 1 - x) + 1):
                q = query_at[y + dy, x + dx]
                if q < 0:
                    continue
                a = vote_weight[q]
                s, sy, sx = field[q, 0], field[q, 1] - dy, field[q, 2] - dx
                r += a * (sources[s, sy, sx, 0] + shift[q, 0])
                g += a * (sources[s, sy, sx, 1] + shift[q, 1])
                b += a * (sources[s, sy, sx, 2] + shift[q, 2])
                total += a
        if total > 0:
            colours[p, 0], colours[p, 1], colours[p, 2] = r / total, g / total, b / total
        totals[p] = total
