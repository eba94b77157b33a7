"""The lists of the tiles: which splats touch them, front to back, and what is summed along them.

Like those of `rasterizer`, every kernel works on a range (begin, end) of its elements and writes to
its own part of the outputs.
"""

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from gscompleter.kernels.rasterizer import DEPTH, NUM_SPLAT_COLUMNS, TILE

TILE_SHIFT = 4
"""Logarithm of `TILE`: pixels shifted right by so many bits are tiles."""


# ---- From splats to lists ------------------------------------------------------------------------


@intrinsic
def _bits_of(typing, value):
    """The bits of a float32 as an unsigned integer; for positive numbers they sort alike."""
    return types.uint32(
        types.float32
    ), lambda context, builder, signature, arguments: builder.bitcast(arguments[0], ir.IntType(32))


@njit(cache=True, nogil=True)
def count_entries(begin, end, splats, boxes, depth_limits, tiles_x, counts):
    """Count how many of the splats begin..end touch each tile.

    depth_limits [tiles] float32: behind it, nothing is seen in the tile.
    counts [tiles] int32 is added to.
    """
    for i in range(begin, end):
        for tile_y in range(boxes[i, 2] >> TILE_SHIFT, (boxes[i, 3] + TILE - 1) >> TILE_SHIFT):
            left, right = boxes[i, 0] >> TILE_SHIFT, (boxes[i, 1] + TILE - 1) >> TILE_SHIFT
            for tile in range(tile_y * tiles_x + left, tile_y * tiles_x + right):
                if splats[i, DEPTH] <= depth_limits[tile]:
                    counts[tile] += 1


@njit(cache=True, nogil=True)
def places_of(counts):
    """Turn counts into places: `counts` [chunks, tiles] becomes where each chunk's part of each
    list starts; returns where the lists start [tiles + 1] int64."""
    chunks, tiles = counts.shape
    tile_start = np.empty(tiles + 1, np.int64)
    place = 0
    for tile in range(tiles):
        tile_start[tile] = place
        for chunk in range(chunks):
            size = counts[chunk, tile]
            counts[chunk, tile] = place
            place += size
    tile_start[tiles] = place
    return tile_start


@njit(cache=True, nogil=True)
def fill_entries(begin, end, splats, boxes, depth_limits, tiles_x, places, entries, keys):
    """Enter the splats begin..end into the lists of the tiles they touch.

    The first arguments are those of `count_entries`.
    places [tiles] int32: where the next entry of each tile goes; counted up.
    entries [e] int32 receives the index of the splat, and keys [e] uint32 the bits of its depth.
    """
    for i in range(begin, end):
        for tile_y in range(boxes[i, 2] >> TILE_SHIFT, (boxes[i, 3] + TILE - 1) >> TILE_SHIFT):
            left, right = boxes[i, 0] >> TILE_SHIFT, (boxes[i, 1] + TILE - 1) >> TILE_SHIFT
            for tile in range(tile_y * tiles_x + left, tile_y * tiles_x + right):
                if splats[i, DEPTH] <= depth_limits[tile]:
                    place = places[tile]
                    places[tile] = place + 1
                    entries[place], keys[place] = i, _bits_of(splats[i, DEPTH])


@njit(cache=True, nogil=True)
def sort_lists(begin, end, tile_start, entries, keys):
    """Sort the lists of the tiles begin..end front to back; of equals the first stays first.

    A radix sort of the depths' bits, 8 at a time, without those in which all are alike. The near
    plane keeps depths positive. A list and its keys fit into the cache, all together do not.
    """
    largest = 0
    for tile in range(begin, end):
        largest = max(largest, tile_start[tile + 1] - tile_start[tile])
    spare_entries, spare_keys = np.empty(largest, np.int32), np.empty(largest, np.uint32)
    places = np.empty((4, 256), np.int64)
    for tile in range(begin, end):
        start, stop = tile_start[tile], tile_start[tile + 1]
        size = stop - start
        own_entries, own_keys = entries[start:stop], keys[start:stop]
        places[:] = 0
        for k in range(size):
            for step in range(4):
                places[step, (own_keys[k] >> np.uint32(8 * step)) & np.uint32(255)] += 1
        for step in range(4):
            shift, place, most = np.uint32(8 * step), 0, 0
            for digit in range(256):
                count = places[step, digit]
                most = max(most, count)
                places[step, digit] = place
                place += count
            if most == size:
                continue
            for k in range(size):
                digit = (own_keys[k] >> shift) & np.uint32(255)
                place = places[step, digit]
                places[step, digit] = place + 1
                spare_entries[place], spare_keys[place] = own_entries[k], own_keys[k]
            for k in range(size):
                own_entries[k], own_keys[k] = spare_entries[k], spare_keys[k]


# ---- From lists to splats ------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def number_slots(entries, count):
    """Number the entries [e] int32 splat by splat, so that the gradients of each of the splats
    0..count lie together whatever tiles they come from.

    Returns the number of each entry [e] int32, and where those of each splat start [count + 1]
    int64.
    """
    slot_start = np.zeros(count + 1, np.int64)
    for place in range(len(entries)):
        slot_start[entries[place] + 1] += 1
    slot = 0
    for i in range(count + 1):
        slot += slot_start[i]
        slot_start[i] = slot
    slots, taken = np.empty_like(entries), slot_start.copy()
    for place in range(len(entries)):
        i = entries[place]
        slots[place] = taken[i]
        taken[i] += 1
    return slots, slot_start


@njit(cache=True, nogil=True)
def number_by_use(entries, count):
    """The splats 0..count that are named by `entries` [e] int32, in the order in which they are
    named first [m] int32, and the entries as places in that order [e] int32."""
    numbers = np.full(count, -1, np.int32)
    order, renamed = np.empty(count, np.int32), np.empty_like(entries)
    used = 0
    for place in range(len(entries)):
        i = entries[place]
        if numbers[i] < 0:
            numbers[i] = used
            order[used] = i
            used += 1
        renamed[place] = numbers[i]
    return order[:used], renamed


@njit(cache=True, nogil=True)
def take_splats(begin, end, rows, splats, opacities, boxes, taken):
    """Copy splats of these rows to the places begin..end; the caller gives what holds them.

    rows [m] int32. taken: splats [m, 9], opacities [m] and boxes [m, 4] to write.
    """
    to_splats, to_opacities, to_boxes = taken
    for place in range(begin, end):
        i = rows[place]
        for column in range(NUM_SPLAT_COLUMNS):
            to_splats[place, column] = splats[i, column]
        to_opacities[place] = opacities[i]
        for side in range(4):
            to_boxes[place, side] = boxes[i, side]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def sum_entries(begin, end, slot_start, gradients, written, totals):
    """Sums of the gradients of the entries of each of the Gaussians begin..end.

    gradients [slots, c] float32, where written [slots]: the slots from slot_start[i] to
        slot_start[i + 1] belong to Gaussian i.
    totals [n, c] float32 is written.
    """
    for i in range(begin, end):
        for column in range(gradients.shape[1]):
            totals[i, column] = np.float32(0)
        for slot in range(slot_start[i], slot_start[i + 1]):
            if written[slot]:
                for column in range(gradients.shape[1]):
                    totals[i, column] += gradients[slot, column]


@njit(cache=True, nogil=True, fastmath={"contract"})
def sum_by_name(begin, end, entries, rows, gradients, written, totals):
    """Sums of the gradients of all entries that name each of the splats begin..end.

    entries [e] int32: the splat of each entry. gradients [e, c] float32, where written [e].
    rows [splats] int32: the Gaussian of each splat. totals [n, c] float32 is added to.
    """
    for place in range(len(entries)):
        i = entries[place]
        if begin <= i < end and written[place]:
            for column in range(gradients.shape[1]):
                totals[rows[i], column] += gradients[place, column]
