"""Splat lists of the tiles, front to back, and sums of gradients over their entries.

`splats` and `boxes` are those of `project.project_splats`, and `tiles_x` is the number of tiles in
a row. The list of tile t is entries[tile_start[t]:tile_start[t + 1]], numbers of splats.
"""

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.project import DEPTH
from gscompleter.numerics.kernels.simd import TILE

TILE_SHIFT = 4
"""Binary logarithm of `TILE`."""


@njit(nogil=True)
def count_entries(begin, end, splats, boxes, depth_limits, tiles_x, counts):
    """Add to `counts` [tiles] int32 how many of the splats begin..end are in the list of each tile.

    They are those whose boxes touch it, but for splats behind its depth limit.
    depth_limits [tiles] float32: depth behind which nothing is visible in a tile.
    """
    for i in range(begin, end):
        for tile_y in range(boxes[i, 2] >> TILE_SHIFT, (boxes[i, 3] + TILE - 1) >> TILE_SHIFT):
            left, right = boxes[i, 0] >> TILE_SHIFT, (boxes[i, 1] + TILE - 1) >> TILE_SHIFT
            for tile in range(tile_y * tiles_x + left, tile_y * tiles_x + right):
                if splats[i, DEPTH] <= depth_limits[tile]:
                    counts[tile] += 1


def counts_to_offsets(counts):
    """Turn counts [chunks, tiles] into offsets in place, and return `tile_start` [tiles + 1]."""
    # Tile by tile and, within a tile, chunk by chunk: so a list keeps the order of the Gaussians.
    ends = np.cumsum(counts.T, dtype=np.int64).reshape(counts.T.shape)
    starts = ends - counts.T
    counts[:] = starts.T
    return np.append(starts[:, 0], ends[-1, -1])


@njit(nogil=True)
def fill_entries(begin, end, splats, boxes, depth_limits, tiles_x, places, entries, keys):
    """Enter the splats begin..end into the lists of the tiles; see `count_entries`.

    places [tiles] int32: next free entry of each tile for these splats, counted up.
    entries, keys [e]: receive the index of the splat, int32, and the bits of its depth, uint32.
    """
    for i in range(begin, end):
        for tile_y in range(boxes[i, 2] >> TILE_SHIFT, (boxes[i, 3] + TILE - 1) >> TILE_SHIFT):
            left, right = boxes[i, 0] >> TILE_SHIFT, (boxes[i, 1] + TILE - 1) >> TILE_SHIFT
            for tile in range(tile_y * tiles_x + left, tile_y * tiles_x + right):
                if splats[i, DEPTH] <= depth_limits[tile]:
                    place = places[tile]
                    places[tile] = place + 1
                    entries[place], keys[place] = i, np.float32(splats[i, DEPTH]).view(np.uint32)


@njit(nogil=True)
def sort_lists(begin, end, tile_start, entries, keys):
    """Sort the lists of the tiles begin..end front to back, by a stable radix sort of depths."""
    largest = 0
    for tile in range(begin, end):
        largest = max(largest, tile_start[tile + 1] - tile_start[tile])
    spare_entries = np.empty(largest, np.int32)
    spare_keys = np.empty(largest, np.uint32)
    places = np.empty((4, 256), np.int64)
    for tile in range(begin, end):
        start, stop = tile_start[tile], tile_start[tile + 1]
        size = stop - start
        own_entries = entries[start:stop]
        own_keys = keys[start:stop]
        # Positive floats sort like their bits. One pass counts the digits of all four steps.
        places[:] = 0
        for k in range(size):
            for step in range(4):
                places[step, (own_keys[k] >> np.uint32(8 * step)) & np.uint32(255)] += 1
        for step in range(4):
            shift = np.uint32(8 * step)
            place = 0
            most = 0
            for digit in range(256):
                count = places[step, digit]
                most = max(most, count)
                places[step, digit] = place
                place += count
            # All keys have this digit, as depths in a tile are alike in their upper bits.
            if most == size:
                continue
            for k in range(size):
                digit = (own_keys[k] >> shift) & np.uint32(255)
                place = places[step, digit]
                places[step, digit] = place + 1
                spare_entries[place], spare_keys[place] = own_entries[k], own_keys[k]
            for k in range(size):
                own_entries[k], own_keys[k] = spare_entries[k], spare_keys[k]


@njit(nogil=True)
def number_slots(entries, count):
    """Assign slots to the entries [e] so that the gradients of a splat are adjacent.

    Returns the slot of each entry [e] int32, and the first slot of each of the `count` splats, with
    the end of the last one [count + 1] int64.
    """
    slot_start = np.zeros(count + 1, np.int64)
    for place in range(len(entries)):
        slot_start[entries[place] + 1] += 1
    # Counts become starts.
    slot = 0
    for i in range(count + 1):
        slot += slot_start[i]
        slot_start[i] = slot
    slots = np.empty_like(entries)
    taken = slot_start.copy()
    for place in range(len(entries)):
        i = entries[place]
        slots[place] = taken[i]
        taken[i] += 1
    return slots, slot_start


@njit(nogil=True)
def number_by_use(entries, count):
    """Renumber the splats of `entries` by their first use.

    Returns the used splats in their new order, and the entries with the new numbers.
    """
    numbers = np.full(count, -1, np.int32)
    order = np.empty(count, np.int32)
    renamed = np.empty_like(entries)
    used = 0
    for place in range(len(entries)):
        i = entries[place]
        if numbers[i] < 0:
            numbers[i] = used
            order[used] = i
            used += 1
        renamed[place] = numbers[i]
    return order[:used], renamed


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def sum_entries(begin, end, slot_start, gradients, written, totals):
    """Sum the gradients of all entries of each of the splats begin..end into `totals` [n, c].

    gradients [slots, c] float32: those of splat i are in the slots from slot_start[i] to
    slot_start[i + 1], and count where written [slots] is True.
    """
    for i in range(begin, end):
        for column in range(gradients.shape[1]):
            totals[i, column] = np.float32(0)
        for slot in range(slot_start[i], slot_start[i + 1]):
            if written[slot]:
                for column in range(gradients.shape[1]):
                    totals[i, column] += gradients[slot, column]
