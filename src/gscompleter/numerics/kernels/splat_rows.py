"""Rows of a 3DGS .ply from and to the arrays of Gaussians, in one pass over each row.

Arrays are float32 unless stated otherwise. In a file, scales are logarithms and opacities logits;
both are computed in float64, so that what a file holds survives a round trip.
"""

import math

import numpy as np

from gscompleter.numerics.kernels.cache import njit

TINY = np.float64(np.finfo(np.float32).tiny)
"""Smallest scale whose logarithm is written."""
LARGEST_OPACITY = 1 - 2**-24
"""The largest float32 below 1 has a logit of 16.6; a larger one could not be read back."""
MIN_LOGIT = -30.0
"""Logit that is written for an opacity of 0."""


@njit(nogil=True, error_model="numpy")
def decode_rows(begin, end, first, table, columns, means, quats, scales, opacities, sh, encoded):
    """Decode the rows begin..end of `table` [rows, c] to the Gaussians that start at `first`.

    `columns` [14 + r] are the columns of `table` with position, constant harmonics, the r others
    (all of red, then green, then blue), opacity, three scales and the rotation. `sh` is [n, k, 3],
    `encoded` [n, 4] has log-scales and logits.
    """
    num_rest = sh.shape[1] - 1
    last = 6 + 3 * num_rest
    for row in range(begin, end):
        i = first + row
        for axis in range(3):
            means[i, axis] = table[row, columns[axis]]
            sh[i, 0, axis] = table[row, columns[3 + axis]]
            for k in range(num_rest):
                sh[i, 1 + k, axis] = table[row, columns[6 + axis * num_rest + k]]
            encoded[i, axis] = table[row, columns[last + 1 + axis]]
            scales[i, axis] = _decode_scale(encoded[i, axis])
        encoded[i, 3] = table[row, columns[last]]
        opacities[i] = _decode_opacity(encoded[i, 3])
        for part in range(4):
            quats[i, part] = table[row, columns[last + 4 + part]]


@njit(nogil=True, error_model="numpy")
def encode_values(begin, end, scales, opacities, encoded, written):
    """Write log-scales and logits of the Gaussians begin..end to `written` [n, 4].

    Those in `encoded` [n, 4], which may be empty, are kept where they still decode to the values.
    """
    for i in range(begin, end):
        _encode_value(i, scales, opacities, encoded, written, i)


@njit(nogil=True, error_model="numpy")
def encode_rows(begin, end, first, means, quats, scales, opacities, sh, encoded, table):
    """Encode the Gaussians from `first` on as the rows begin..end of `table` [rows, 17 + r].

    Its columns are those of 3DGS: position, normal (zeros), constant harmonics, the r others,
    opacity, three scales and the rotation. `encoded` is as in `encode_values`.
    """
    num_rest = sh.shape[1] - 1
    last = 9 + 3 * num_rest
    values = np.empty((1, 4), np.float32)
    for row in range(begin, end):
        i = first + row
        _encode_value(i, scales, opacities, encoded, values, 0)
        for axis in range(3):
            table[row, axis] = means[i, axis]
            table[row, 3 + axis] = np.float32(0)
            table[row, 6 + axis] = sh[i, 0, axis]
            for k in range(num_rest):
                table[row, 9 + axis * num_rest + k] = sh[i, 1 + k, axis]
            table[row, last + 1 + axis] = values[0, axis]
        table[row, last] = values[0, 3]
        for part in range(4):
            table[row, last + 4 + part] = quats[i, part]


@njit(nogil=True, error_model="numpy")
def mark_usable(
    begin, end, means, quats, scales, opacities, sh, largest, largest_sh, shortest, good
):
    """Mark in `good` [n] the Gaussians whose numbers are finite and within the bounds.

    `sh` is [n, 3 k], `largest_sh` its bound, and `shortest` the smallest length of a quaternion.
    Comparisons with NaN are False.
    """
    for i in range(begin, end):
        inside = abs(opacities[i]) <= largest
        for axis in range(3):
            inside &= abs(means[i, axis]) <= largest
            inside &= abs(scales[i, axis]) <= largest
        square = np.float32(0)
        for part in range(4):
            inside &= abs(quats[i, part]) <= largest
            square += quats[i, part] * quats[i, part]
        inside &= square >= shortest * shortest
        for k in range(sh.shape[1]):
            inside &= abs(sh[i, k]) <= largest_sh
        good[i] = inside


@njit()
def _decode_scale(value):
    return np.float32(math.exp(np.float64(value)))


@njit(error_model="numpy")
def _decode_opacity(value):
    return np.float32(1 / (1 + math.exp(-np.float64(value))))


@njit(error_model="numpy")
def _encode_value(i, scales, opacities, encoded, written, row):
    has_encoded = len(encoded) > 0
    for axis in range(3):
        value = encoded[i, axis] if has_encoded else np.float32(np.nan)
        if not (math.isfinite(value) and _decode_scale(value) == scales[i, axis]):
            scale = np.float64(scales[i, axis])
            value = np.float32(math.log(TINY if scale < TINY else scale))
        written[row, axis] = value
    value = encoded[i, 3] if has_encoded else np.float32(np.nan)
    if not (math.isfinite(value) and _decode_opacity(value) == opacities[i]):
        opacity = min(max(np.float64(opacities[i]), 0.0), LARGEST_OPACITY)
        value = np.float32(max(math.log(opacity / (1 - opacity)), MIN_LOGIT))
    written[row, 3] = value


@njit(nogil=True)
def permute_rows(order, means, quats, scales, opacities, sh, encoded, seen):
    """Bring the Gaussian order[i] to row i, in place; `seen` [n] begins as False.

    All arrays are [n, c]. They are permuted together, since each step waits for the memory that
    says where the next row is.
    """
    for start in range(len(order)):
        # A permutation is a set of cycles. The first row of each goes along to its end.
        place = start
        while not seen[place]:
            seen[place] = True
            source = order[place]
            if source != start:
                _swap_rows(means, place, source)
                _swap_rows(quats, place, source)
                _swap_rows(scales, place, source)
                _swap_rows(opacities, place, source)
                _swap_rows(sh, place, source)
                _swap_rows(encoded, place, source)
                place = source


@njit(inline="always")
def _swap_rows(values, row, other):
    for column in range(values.shape[1]):
        held = values[row, column]
        values[row, column] = values[other, column]
        values[other, column] = held


@njit(inline="always")
def copy_row(source, source_row, target, target_row):
    """Copy a row of `source` [n, c] to a row of `target` [m, c].

    `target[i] = source[j]` also compiles the words of an error for rows of other lengths, which
    takes longer than all that its kernel does.
    """
    for column in range(target.shape[1]):
        target[target_row, column] = source[source_row, column]
