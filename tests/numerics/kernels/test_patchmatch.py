"""The patch kernels agree with plain numpy."""

import numpy as np
import pytest

from gscompleter.generators.patch_rounds import compute_likelihood
from gscompleter.numerics.kernels import patchmatch
from gscompleter.numerics.kernels.patchmatch import PATCHMATCH_RADIUS, PATCHMATCH_SIDE

H, W = 20, 26
COSTS = patchmatch.Costs(*map(np.float32, (0.1, 0.3, 0.02, 0.002, 30.0)))


def matched(seed=0):
    """Make a noisy image with a hole at its corner, and two sources."""
    rng = np.random.default_rng(seed)
    image = rng.random((H, W, 3), np.float32)
    weight = rng.random((H, W), np.float32)
    near = np.zeros((H, W), bool)
    near[:9, 15:] = True
    queries = np.argwhere(near)
    query_at = np.full((H, W), -1)
    query_at[near] = np.arange(len(queries))
    inside = np.pad(
        np.ones((2, H - 2 * PATCHMATCH_RADIUS, W - 2 * PATCHMATCH_RADIUS), bool),
        ((0, 0), (3, 3), (3, 3)),
    )
    padded = np.pad(weight, PATCHMATCH_RADIUS)
    total = [padded[y : y + PATCHMATCH_SIDE, x : x + PATCHMATCH_SIDE].sum() for y, x in queries]
    sources = rng.random((2, H, W, 3), np.float32)
    return image, patchmatch.PatchProblem(
        patchmatch.pad_border(image),
        patchmatch.pad_border(np.repeat(weight[..., None], 3, axis=-1)),
        np.array(total, np.float32),
        queries,
        query_at,
        rng.random(len(queries), np.float32),
        patchmatch.pad_column(sources),
        inside,
        rng.random((2, H, W), np.float32),
    )


def at_random(found, seed=1):
    """Make a random usable match for each query."""
    usable = np.argwhere(found.usable_mask)
    rows = np.random.default_rng(seed).integers(len(usable), size=len(found.queries))
    return np.ascontiguousarray(usable[rows])


def plain_cost(found, number, match):
    """Compute the cost of a match and its shift, pixel by pixel in float64."""
    y, x = found.queries[number]
    s, sy, sx = match
    here = np.s_[y : y + PATCHMATCH_SIDE, x : x + PATCHMATCH_SIDE]
    there = np.s_[
        s,
        sy - PATCHMATCH_RADIUS : sy + PATCHMATCH_RADIUS + 1,
        sx - PATCHMATCH_RADIUS : sx + PATCHMATCH_RADIUS + 1,
    ]
    weight = found.weight[here].astype(float)
    error = found.image[here].astype(float) - found.sources[there]
    mean = (weight * error).sum(axis=(0, 1)) / weight[..., 0].sum()
    bias = mean.clip(-COSTS.max_bias, COSTS.max_bias)
    cost = (weight * (error - bias) ** 2).sum() / weight[..., 0].sum()
    nearer = max(found.expected_log_depth[number] - found.log_depth[s, sy, sx], 0)
    away = np.hypot(sy - y, sx - x) / COSTS.diagonal
    prior = COSTS.depth_penalty * min(nearer**2, 1) + COSTS.distance_penalty * min(away, 1)
    return cost + COSTS.bias_penalty * (bias**2).sum() + prior, bias


def test_a_match_costs_what_its_pixels_differ_by_after_the_best_shift():
    _, found = matched()
    field = at_random(found)
    cost, shift = patchmatch.search(found, COSTS, field, 8, seed=3)
    plain = [plain_cost(found, number, match) for number, match in enumerate(field)]
    assert cost == pytest.approx(np.array([c for c, _ in plain]), rel=1e-5)
    assert np.abs(shift - np.array([b for _, b in plain])).max() < 1e-6


def test_a_search_only_improves_matches_and_keeps_them_usable():
    _, found = matched()
    before = at_random(found)
    field = before.copy()
    cost, _ = patchmatch.search(found, COSTS, field, 8, seed=3)
    begun = np.array([plain_cost(found, n, match)[0] for n, match in enumerate(before)])
    assert (cost <= begun * (1 + 1e-5)).all()
    assert (cost < 0.99 * begun).mean() > 0.5
    assert found.usable_mask[tuple(field.T)].all()


def test_a_patch_that_lies_in_a_source_is_found():
    image, found = matched()
    sources = found.sources.copy()
    sources[1, :, :W] = image
    found = found._replace(sources=sources)
    field = at_random(found)
    inner = (found.queries >= PATCHMATCH_RADIUS).all(axis=1) & (
        found.queries[:, 1] < W - PATCHMATCH_RADIUS
    )
    for seed in range(12):
        patchmatch.search(found, COSTS, field, 26, seed)
    same = (field[:, 0] == 1) & (field[:, 1:] == found.queries).all(axis=1)
    assert same[inner].all()


def test_a_pixel_is_the_mean_of_what_all_patches_over_it_say():
    _, found = matched()
    field = at_random(found)
    rng = np.random.default_rng(5)
    trust = rng.random(len(field), np.float32)
    shift = rng.random((len(field), 3), np.float32)
    colours, totals = np.zeros((H, W, 3)), np.zeros((H, W))
    for (y, x), (s, sy, sx), a, b in zip(found.queries, field, trust, shift, strict=True):
        for dy in range(-PATCHMATCH_RADIUS, PATCHMATCH_RADIUS + 1):
            for dx in range(-PATCHMATCH_RADIUS, PATCHMATCH_RADIUS + 1):
                if 0 <= y + dy < H and 0 <= x + dx < W:
                    colours[y + dy, x + dx] += a * (found.sources[s, sy + dy, sx + dx] + b)
                    totals[y + dy, x + dx] += a
    voted = patchmatch.vote(found.query_at, trust, found.sources, field, shift)
    assert np.abs(voted[1] - totals).max() < 1e-5 * totals.max()
    where = totals > 0
    assert np.abs(voted[0][where] - colours[where] / totals[where][:, None]).max() < 1e-5
    assert not voted[0][~where].any()


def test_what_only_costly_patches_tell_of_is_still_their_mean():
    _, found = matched()
    field, shift = at_random(found), np.zeros((len(found.queries), 3), np.float32)
    corner = (found.queries[:, 0] <= PATCHMATCH_RADIUS) & (
        found.queries[:, 1] >= W - 1 - PATCHMATCH_RADIUS
    )
    votes = compute_likelihood(np.where(corner, np.float32(1), np.float32(1e-4)))
    colours = patchmatch.vote(found.query_at, votes, found.sources, field, shift)[0]
    alike = patchmatch.vote(found.query_at, np.ones_like(votes), found.sources, field, shift)[0]
    assert np.abs(colours[0, -1] - alike[0, -1]).max() < 1e-4 < alike[0, -1].max()
    assert votes[~corner].min() > 1e3 * votes[corner].max()
