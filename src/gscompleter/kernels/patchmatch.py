"""Nearest-neighbour fields of patches over several images, and the vote that turns them to pixels.

Every pixel reads the field of the previous round only and draws its own random numbers from a
hash, so that the result does not depend on the number of threads.
"""

import numpy as np
from numba import njit

from gscompleter.kernels.sharing import share


@njit(cache=True, inline="always")
def _hash(value):
    """A well mixed 64-bit number (the finaliser of splitmix64)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, fastmath={"contract"})
def _patch_cost(image, weight, y, x, sources, s, sy, sx, radius, max_bias, bias_penalty, bias):
    """Mean squared difference of two patches after the best small shift of each colour channel.

    The shift is written to `bias`. Pixels of the patch outside of the image do not count.
    """
    h, w = image.shape[0], image.shape[1]
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
def _prior(nearer, dy, dx, diagonal, depth_penalty, distance_penalty):
    """What a source costs for lying before the expected depth, and for being far away."""
    distance = np.float32(np.sqrt(float(dy**2 + dx**2)))
    nearer = max(nearer, np.float32(0))
    return depth_penalty * min(nearer * nearer, np.float32(1)) + (
        distance_penalty * min(distance / diagonal, np.float32(1))
    )


def search(
    image,
    weight,
    queries,
    query_at,
    expected,
    sources,
    usable,
    log_depth,
    field,
    radius,
    max_bias,
    bias_penalty,
    depth_penalty,
    distance_penalty,
    rounds,
    max_reach,
    seed,
):
    """Improve the nearest source patch of every query, by propagation and random search.

    Args:
        image, weight: What is being completed [h, w, 3] and how much each pixel counts [h, w].
        queries, query_at: Pixels (y, x) whose patches are matched [q, 2], and for each pixel the
            index of its query or -1 [h, w].
        expected: Logarithm of the depth each query should have [q].
        sources, usable, log_depth: Images [s, H, W, 3], the centres a patch may be taken from,
            and the logarithm of their depths [s, H, W].
        field: Matches (source, y, x) [q, 3]; all of them usable. Written to.
        rounds: Passes of propagation and random search.
        max_reach: Pixels within which the random search begins; it shrinks from there.
        seed: Of the random search.

    Returns:
        The cost of every match [q] and its shift of colour [q, 3].
    """
    H, W = usable.shape[1:]
    diagonal = np.float32(np.sqrt(H * H + W * W))
    given = (image, weight, queries, query_at, expected, sources, log_depth)
    costs_of = (radius, max_bias, bias_penalty, diagonal, depth_penalty, distance_penalty)
    cost, shift = np.empty(len(queries), np.float32), np.empty((len(queries), 3), np.float32)
    share(_rate, len(queries), *given, field, *costs_of, cost, shift)
    for number in range(rounds):
        chance = (number, max_reach, seed)
        found = (field.copy(), field, cost, shift)
        share(_improve, len(queries), *given, usable, *costs_of, *chance, *found)
    return cost, shift


@njit(cache=True, nogil=True, fastmath={"contract"})
def _rate(
    begin,
    end,
    image,
    weight,
    queries,
    query_at,
    expected,
    sources,
    log_depth,
    field,
    radius,
    max_bias,
    bias_penalty,
    diagonal,
    depth_penalty,
    distance_penalty,
    cost,
    shift,
):
    """Fill in what the matches of the queries from `begin` to `end` cost."""
    bias = np.empty(3, np.float32)
    for i in range(begin, end):
        y, x = queries[i, 0], queries[i, 1]
        s, sy, sx = field[i, 0], field[i, 1], field[i, 2]
        cost[i] = _patch_cost(
            image, weight, y, x, sources, s, sy, sx, radius, max_bias, bias_penalty, bias
        ) + _prior(
            expected[i] - log_depth[s, sy, sx],
            sy - y,
            sx - x,
            diagonal,
            depth_penalty,
            distance_penalty,
        )
        for c in range(3):
            shift[i, c] = bias[c]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _improve(
    begin,
    end,
    image,
    weight,
    queries,
    query_at,
    expected,
    sources,
    log_depth,
    usable,
    radius,
    max_bias,
    bias_penalty,
    diagonal,
    depth_penalty,
    distance_penalty,
    number,
    max_reach,
    seed,
    before,
    field,
    cost,
    shift,
):
    """Pass `number` over the queries from `begin` to `end`; `before` is the field of the one
    before."""
    num_sources, H, W = usable.shape
    h, w = query_at.shape
    penalties = (diagonal, depth_penalty, distance_penalty)
    bias = np.empty(3, np.float32)
    for i in range(begin, end):
        y, x = queries[i, 0], queries[i, 1]
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
            prior = _prior(expected[i] - log_depth[s, sy, sx], sy - y, sx - x, *penalties)
            if prior >= best:
                continue
            proposed = prior + _patch_cost(
                image, weight, y, x, sources, s, sy, sx, radius, max_bias, bias_penalty, bias
            )
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
