"""The lists of the tiles, by compiled loops and by plain sorting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gscompleter.numerics.kernels import tiles
from gscompleter.numerics.kernels.project import DEPTH, NUM_SPLAT_COLUMNS
from gscompleter.numerics.kernels.simd import TILE
from gscompleter.render.cpu import CpuRenderer, make_pinhole
from gscompleter.render.viewpoint import Splats, Viewpoint, order_by_use
from scenes import camera_at, random_gaussians, unchecked

RANDOM = np.random.default_rng(0)


def some_splats(n: int, size: int) -> Splats:
    """Make boxes anywhere in an image, some of them empty, at depths of which many are equal."""
    columns = RANDOM.random((n, NUM_SPLAT_COLUMNS), np.float32)
    columns[:, DEPTH] = RANDOM.integers(1, 60, n) / np.float32(7)
    low, high = np.sort(RANDOM.integers(0, size + 1, (2, n, 2)), axis=0)
    boxes = np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1).astype(np.int16)
    empty = (low >= high).any(axis=1)
    boxes[empty] = 0
    return Splats(columns, RANDOM.random(n, np.float32), boxes)


def expected_list(splats: Splats, tile: int, tiles_x: int, limit: float) -> list[int]:
    """Sort the splats that touch a tile up to a depth, stably."""
    left, top = TILE * (tile % tiles_x), TILE * (tile // tiles_x)
    x_from, x_to, y_from, y_to = splats.boxes.astype(int).T
    inside = (x_from < left + TILE) & (x_to > left) & (y_from < top + TILE) & (y_to > top)
    depths = splats.columns[:, DEPTH]
    found = np.flatnonzero(inside & (x_from < x_to) & (depths <= limit))
    return found[np.argsort(depths[found], kind="stable")].tolist()


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("n", [0, 1, 700])
def test_a_list_has_what_touches_its_tile_front_to_back(n, threads):
    size = 40
    viewpoint, splats = Viewpoint(make_pinhole(camera_at(size=size)), threads), some_splats(n, size)
    limits = RANDOM.choice([np.inf, 4.0, -np.inf], viewpoint.tiles).astype(np.float32)
    layer = viewpoint.fill_lists(splats, limits)
    for tile in range(viewpoint.tiles):
        found = layer.entries[layer.tile_start[tile] : layer.tile_start[tile + 1]].tolist()
        assert found == expected_list(splats, tile, viewpoint.tiles_x, limits[tile])


def test_slots_number_the_entries_splat_by_splat():
    entries = RANDOM.integers(0, 50, 300).astype(np.int32)
    slots, starts = tiles.number_slots(entries, 51)
    assert np.array_equal(starts, np.searchsorted(np.sort(entries), np.arange(52)))
    assert np.array_equal(np.argsort(slots), np.argsort(entries, kind="stable"))


def test_splats_in_the_order_of_their_use_are_the_same():
    viewpoint, splats = Viewpoint(make_pinhole(camera_at(size=40)), 2), some_splats(300, 40)
    layer = viewpoint.fill_lists(splats, np.full(viewpoint.tiles, np.inf, np.float32))
    ordered, order = order_by_use(layer)
    assert np.array_equal(order[ordered.entries], layer.entries)
    assert len(order) == len(np.unique(layer.entries))
    first = np.unique(ordered.entries, return_index=True)[1]
    assert (np.diff(first) > 0).all()
    for after, before in zip(ordered[:3], layer[:3], strict=True):
        assert np.array_equal(after, before[order])


@pytest.mark.slow
def test_an_image_too_wide_for_small_boxes_is_drawn_like_its_part():
    gaussians, camera = random_gaussians(40, sh_degree=0), camera_at(size=32)
    gaussians = replace(gaussians, opacities=torch.full((40,), 0.9))
    # Wider than a photograph may be.
    wide = unchecked(camera, width=np.iinfo(np.int16).max + TILE)
    part, whole = (CpuRenderer().freeze(gaussians, c) for c in (camera, wide))
    assert part.layer.boxes.dtype == np.int16
    assert whole.layer.boxes.dtype == np.int32
    assert torch.allclose(whole.render.image[:, :32], part.render.image, atol=2e-3)
