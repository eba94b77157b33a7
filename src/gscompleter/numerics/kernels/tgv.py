"""Total generalized variation of second order: surfaces as planar as the data allow."""

import numpy as np

from gscompleter.numerics.kernels.cache import njit
from gscompleter.numerics.kernels.parallel import count_threads, run_calls, split_range

PRIMAL_STEP = np.float32(0.25)
GRADIENT_STEP = np.float32(0.2)
DUAL_STEP = np.float32(1 / 3)
GRADIENT_DUAL_STEP = np.float32(0.5)
"""Steps of heights, gradients and the duals of both: inverse sums of absolute values in the columns
of the operator for the first two, in its rows for the duals (Pock and Chambolle 2011)."""
ITERATIONS_PER_PASS = 10
"""Iterations per pass over the image, each one row behind the last, with rows in the cache."""
MIN_BAND_ROWS = 4 * ITERATIONS_PER_PASS
"""Smallest number of rows in the band of a thread; the seams take up to half as many."""


def fit(heights, gradients, data, weight, across, down, bend, tolerance, iterations, threads=None):
    """Fit heights u and their gradients v in place by the first-order primal-dual algorithm.

        min sum weight * huber(u - data) + across |u_x - v_x| + down |u_y - v_y| + bend |grad v|

    Each thread has a band of rows. An iteration reads one row beyond those it writes, so each
    covers fewer rows of the band than the one before; the seams follow. The result is the same to
    the bit.

    All arrays and numbers are float32, heights in any one unit, and `iterations` an int.
    heights [h, w], gradients [2, h, w] (x, y): initial values, which the result replaces.
    data, weight [h, w]: measured heights and their weights; 0 without measurement.
    across, down [h, w]: cost of a step to the right and to the pixel below.
    bend: cost of a change of gradient, above 0. tolerance: deviation from `data` up to which the
    loss is quadratic, in the unit of heights, above 0.
    """
    h, w = heights.shape
    forces = np.zeros((2, h, w), np.float32), np.zeros((4, h, w), np.float32)
    state = heights, gradients, heights.copy(), gradients.copy(), *forces
    given = data, weight, across, down, bend, tolerance
    bands = split_range(h, min(count_threads(threads), h // MIN_BAND_ROWS))
    if len(bands) == 1:
        advance(0, 0, h, 0, iterations, state, given)
        return
    for begin in range(0, iterations, ITERATIONS_PER_PASS):
        count = min(ITERATIONS_PER_PASS, iterations - begin)
        inner = [(top, int(top > 0), end, -int(end < h)) for top, end in bands]
        seams = [(top, -1, top, 1) for top, _ in bands[1:]]
        for parts in (inner, seams):
            run_calls(advance, [(*part, count, state, given) for part in parts], threads)


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def advance(top, top_step, end, end_step, iterations, state, given):
    """Run iterations on a range of rows whose ends move by a step each time.

    Ends may not move in more than `ITERATIONS_PER_PASS` iterations. An end that moves away leaves
    its neighbour all the dual variables it needs, and one that moves towards it finds the same.
    """
    for begin in range(0, iterations, ITERATIONS_PER_PASS):
        count = min(ITERATIONS_PER_PASS, iterations - begin)
        # A wave over the rows: iteration `number` is `number` rows behind the front, so that a row
        # has what it needs of the iteration before, and stays in the cache.
        for front in range(top, end + 2 * count):
            for number in range(1, count + 1):
                y = front - number
                first = top + number * top_step
                last = end + number * end_step
                # Primals of a row need the duals of that row and of the one above. A band whose top
                # moves down raises those above its first row as well. The seam, which comes later,
                # finds these, and those above its own first row, which the upper band raised.
                if first - (top_step > 0) <= y < last - (end_step > 0):
                    _raise_duals(y, state, given)
                if first <= y < last:
                    _lower_primals(y, state, given)


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def _raise_duals(y, state, given):
    """Ascend the dual variables of a row and project them onto their bounds.

    `steps` belong to u_x - v_x and u_y - v_y, bounded by `across` and `down`; `bends` to the four
    derivatives of v, whose length together is bounded by `bend`.
    """
    _, _, ahead, gradients_ahead, steps, bends = state
    _, _, across, down, bend, _ = given
    h, w = ahead.shape
    one = np.float32(1)
    for x in range(w):
        b0, b1, b2, b3 = bends[0, y, x], bends[1, y, x], bends[2, y, x], bends[3, y, x]
        if x < w - 1:
            rise = ahead[y, x + 1] - ahead[y, x] - gradients_ahead[0, y, x]
            value = steps[0, y, x] + DUAL_STEP * rise
            steps[0, y, x] = min(max(value, -across[y, x]), across[y, x])
            b0 += GRADIENT_DUAL_STEP * (gradients_ahead[0, y, x + 1] - gradients_ahead[0, y, x])
            b2 += GRADIENT_DUAL_STEP * (gradients_ahead[1, y, x + 1] - gradients_ahead[1, y, x])
        if y < h - 1:
            rise = ahead[y + 1, x] - ahead[y, x] - gradients_ahead[1, y, x]
            value = steps[1, y, x] + DUAL_STEP * rise
            steps[1, y, x] = min(max(value, -down[y, x]), down[y, x])
            b1 += GRADIENT_DUAL_STEP * (gradients_ahead[0, y + 1, x] - gradients_ahead[0, y, x])
            b3 += GRADIENT_DUAL_STEP * (gradients_ahead[1, y + 1, x] - gradients_ahead[1, y, x])
        length = np.sqrt(b0 * b0 + b1 * b1 + b2 * b2 + b3 * b3)
        shorter = one / max(one, length / bend)
        bends[0, y, x], bends[1, y, x] = b0 * shorter, b1 * shorter
        bends[2, y, x], bends[3, y, x] = b2 * shorter, b3 * shorter


@njit(nogil=True, fastmath={"contract"}, error_model="numpy")
def _lower_primals(y, state, given):
    """Descend heights and gradients of a row, and extrapolate both for the next dual step."""
    heights, gradients, ahead, gradients_ahead, steps, bends = state
    data, weight, _, _, _, tolerance = given
    two = np.float32(2)
    none = np.float32(0)
    for x in range(heights.shape[1]):
        # Divergence of the duals, against which the gradient of the energy points, with nothing
        # beyond the border.
        push = steps[0, y, x] + steps[1, y, x]
        turn0 = bends[0, y, x] + bends[1, y, x]
        turn1 = bends[2, y, x] + bends[3, y, x]
        if x > 0:
            push -= steps[0, y, x - 1]
            turn0 -= bends[0, y, x - 1]
            turn1 -= bends[2, y, x - 1]
        if y > 0:
            push -= steps[1, y - 1, x]
            turn0 -= bends[1, y - 1, x]
            turn1 -= bends[3, y - 1, x]
        before = heights[y, x]
        pull = PRIMAL_STEP * weight[y, x]
        miss = before + PRIMAL_STEP * push - data[y, x]
        # Proximal step of the Huber loss: shrinking near the data, a constant pull farther off.
        if abs(miss) <= pull + tolerance:
            miss *= tolerance / (tolerance + pull)
        else:
            miss -= pull if miss > none else -pull
        heights[y, x] = data[y, x] + miss
        ahead[y, x] = two * heights[y, x] - before
        v0 = gradients[0, y, x]
        v1 = gradients[1, y, x]
        gradients[0, y, x] = v0 + GRADIENT_STEP * (steps[0, y, x] + turn0)
        gradients[1, y, x] = v1 + GRADIENT_STEP * (steps[1, y, x] + turn1)
        gradients_ahead[0, y, x] = two * gradients[0, y, x] - v0
        gradients_ahead[1, y, x] = two * gradients[1, y, x] - v1
