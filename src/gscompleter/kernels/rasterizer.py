"""Compiled tile rasteriser of 3D Gaussians, forward and backward, for CPUs.

Gaussians are projected to splats and entered into the lists of the 16 × 16 tiles that they touch,
front to back (`kernels/lists.py`). A row of a tile is one vector; LLVM does not find these vectors
itself, so the loops over rows are intrinsics in its intermediate language.

Two lists are merged by depth: the frozen `context`, and `new`, which gets gradients. If only the
appearance of new splats changes, the context is baked into their pixels once (`Fragments`).

Kernels work on a range (begin, end) of elements or on fragments, write to their own outputs and
release the interpreter lock. Results do not depend on how ranges are split among threads.

A splat's falloff is `alpha = opacity * exp(-(s² + t²))` with whitened coordinates
`s = u dx + v dy`, `t = w dy` of the offset (dx, dy) from its centre, and `U = [[u, v], [0, w]]`,
`UᵀU = ½ Σ⁻¹` for the 2D covariance Σ. Unlike Σ⁻¹ it does not cancel for thin oblique splats.
"""

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

TILE = 16
"""Side of a tile in pixels, and the number of lanes of a vector."""

FIRST_ROWS = 1 << 14
"""Initial number of rows for weights, enough for a tile full of small splats."""

BLUR = np.float32(0.3)
TANGENT_MARGIN = np.float32(0.15)
MIN_ALPHA = np.float32(1 / 255)
MAX_ALPHA = np.float32(0.999)
MIN_TRANSMITTANCE = np.float32(1e-4)
SOLID = np.float32(0.5)
"""Alpha above which frozen splats are not baked; bounds colour errors by
`MIN_TRANSMITTANCE / SOLID`."""

X, Y, U, V, W, DEPTH, RED, GREEN, BLUE = range(9)
"""Columns of the splats."""
NUM_SPLAT_COLUMNS = 9

SUM, SUM_S, SUM_T, SUM_SS, SUM_ST, SUM_TT, SUM_DEPTH, SUM_RED = range(8)
"""Gradient columns: sums of q = alpha dL/dalpha times 1, s, t, s², s t, t²; depth; colours."""
NUM_GRADIENT_COLUMNS = 10

WANT_ALL, WANT_OPACITY, WANT_DEPTH, WANT_COLOR = range(4)
"""Gradients to compute: all columns, or only SUM, SUM_DEPTH or the three colours."""


class Pinhole(NamedTuple):
    """A camera in the form that kernels read."""

    rotation: tuple[np.float32, ...]
    """Camera from world, nine numbers row by row."""
    center: np.ndarray
    """Camera centre in the world [3], float32."""
    intrinsics: np.ndarray
    """fx, fy, cx, cy in pixels [4], float32."""
    near: np.float32
    """Smallest z that is rendered."""
    width: int
    height: int


class GaussianArrays(NamedTuple):
    """Gaussians, or their gradients, all float32; see `gscompleter.types.Gaussians`."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


class Layer(NamedTuple):
    """Splats, and for each tile the list of those that touch it, front to back."""

    splats: np.ndarray
    """[n, 9] float32, columns X to BLUE."""
    opacities: np.ndarray
    boxes: np.ndarray
    """Pixels that a splat may touch: x from, x to, y from, y to (excluded) [n, 4], int16 or
    int32."""
    tile_start: np.ndarray
    """Start of the list of each tile [tiles + 1] int64."""
    entries: np.ndarray
    """Index of the splat [entries] int32."""


class RasterFrame(NamedTuple):
    """A rendered image, and the state that the backward pass needs."""

    image: np.ndarray
    depth: np.ndarray
    """z-depth [h, w] float32, 0 for empty pixels."""
    alpha: np.ndarray
    transmittance: np.ndarray
    """Transmittance behind the last contribution [h, w] float32."""
    last: np.ndarray
    """Position of the last contribution in the merged list of its tile, or -1 [h, w] int32."""
    used: np.ndarray
    """Entries of both lists that were composited until the tile was full [tiles, 2] int32."""
    full: np.ndarray
    """True for tiles without any transmittance left [tiles] bool."""


# ---- Vectors of 16 pixels in LLVM's intermediate representation ------------------------------

_FLOAT, _INT, _LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS = ir.VectorType(_FLOAT, TILE), ir.VectorType(_INT, TILE)

# Least squares polynomial of 2**x on [-1, 0], highest power first: relative error 2e-7.
_EXP2 = (0.000938116473, 0.00918687438, 0.055278135, 0.240171588, 0.693142171, 0.999999923)
_LOG2_E = 1.4426950408889634


class _Lanes:
    """Sixteen float32 values of a function under construction."""

    def __init__(self, builder, value):
        self.builder, self.value = builder, value

    def _unwrap(self, other):
        return other.value if isinstance(other, _Lanes) else _make_constant(other)

    def __add__(self, other):
        return _Lanes(self.builder, self.builder.fadd(self.value, self._unwrap(other)))

    def __sub__(self, other):
        return _Lanes(self.builder, self.builder.fsub(self.value, self._unwrap(other)))

    def __mul__(self, other):
        return _Lanes(self.builder, self.builder.fmul(self.value, self._unwrap(other)))

    def __rtruediv__(self, other):
        return _Lanes(self.builder, self.builder.fdiv(self._unwrap(other), self.value))

    def __rsub__(self, other):
        return _Lanes(self.builder, self.builder.fsub(self._unwrap(other), self.value))

    def multiply_add(self, factor, plus):
        """Compute self * factor + plus with a single rounding, the same in both passes."""
        multiply_add = cgutils.get_or_insert_function(
            self.builder.module,
            ir.FunctionType(_FLOATS, [_FLOATS, _FLOATS, _FLOATS]),
            f"llvm.fmuladd.v{TILE}f32",
        )
        arguments = [self.value, self._unwrap(factor), self._unwrap(plus)]
        return _Lanes(self.builder, self.builder.call(multiply_add, arguments))

    def compare(self, relation, other):
        """Compare lane by lane; False for NaN."""
        return self.builder.fcmp_ordered(relation, self.value, self._unwrap(other))

    def where(self, mask, otherwise):
        value = self.builder.select(mask, self.value, self._unwrap(otherwise))
        return _Lanes(self.builder, value)


def _sum_lanes(builder, vectors):
    """Sum the lanes of each of up to sixteen vectors into one lane of the result."""
    values = [vector.value for vector in vectors]
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    width = TILE
    while width > 1:
        half = width // 2
        low = [lane for lane in range(2 * TILE) if lane % width < half]
        high = [lane for lane in range(2 * TILE) if lane % width >= half]
        values += [undefined] * (len(values) % 2)
        values = [
            builder.fadd(
                builder.shuffle_vector(first, second, ir.Constant(_INTS, low)),
                builder.shuffle_vector(first, second, ir.Constant(_INTS, high)),
            )
            for first, second in zip(values[::2], values[1::2], strict=True)
        ]
        width = half
    return values[0]


def _make_constant(value):
    return ir.Constant(_FLOATS, [float(np.float32(value))] * TILE)


def _broadcast(builder, scalar, vector_type=_FLOATS):
    undefined = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_INTS, [0] * TILE))


def _exp_negative(values):
    """Compute exp(-values) for values >= 0; beyond 80 it is practically 0."""
    builder = values.builder
    power = values * -_LOG2_E
    power = power.where(power.compare(">", -120.0), -120.0)
    whole = builder.fptosi(power.value, _INTS)
    fraction = power - _Lanes(builder, builder.sitofp(whole, _FLOATS))
    polynomial = fraction.multiply_add(_EXP2[0], _EXP2[1])
    for coefficient in _EXP2[2:]:
        polynomial = polynomial.multiply_add(fraction, coefficient)
    # The exponent of a float starts at bit 23 and is 127 for 2**0.
    exponent = builder.add(whole, ir.Constant(_INTS, [127] * TILE))
    scale = builder.shl(exponent, ir.Constant(_INTS, [23] * TILE))
    return polynomial * _Lanes(builder, builder.bitcast(scale, _FLOATS))


class _Rows:
    """Rows of a tile's arrays, each of them several vectors."""

    def __init__(self, context, builder, array_type, array, vector_type, vectors_per_row):
        self.builder, self.vector_type = builder, vector_type
        self.data = context.make_array(array_type)(context, builder, array).data
        self.stride = vectors_per_row * TILE

    def _get_pointer(self, row, index):
        offset = self.builder.mul(row, ir.Constant(_LONG, self.stride))
        offset = self.builder.add(offset, ir.Constant(_LONG, index * TILE))
        pointer = self.builder.gep(self.data, [offset])
        return self.builder.bitcast(pointer, self.vector_type.as_pointer())

    def load(self, row, index):
        return self.builder.load(self._get_pointer(row, index), align=4)

    def store(self, row, index, value):
        self.builder.store(value, self._get_pointer(row, index), align=4)


class _Splat:
    """A splat relative to its tile, as the intrinsics receive it."""

    def __init__(self, builder, x, y, u, v, w, opacity, red, green, blue, depth):
        self.builder = builder
        self.y, self.v, self.w = y, v, w
        self.channels = [
            _Lanes(builder, _broadcast(builder, value)) for value in (red, green, blue, depth)
        ]
        lane_numbers = ir.Constant(_FLOATS, [float(lane) for lane in range(TILE)])
        self.dx = _Lanes(builder, builder.fsub(lane_numbers, _broadcast(builder, x)))
        self.u_dx = self.dx * _Lanes(builder, _broadcast(builder, u))
        self.opacity = _Lanes(builder, _broadcast(builder, opacity))

    def compute_falloff(self, row):
        """Return dy of a row, and alpha before and after capping, and its mask."""
        builder = self.builder
        dy = builder.fsub(builder.sitofp(row, _FLOAT), self.y)
        s = self.u_dx + _Lanes(builder, _broadcast(builder, builder.fmul(self.v, dy)))
        t = builder.fmul(self.w, dy)
        sigma = s.multiply_add(s, plus=_Lanes(builder, _broadcast(builder, builder.fmul(t, t))))
        raw = self.opacity * _exp_negative(sigma)
        capped = raw.where(raw.compare("<=", MAX_ALPHA), MAX_ALPHA)
        return dy, raw, capped, raw.compare(">=", MIN_ALPHA)


def _loop_over_rows(builder, rows, position, row_limit, body):
    """Run `body(row)` for the rows whose limit is not below `position`."""
    begin, end = rows
    with cgutils.for_range(builder, end, start=begin, intp=_LONG) as loop:
        limit = builder.load(builder.gep(row_limit, [loop.index]))
        with builder.if_then(builder.icmp_signed("<=", position, limit)):
            body(loop.index)


def _blend(splat, state, row):
    """Composite a splat over a row; return its weights, and masks of visible and passing lanes."""
    builder = splat.builder
    _, _, alpha, visible = splat.compute_falloff(row)
    alpha = alpha.where(visible, 0.0)
    before = _Lanes(builder, state.load(row, 0))
    after = alpha.multiply_add(0.0 - before, plus=before)
    passing = after.compare(">", MIN_TRANSMITTANCE)
    weight = (alpha * before).where(passing, 0.0)
    closed = before.where(before.compare("<", 0.0), 0.0 - before)
    state.store(row, 0, after.where(passing, closed).value)
    for index, channel in enumerate(splat.channels[: state.stride // TILE - 1], start=1):
        total = weight.multiply_add(channel, plus=_Lanes(builder, state.load(row, index)))
        state.store(row, index, total.value)
    return weight, visible, passing


def _close_if_full(builder, passing, limits, row, filled):
    """Set the limit of a row to -1 and count it once it has no transmittance left."""
    any_passing = builder.bitcast(passing, ir.IntType(TILE))
    none = builder.icmp_unsigned("==", any_passing, ir.Constant(ir.IntType(TILE), 0))
    with builder.if_then(none, likely=False):
        builder.store(ir.Constant(_INT, -1), builder.gep(limits, [row]))
        builder.store(builder.add(builder.load(filled), ir.Constant(_LONG, 1)), filled)


@intrinsic
def _composite_rows(typing, begin, end, position, state, last, row_limit, splat):
    """Composite a splat over the rows begin..end of a tile; return how many it filled.

    state [16, 5, 16]: per row the transmittance, negative in full pixels, and sums of colour and
    depth.
    last [16, 16] int32: position of the last contribution. row_limit [16] int32: -1 in full rows.
    splat: x and y relative to the first pixel centre, u, v, w, opacity, red, green, blue and depth.
    """
    signature = types.int64(types.int64, types.int64, types.int32, state, last, row_limit, splat)

    def generate(context, builder, signature, arguments):
        begin, end, position, state, last, row_limit, splat = arguments
        splat = _Splat(builder, *cgutils.unpack_tuple(builder, splat))
        state = _Rows(context, builder, signature.args[3], state, _FLOATS, 5)
        last = _Rows(context, builder, signature.args[4], last, _INTS, 1)
        limits = context.make_array(signature.args[5])(context, builder, row_limit).data
        positions = _broadcast(builder, position, _INTS)
        filled = cgutils.alloca_once_value(builder, ir.Constant(_LONG, 0))

        def composite_row(row):
            _, visible, passing = _blend(splat, state, row)
            contributes = builder.and_(visible, passing)
            last.store(row, 0, builder.select(contributes, positions, last.load(row, 0)))
            _close_if_full(builder, passing, limits, row, filled)

        _loop_over_rows(builder, (begin, end), position, limits, composite_row)
        return builder.load(filled)

    return signature, generate


@intrinsic
def _weigh_rows(typing, begin, end, place, state, row_limit, kept, splat):
    """Composite a splat, without depth, over rows and store its weights in `kept` at `place`."""
    signature = types.int64(types.int64, types.int64, types.int64, state, row_limit, kept, splat)

    def generate(context, builder, signature, arguments):
        begin, end, place, state, row_limit, kept, splat = arguments
        splat = _Splat(builder, *cgutils.unpack_tuple(builder, splat))
        state = _Rows(context, builder, signature.args[3], state, _FLOATS, 4)
        limits = context.make_array(signature.args[4])(context, builder, row_limit).data
        kept = _Rows(context, builder, signature.args[5], kept, _FLOATS, 1)
        filled = cgutils.alloca_once_value(builder, ir.Constant(_LONG, 0))
        with cgutils.for_range(builder, end, start=begin, intp=_LONG) as loop:
            row, at = loop.index, builder.add(place, builder.sub(loop.index, begin))
            limit = builder.load(builder.gep(limits, [row]))
            is_open = builder.icmp_signed(">=", limit, ir.Constant(_INT, 0))
            with builder.if_else(is_open) as (open_row, full_row):
                with open_row:
                    weight, _, passing = _blend(splat, state, row)
                    kept.store(at, 0, weight.value)
                    _close_if_full(builder, passing, limits, row, filled)
                with full_row:
                    kept.store(at, 0, _make_constant(0.0))
        return builder.load(filled)

    return signature, generate


@intrinsic
def _sum_weighted_rows(typing, begin, end, place, state, kept, sums):
    """Sum kept weights times the colours in `state` [16, 4, 16], and kept weights, to `sums`."""
    signature = types.void(types.int64, types.int64, types.int64, state, kept, sums)

    def generate(context, builder, signature, arguments):
        begin, end, place, state, kept, sums = arguments
        state = _Rows(context, builder, signature.args[3], state, _FLOATS, 4)
        kept = _Rows(context, builder, signature.args[4], kept, _FLOATS, 1)
        zeros = ir.Constant(_FLOATS, [0.0] * TILE)
        totals = [cgutils.alloca_once_value(builder, zeros) for _ in range(4)]
        with cgutils.for_range(builder, end, start=begin, intp=_LONG) as loop:
            at = builder.add(place, builder.sub(loop.index, begin))
            weight = _Lanes(builder, kept.load(at, 0))
            for index, total in enumerate(totals, start=1):
                value = _Lanes(builder, builder.load(total))
                if index < 4:
                    value = weight.multiply_add(
                        _Lanes(builder, state.load(loop.index, index)), plus=value
                    )
                else:
                    value = value + weight
                builder.store(value.value, total)
        out = _Rows(context, builder, signature.args[5], sums, _FLOATS, 1)
        columns = [_Lanes(builder, builder.load(total)) for total in totals]
        out.store(ir.Constant(_LONG, 0), 0, _sum_lanes(builder, columns))
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def _compute_falloffs(typing, row, falloffs, splat):
    """Write the uncapped alphas of a splat in a row to `falloffs` [16]; 0 if invisible."""
    signature = types.void(types.int64, falloffs, splat)

    def generate(context, builder, signature, arguments):
        row, falloffs, splat = arguments
        splat = _Splat(builder, *cgutils.unpack_tuple(builder, splat))
        out = _Rows(context, builder, signature.args[1], falloffs, _FLOATS, 1)
        _, raw, _, visible = splat.compute_falloff(row)
        out.store(ir.Constant(_LONG, 0), 0, raw.where(visible, 0.0).value)
        return context.get_dummy_value()

    return signature, generate


def _make_revert(wanted):
    """Make an intrinsic that reverts a splat, with sums for the `wanted` gradients."""

    @intrinsic
    def undraw_rows(typing, begin, end, position, state, last, row_limit, sums, splat):
        """Revert the rows begin..end of a splat, back to front.

        state [16, 7, 16]: per row the transmittance and the sum of weight times gradient behind the
        splat, and dL/d of red, green, blue, depth sum and alpha. sums [16] receives the sums of q,
        q dx, q dy, q dx², q dx dy, q dy² (q = alpha dL/dalpha), and of weight times dL/d depth,
        red, green and blue.
        """
        signature = types.void(
            types.int64, types.int64, types.int32, state, last, row_limit, sums, splat
        )

        def generate(context, builder, signature, arguments):
            begin, end, position, state, last, row_limit, sums, splat = arguments
            splat = _Splat(builder, *cgutils.unpack_tuple(builder, splat))
            state = _Rows(context, builder, signature.args[3], state, _FLOATS, 7)
            last = _Rows(context, builder, signature.args[4], last, _INTS, 1)
            limits = context.make_array(signature.args[5])(context, builder, row_limit).data
            positions = _broadcast(builder, position, _INTS)
            count = {"nothing": 0, "opacity": 1, "depth": 1, "colour": 3, "all": 7}[wanted]
            totals = [
                cgutils.alloca_once_value(builder, ir.Constant(_FLOATS, [0.0] * TILE))
                for _ in range(count)
            ]

            def revert(row):
                dy, raw, alpha, visible = splat.compute_falloff(row)
                reached = builder.icmp_signed("<=", positions, last.load(row, 0))
                contributes = builder.and_(visible, reached)
                alpha = alpha.where(contributes, 0.0)
                gradients = [_Lanes(builder, state.load(row, index)) for index in range(2, 7)]
                behind = _Lanes(builder, state.load(row, 1))

                opening = 1.0 / (1.0 - alpha)
                before = _Lanes(builder, state.load(row, 0)) * opening
                weight = alpha * before
                value = gradients[4]
                for channel, gradient in zip(splat.channels, gradients[:4], strict=True):
                    value = channel.multiply_add(gradient, plus=value)
                state.store(row, 0, before.value)
                state.store(row, 1, weight.multiply_add(value, plus=behind).value)
                if wanted == "nothing":
                    return

                if wanted == "colour":
                    for total, gradient in zip(totals, gradients[:3], strict=True):
                        value = weight.multiply_add(
                            gradient, plus=_Lanes(builder, builder.load(total))
                        )
                        builder.store(value.value, total)
                    return

                q = (before * value - behind * opening) * alpha
                q = q.where(raw.compare("<=", MAX_ALPHA), 0.0)
                terms = [weight * gradients[3]] if wanted == "depth" else [q]
                if wanted == "all":
                    dys = _Lanes(builder, _broadcast(builder, dy))
                    terms += [q * dys, q * dys * dys]
                    terms += [weight * gradients[index] for index in (3, 0, 1, 2)]
                for total, term in zip(totals, terms, strict=True):
                    value = _Lanes(builder, builder.load(total)) + term
                    builder.store(value.value, total)

            _loop_over_rows(builder, (begin, end), position, limits, revert)

            columns = [_Lanes(builder, builder.load(total)) for total in totals]
            if wanted == "all":
                q, q_dy, q_dy2 = columns[:3]
                moments = [q, q * splat.dx, q_dy, q * splat.dx * splat.dx, q_dy * splat.dx, q_dy2]
                columns = moments + columns[3:]
            if wanted != "nothing":
                out = _Rows(context, builder, signature.args[6], sums, _FLOATS, 1)
                out.store(ir.Constant(_LONG, 0), 0, _sum_lanes(builder, columns))
            return context.get_dummy_value()

        return signature, generate

    return undraw_rows


_pass_rows = _make_revert("nothing")
_revert_rows_for_opacity = _make_revert("opacity")
_revert_rows_for_depth = _make_revert("depth")
_revert_rows_for_color = _make_revert("colour")
_revert_rows = _make_revert("all")


# ---- 3 × 3 matrices as tuples of nine, row by row ---------------------------------------------


@njit(cache=True, fastmath={"contract"})
def _multiply(a, b):
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@njit(cache=True, fastmath={"contract"})
def _transpose(a):
    return (a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8])


@njit(cache=True, fastmath={"contract"})
def _apply_matrix(a, x, y, z):
    return (
        a[0] * x + a[1] * y + a[2] * z,
        a[3] * x + a[4] * y + a[5] * z,
        a[6] * x + a[7] * y + a[8] * z,
    )


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _normalize_quat(quats, i):
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    factor = np.float32(1) / math.sqrt(w * w + x * x + y * y + z * z)
    return w * factor, x * factor, y * factor, z * factor, factor


@njit(cache=True, fastmath={"contract"})
def _compute_rotation(w, x, y, z):
    one, two = np.float32(1), np.float32(2)
    return (
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    )


@njit(cache=True, fastmath={"contract"})
def _rotation_backward(w, x, y, z, d):
    """Compute the gradient of a unit quaternion from that of its rotation matrix."""
    two = np.float32(2)
    return (
        two * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])),
        two * (y * (d[1] + d[3]) + z * (d[2] + d[6]) + w * (d[7] - d[5]) - two * x * (d[4] + d[8])),
        two * (x * (d[1] + d[3]) + z * (d[5] + d[7]) + w * (d[2] - d[6]) - two * y * (d[0] + d[8])),
        two * (x * (d[2] + d[6]) + y * (d[5] + d[7]) + w * (d[3] - d[1]) - two * z * (d[0] + d[4])),
    )


@njit(cache=True, fastmath={"contract"})
def _scale_columns(a, x, y, z):
    return (
        a[0] * x,
        a[1] * y,
        a[2] * z,
        a[3] * x,
        a[4] * y,
        a[5] * z,
        a[6] * x,
        a[7] * y,
        a[8] * z,
    )


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _compute_tangent_limits(pinhole):
    """Compute the range of x/z and of y/z at which the Jacobian is evaluated."""
    fx, fy, cx, cy = pinhole.intrinsics
    width, height = np.float32(pinhole.width), np.float32(pinhole.height)
    margin_x, margin_y = TANGENT_MARGIN * width, TANGENT_MARGIN * height
    return (
        -(cx + margin_x) / fx,
        (width - cx + margin_x) / fx,
        -(cy + margin_y) / fy,
        (height - cy + margin_y) / fy,
    )


@njit(cache=True, fastmath={"contract"})
def _flatten(axes, jacobian):
    """Project the axes of a Gaussian (columns, in the camera) to a 2 × 3 matrix, by rows.

    jacobian: d pixel x / dx, d pixel x / dz, d pixel y / dy, d pixel y / dz.
    """
    xx, xz, yy, yz = jacobian
    return (
        xx * axes[0] + xz * axes[6],
        xx * axes[1] + xz * axes[7],
        xx * axes[2] + xz * axes[8],
        yy * axes[3] + yz * axes[6],
        yy * axes[4] + yz * axes[7],
        yy * axes[5] + yz * axes[8],
    )


# ---- View-dependent colour -----------------------------------------------------------------------

# Spherical harmonics in the basis and with the signs of 3DGS, see render/spherical_harmonics.py.
_C0, _C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
_C2XY, _C2Z = np.float32(1.0925484305920792), np.float32(0.31539156525252005)
_C2XX = np.float32(0.5462742152960396)
_C3A, _C3XYZ = np.float32(0.5900435899266435), np.float32(2.890611442640554)
_C3B, _C3Z = np.float32(0.4570457994644658), np.float32(0.3731763325901154)
_C3XX = np.float32(1.445305721320277)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _compute_direction(center, means, i):
    """Compute the unit vector from the camera centre to the mean, and the inverse distance."""
    x, y, z = means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
    inverse = np.float32(1) / math.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@njit(cache=True, fastmath={"contract"})
def _evaluate_basis(x, y, z, basis):
    """Evaluate 1, 4, 9 or 16 basis functions at a unit direction."""
    two, three, four = np.float32(2), np.float32(3), np.float32(4)
    xx, yy, zz = x * x, y * y, z * z
    basis[0] = _C0
    if len(basis) >= 4:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if len(basis) >= 9:
        basis[4] = _C2XY * x * y
        basis[5] = -_C2XY * y * z
        basis[6] = _C2Z * (two * zz - xx - yy)
        basis[7] = -_C2XY * x * z
        basis[8] = _C2XX * (xx - yy)
    if len(basis) >= 16:
        basis[9] = -_C3A * y * (three * xx - yy)
        basis[10] = _C3XYZ * x * y * z
        basis[11] = -_C3B * y * (four * zz - xx - yy)
        basis[12] = _C3Z * z * (two * zz - three * xx - three * yy)
        basis[13] = -_C3B * x * (four * zz - xx - yy)
        basis[14] = _C3XX * z * (xx - yy)
        basis[15] = -_C3A * x * (xx - three * yy)


@njit(cache=True, fastmath={"contract"})
def _basis_backward(x, y, z, g):
    """Compute the gradient in the direction of the sum of g[k] times basis function k."""
    two, three, four = np.float32(2), np.float32(3), np.float32(4)
    six, eight = np.float32(6), np.float32(8)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    dx = dy = dz = np.float32(0)
    if len(g) >= 4:
        dx -= _C1 * g[3]
        dy -= _C1 * g[1]
        dz += _C1 * g[2]
    if len(g) >= 9:
        dx += _C2XY * (y * g[4] - z * g[7]) + two * x * (_C2XX * g[8] - _C2Z * g[6])
        dy += _C2XY * (x * g[4] - z * g[5]) - two * y * (_C2XX * g[8] + _C2Z * g[6])
        dz += four * _C2Z * z * g[6] - _C2XY * (y * g[5] + x * g[7])
    if len(g) >= 16:
        dx += _C3XYZ * yz * g[10] - six * _C3Z * xz * g[12] + two * _C3XX * xz * g[14]
        dx += _C3B * (two * xy * g[11] - (four * zz - three * xx - yy) * g[13])
        dx -= _C3A * (six * xy * g[9] + three * (xx - yy) * g[15])
        dy += _C3XYZ * xz * g[10] - six * _C3Z * yz * g[12] - two * _C3XX * yz * g[14]
        dy += _C3B * (two * xy * g[13] - (four * zz - xx - three * yy) * g[11])
        dy += _C3A * (six * xy * g[15] - three * (xx - yy) * g[9])
        dz += _C3XYZ * xy * g[10] + three * _C3Z * (two * zz - xx - yy) * g[12]
        dz += _C3XX * (xx - yy) * g[14] - eight * _C3B * (yz * g[11] + xz * g[13])
    return dx, dy, dz


# ---- From Gaussians to splats --------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def project(begin, end, gaussians, pinhole, splats, boxes, factors):
    """Project the Gaussians begin..end to `splats` and `boxes`, empty if invisible.

    A box encloses the pixels in which alpha reaches 1/255 at the given opacity. factors [n]
    receives the factors on the opacities of antialiased Gaussians, and is None for classic ones.
    """
    means, quats, scales, opacities, sh = gaussians
    view, center, near = pinhole.rotation, pinhole.center, pinhole.near
    fx, fy, cx, cy = pinhole.intrinsics
    least_x, largest_x, least_y, largest_y = _compute_tangent_limits(pinhole)
    width, height = np.float32(pinhole.width), np.float32(pinhole.height)
    basis = np.empty(sh.shape[1], np.float32)
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    root_half = np.float32(math.sqrt(0.5))
    for i in range(begin, end):
        boxes[i, 0] = boxes[i, 1] = boxes[i, 2] = boxes[i, 3] = 0
        x, y, z = _apply_matrix(
            view, means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        )
        # Conditions are written so that NaN fails them.
        if not (z > near and z < np.inf and opacities[i] >= MIN_ALPHA):
            continue
        inverse_z = one / z
        tan_x, tan_y = x * inverse_z, y * inverse_z
        jacobian_x, jacobian_y = fx * inverse_z, fy * inverse_z
        clamped_x = min(max(tan_x, least_x), largest_x)
        clamped_y = min(max(tan_y, least_y), largest_y)
        qw, qx, qy, qz, _ = _normalize_quat(quats, i)
        axes = _scale_columns(
            _multiply(view, _compute_rotation(qw, qx, qy, qz)),
            scales[i, 0],
            scales[i, 1],
            scales[i, 2],
        )
        flat = _flatten(
            axes, (jacobian_x, -jacobian_x * clamped_x, jacobian_y, -jacobian_y * clamped_y)
        )

        # The determinant of F Fᵀ + blur is summed from squares: nothing cancels, however thin
        # the splat is. In double precision nothing overflows either.
        a0, a1, a2 = np.float64(flat[0]), np.float64(flat[1]), np.float64(flat[2])
        b0, b1, b2 = np.float64(flat[3]), np.float64(flat[4]), np.float64(flat[5])
        aa = a0 * a0 + a1 * a1 + a2 * a2
        bb = b0 * b0 + b1 * b1 + b2 * b2
        ab = a0 * b0 + a1 * b1 + a2 * b2
        c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        determinant = c0 * c0 + c1 * c1 + c2 * c2 + BLUR * (aa + bb) + BLUR * BLUR
        if not determinant < np.inf:
            continue
        deviation_x = np.float32(math.sqrt(aa + BLUR))
        deviation_y = np.float32(math.sqrt(bb + BLUR))
        opacity = opacities[i]
        if factors is not None:
            factors[i] = math.sqrt((c0 * c0 + c1 * c1 + c2 * c2) / determinant)
            opacity *= factors[i]
            if not opacity >= MIN_ALPHA:
                continue

        center_x, center_y = fx * tan_x + cx, fy * tan_y + cy
        sigmas = math.sqrt(np.float32(2) * math.log(opacity / MIN_ALPHA)) + np.float32(1e-3)
        radius_x, radius_y = sigmas * deviation_x, sigmas * deviation_y
        left = max(math.ceil(center_x - radius_x - half), zero)
        right = min(math.floor(center_x + radius_x + half), width)
        top = max(math.ceil(center_y - radius_y - half), zero)
        bottom = min(math.floor(center_y + radius_y + half), height)
        if not (left < right and top < bottom):
            continue
        boxes[i, 0], boxes[i, 1] = np.int32(left), np.int32(right)
        boxes[i, 2], boxes[i, 3] = np.int32(top), np.int32(bottom)
        u = root_half * deviation_y / np.float32(math.sqrt(determinant))
        splats[i, X], splats[i, Y] = center_x, center_y
        splats[i, U] = u
        splats[i, V] = -u * np.float32(ab / (bb + BLUR))
        splats[i, W] = root_half / deviation_y
        splats[i, DEPTH] = z

        direction_x, direction_y, direction_z, _ = _compute_direction(center, means, i)
        _evaluate_basis(direction_x, direction_y, direction_z, basis)
        for channel in range(3):
            color = half
            for k in range(len(basis)):
                color += basis[k] * sh[i, k, channel]
            splats[i, RED + channel] = max(color, zero)


# ---- Two lists, merged by depth ------------------------------------------------------------------


@njit(cache=True)
def _get_depth(splats, entries, place, begin, end, beyond):
    """Return the depth of an entry, or `beyond` for places outside begin..end."""
    if place < begin or place >= end:
        return beyond
    return splats[entries[place], DEPTH]


@njit(cache=True, nogil=True)
def merge_lists(begin, end, context, new, used, full, tile_start, entries, depth_limits):
    """Merge the lists of the tiles begin..end of two layers, as far as they were composited.

    Splats of `new` are numbered after those of the context. depth_limits [tiles] receives the
    z-depth behind which a tile shows nothing.
    """
    c_splats, _, _, c_start, c_entries = context
    n_splats, _, _, n_start, n_entries = new
    infinity = np.float32(np.inf)
    for tile in range(begin, end):
        c, n = c_start[tile], n_start[tile]
        c_end, n_end = c + used[tile, 0], n + used[tile, 1]
        place, depth = tile_start[tile], infinity
        c_depth = _get_depth(c_splats, c_entries, c, c, c_end, infinity)
        n_depth = _get_depth(n_splats, n_entries, n, n, n_end, infinity)
        while c < c_end and n < n_end:
            if c_depth <= n_depth:
                depth, entries[place] = c_depth, c_entries[c]
                c += 1
                c_depth = _get_depth(c_splats, c_entries, c, c, c_end, infinity)
            else:
                depth, entries[place] = n_depth, len(c_splats) + n_entries[n]
                n += 1
                n_depth = _get_depth(n_splats, n_entries, n, n, n_end, infinity)
            place += 1
        for rest in range(c, c_end):
            entries[place + rest - c] = c_entries[rest]
        for rest in range(n, n_end):
            entries[place + rest - n] = len(c_splats) + n_entries[rest]
        if c < c_end:
            depth = c_splats[c_entries[c_end - 1], DEPTH]
        if n < n_end:
            depth = n_splats[n_entries[n_end - 1], DEPTH]
        depth_limits[tile] = depth if full[tile] else infinity


# ---- Compositing ---------------------------------------------------------------------------------


@njit(cache=True)
def _allocate_aligned(size):
    """Allocate float32 values from a cache line on, so that no vector straddles two."""
    buffer = np.empty(size + TILE, np.float32)
    start = (-buffer.ctypes.data % 64) // 4
    return buffer[start : start + size]


@njit(cache=True, fastmath={"contract"})
def _place_in_tile(splats, opacities, boxes, i, left, top):
    """Return the rows of the tile at (left, top) that splat i touches, and the relative splat."""
    half = np.float32(0.5)
    return (
        max(np.int64(boxes[i, 2]) - top, 0),
        min(np.int64(boxes[i, 3]) - top, TILE),
        (
            splats[i, X] - np.float32(left) - half,
            splats[i, Y] - np.float32(top) - half,
            splats[i, U],
            splats[i, V],
            splats[i, W],
            opacities[i],
            splats[i, RED],
            splats[i, GREEN],
            splats[i, BLUE],
            splats[i, DEPTH],
        ),
    )


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def composite(begin, end, tiles, context, new, frame):
    """Composite tiles[begin:end] of two layers into `frame`, the context first at equal depth."""
    # Taking an array out of a tuple counts references, which must not happen in the loops.
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    image, depths, alphas, transmittances, lasts, used, full = frame
    height, width = alphas.shape
    tiles_x = (width + TILE - 1) // TILE
    state = _allocate_aligned(TILE * 5 * TILE).reshape((TILE, 5, TILE))
    last = np.empty((TILE, TILE), np.int32)
    row_limit = np.empty(TILE, np.int32)
    infinity = np.float32(np.inf)
    for index in range(begin, end):
        tile = tiles[index]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        state[:] = 0
        state[:, 0, :columns] = 1
        # Pixels beyond the border of the image are full from the start.
        state[:, 0, columns:] = -1
        last[:] = -1
        row_limit[:] = np.iinfo(np.int32).max
        open_rows = rows

        c_begin, c_end = c_start[tile], c_start[tile + 1]
        n_begin, n_end = n_start[tile], n_start[tile + 1]
        c, n = c_begin, n_begin
        c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
        n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
        while open_rows > 0 and (c < c_end or n < n_end):
            position = np.int32(c - c_begin + n - n_begin)
            if c_depth <= n_depth:
                first, stop, splat = _place_in_tile(
                    c_splats, c_opacities, c_boxes, c_entries[c], left, top
                )
                c += 1
                c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
            else:
                first, stop, splat = _place_in_tile(
                    n_splats, n_opacities, n_boxes, n_entries[n], left, top
                )
                n += 1
                n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
            open_rows -= _composite_rows(first, stop, position, state, last, row_limit, splat)

        used[tile, 0], used[tile, 1] = c - c_begin, n - n_begin
        full[tile] = open_rows == 0
        for row in range(rows):
            for column in range(columns):
                transmittance = abs(state[row, 0, column])
                alpha = np.float32(1) - transmittance
                y, x = top + row, left + column
                for channel in range(3):
                    image[y, x, channel] = state[row, 1 + channel, column]
                depths[y, x] = state[row, 4, column] / alpha if alpha > 0 else np.float32(0)
                alphas[y, x] = alpha
                transmittances[y, x] = transmittance
                lasts[y, x] = last[row, column]


@njit(cache=True, nogil=True)
def _grow_if_full(kept, used):
    if used + TILE <= len(kept):
        return kept
    wider = _allocate_aligned(2 * kept.size).reshape((2 * len(kept), TILE))
    # Slices assigned to slices take seconds to compile.
    for row in range(used):
        for column in range(TILE):
            wider[row, column] = kept[row, column]
    return wider


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def backproject_residual(begin, end, tiles, context, new, photograph, slots, sums, written):
    """Composite tiles[begin:end] and backproject the residual to the entries of `new`.

    A splat's weights stay in the cache until the image of its tile is finished.
    sums [slots, 4]: over the tile, weight times (photograph - image) per colour, and weight.
    """
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    height, width = photograph.shape[:2]
    tiles_x = (width + TILE - 1) // TILE
    state = _allocate_aligned(TILE * 4 * TILE).reshape((TILE, 4, TILE))
    kept = _allocate_aligned(FIRST_ROWS * TILE).reshape((FIRST_ROWS, TILE))
    row_limit = np.empty(TILE, np.int32)
    totals = np.zeros(TILE, np.float32)
    infinity = np.float32(np.inf)
    for index in range(begin, end):
        tile = tiles[index]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        state[:] = 0
        state[:, 0, :columns] = 1
        # Pixels beyond the border of the image are full from the start.
        state[:, 0, columns:] = -1
        row_limit[:] = 0
        open_rows = rows

        c, c_begin, c_end = c_start[tile], c_start[tile], c_start[tile + 1]
        n, n_begin, n_end = n_start[tile], n_start[tile], n_start[tile + 1]
        c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
        n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
        place = np.int64(0)  # with a plain 0, its callees are compiled twice
        while open_rows > 0 and (c < c_end or n < n_end):
            kept = _grow_if_full(kept, place)
            if c_depth <= n_depth:
                first, stop, splat = _place_in_tile(
                    c_splats, c_opacities, c_boxes, c_entries[c], left, top
                )
                c += 1
                c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
                # The next splat overwrites its weights.
                open_rows -= _weigh_rows(first, stop, place, state, row_limit, kept, splat)
                continue
            first, stop, splat = _place_in_tile(
                n_splats, n_opacities, n_boxes, n_entries[n], left, top
            )
            n += 1
            n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
            open_rows -= _weigh_rows(first, stop, place, state, row_limit, kept, splat)
            place += max(stop - first, 0)

        for row in range(rows):
            for channel in range(3):
                for column in range(columns):
                    wanted = photograph[top + row, left + column, channel]
                    state[row, 1 + channel, column] = wanted - state[row, 1 + channel, column]

        place = 0
        for entry in range(n_begin, n):
            i, slot = n_entries[entry], slots[entry]
            first = max(np.int64(n_boxes[i, 2]) - top, 0)
            stop = min(np.int64(n_boxes[i, 3]) - top, TILE)
            _sum_weighted_rows(first, stop, place, state, kept, totals)
            place += max(stop - first, 0)
            written[slot] = True
            for column in range(4):
                sums[slot, column] = totals[column]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def composite_backward(
    begin, end, tiles, context, new, frame, d_frame, slots, wanted, gradients, written
):
    """Traverse tiles[begin:end] back to front and sum the gradients of the entries of `new`.

    d_frame: gradients of image, depth and alpha. slots [e] int32: slot of each entry of `new`.
    gradients [slots, columns] and written [slots] are set for visited entries only.
    """
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    _, depths, alphas, transmittances, lasts, used, _ = frame
    d_image, d_depth, d_alpha = d_frame
    height, width = alphas.shape
    tiles_x = (width + TILE - 1) // TILE
    state = _allocate_aligned(TILE * 7 * TILE).reshape((TILE, 7, TILE))
    last = np.empty((TILE, TILE), np.int32)
    row_limit = np.empty(TILE, np.int32)
    sums = np.zeros(TILE, np.float32)
    nothing = np.float32(-np.inf)
    for index in range(begin, end):
        tile = tiles[index]
        n_begin = n_start[tile]
        n = n_begin + used[tile, 1]
        if n == n_begin:
            continue
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        state[:] = 0
        last[:] = -1
        row_limit[:] = -1
        for row in range(rows):
            for column in range(columns):
                y, x = top + row, left + column
                alpha = alphas[y, x]
                d_depth_sum = d_depth[y, x] / alpha if alpha > 0 else np.float32(0)
                state[row, 0, column] = transmittances[y, x]
                for channel in range(3):
                    state[row, 2 + channel, column] = d_image[y, x, channel]
                state[row, 5, column] = d_depth_sum
                state[row, 6, column] = d_alpha[y, x] - d_depth_sum * depths[y, x]
                last[row, column] = lasts[y, x]
                row_limit[row] = max(row_limit[row], last[row, column])

        c_begin = c_start[tile]
        c = c_begin + used[tile, 0]
        c_depth = _get_depth(c_splats, c_entries, c - 1, c_begin, c, nothing)
        n_depth = _get_depth(n_splats, n_entries, n - 1, n_begin, n, nothing)
        while n > n_begin:
            position = np.int32(c - c_begin + n - n_begin - 1)
            if c_depth > n_depth:
                c -= 1
                first, stop, splat = _place_in_tile(
                    c_splats, c_opacities, c_boxes, c_entries[c], left, top
                )
                c_depth = _get_depth(c_splats, c_entries, c - 1, c_begin, c, nothing)
                _pass_rows(first, stop, position, state, last, row_limit, sums, splat)
                continue
            n -= 1
            first, stop, splat = _place_in_tile(
                n_splats, n_opacities, n_boxes, n_entries[n], left, top
            )
            n_depth = _get_depth(n_splats, n_entries, n - 1, n_begin, n, nothing)
            slot = slots[n]
            written[slot] = True
            if wanted == WANT_OPACITY:
                _revert_rows_for_opacity(first, stop, position, state, last, row_limit, sums, splat)
                gradients[slot, 0] = sums[0]
                continue
            if wanted == WANT_DEPTH:
                _revert_rows_for_depth(first, stop, position, state, last, row_limit, sums, splat)
                gradients[slot, 0] = sums[0]
                continue
            if wanted == WANT_COLOR:
                _revert_rows_for_color(first, stop, position, state, last, row_limit, sums, splat)
                for channel in range(3):
                    gradients[slot, channel] = sums[channel]
                continue
            _revert_rows(first, stop, position, state, last, row_limit, sums, splat)
            u, v, w = splat[2], splat[3], splat[4]
            x, y, xx, xy, yy = sums[1], sums[2], sums[3], sums[4], sums[5]
            gradients[slot, SUM] = sums[0]
            gradients[slot, SUM_S] = u * x + v * y
            gradients[slot, SUM_T] = w * y
            gradients[slot, SUM_SS] = u * (u * xx + v * xy) + v * (u * xy + v * yy)
            gradients[slot, SUM_ST] = w * (u * xy + v * yy)
            gradients[slot, SUM_TT] = w * w * yy
            for channel in range(4):
                gradients[slot, SUM_DEPTH + channel] = sums[6 + channel]


# ---- From gradients of entries to gradients of Gaussians ---------------------------------------


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _compensation_backward(flat, q):
    """Compute the gradient of the flattened axes from that of log sqrt(P / D).

    P is the squared area that they span, D the determinant with the blur.
    """
    a0, a1, a2 = np.float64(flat[0]), np.float64(flat[1]), np.float64(flat[2])
    b0, b1, b2 = np.float64(flat[3]), np.float64(flat[4]), np.float64(flat[5])
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    squares = a0 * a0 + a1 * a1 + a2 * a2 + b0 * b0 + b1 * b1 + b2 * b2
    area, added = c0 * c0 + c1 * c1 + c2 * c2, BLUR * squares + BLUR * BLUR
    of_area = q * added / (area * (area + added))
    of_squares = q * BLUR / (area + added)
    return (
        np.float32(of_area * (b1 * c2 - b2 * c1) - of_squares * a0),
        np.float32(of_area * (b2 * c0 - b0 * c2) - of_squares * a1),
        np.float32(of_area * (b0 * c1 - b1 * c0) - of_squares * a2),
        np.float32(of_area * (c1 * a2 - c2 * a1) - of_squares * b0),
        np.float32(of_area * (c2 * a0 - c0 * a2) - of_squares * b1),
        np.float32(of_area * (c0 * a1 - c1 * a0) - of_squares * b2),
    )


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def project_backward(
    begin, end, gaussians, pinhole, factors, splats, slot_start, gradients, written, d_gaussians
):
    """Write gradients of the Gaussians begin..end to `d_gaussians` from those of entries."""
    means, quats, scales, opacities, sh = gaussians
    d_means, d_quats, d_scales, d_opacities, d_sh = d_gaussians
    view, center = pinhole.rotation, pinhole.center
    from_view = _transpose(view)
    fx, fy = pinhole.intrinsics[0], pinhole.intrinsics[1]
    least_x, largest_x, least_y, largest_y = _compute_tangent_limits(pinhole)
    one, two, four = np.float32(1), np.float32(2), np.float32(4)
    sums = np.empty(NUM_GRADIENT_COLUMNS, np.float32)
    basis, d_basis = np.empty(sh.shape[1], np.float32), np.empty(sh.shape[1], np.float32)
    for i in range(begin, end):
        any_written = False
        sums[:] = 0
        for slot in range(slot_start[i], slot_start[i + 1]):
            if written[slot]:
                any_written = True
                for column in range(NUM_GRADIENT_COLUMNS):
                    sums[column] += gradients[slot, column]
        if not any_written:
            continue

        d_opacities[i] = sums[SUM] / opacities[i]

        # Colour, which is cut off at zero
        direction_x, direction_y, direction_z, inverse_distance = _compute_direction(
            center, means, i
        )
        _evaluate_basis(direction_x, direction_y, direction_z, basis)
        d_basis[:] = 0
        for channel in range(3):
            if splats[i, RED + channel] > 0:
                d_color = sums[SUM_RED + channel]
                for k in range(len(basis)):
                    d_sh[i, k, channel] = d_color * basis[k]
                    d_basis[k] += d_color * sh[i, k, channel]
        d_dx, d_dy, d_dz = _basis_backward(direction_x, direction_y, direction_z, d_basis)
        radial = direction_x * d_dx + direction_y * d_dy + direction_z * d_dz

        x, y, z = _apply_matrix(
            view, means[i, 0] - center[0], means[i, 1] - center[1], means[i, 2] - center[2]
        )
        inverse_z = one / z
        tan_x, tan_y = x * inverse_z, y * inverse_z
        jacobian_x, jacobian_y = fx * inverse_z, fy * inverse_z
        clamped_x = min(max(tan_x, least_x), largest_x)
        clamped_y = min(max(tan_y, least_y), largest_y)
        qw, qx, qy, qz, unit_factor = _normalize_quat(quats, i)
        rotation = _multiply(view, _compute_rotation(qw, qx, qy, qz))
        axes = _scale_columns(rotation, scales[i, 0], scales[i, 1], scales[i, 2])
        jacobian = (jacobian_x, -jacobian_x * clamped_x, jacobian_y, -jacobian_y * clamped_y)
        flat = _flatten(axes, jacobian)

        # dL/dΣ = 2 Uᵀ Q U with Q = [[ss, st], [st, tt]], and Σ = F Fᵀ: dL/dF = 4 Uᵀ Q (U F).
        u, v, w = splats[i, U], splats[i, V], splats[i, W]
        ss, st, tt = sums[SUM_SS], sums[SUM_ST], sums[SUM_TT]
        s0 = u * flat[0] + v * flat[3]
        s1 = u * flat[1] + v * flat[4]
        s2 = u * flat[2] + v * flat[5]
        t0, t1, t2 = w * flat[3], w * flat[4], w * flat[5]
        a0, a1, a2 = ss * s0 + st * t0, ss * s1 + st * t1, ss * s2 + st * t2
        b0, b1, b2 = st * s0 + tt * t0, st * s1 + tt * t1, st * s2 + tt * t2
        d_x0, d_x1, d_x2 = four * u * a0, four * u * a1, four * u * a2
        d_y0 = four * (v * a0 + w * b0)
        d_y1 = four * (v * a1 + w * b1)
        d_y2 = four * (v * a2 + w * b2)
        if factors is not None:
            more = _compensation_backward(flat, sums[SUM])
            d_x0, d_x1, d_x2 = d_x0 + more[0], d_x1 + more[1], d_x2 + more[2]
            d_y0, d_y1, d_y2 = d_y0 + more[3], d_y1 + more[4], d_y2 + more[5]

        # F = J axes
        xx, xz, yy, yz = jacobian
        d_xx = d_x0 * axes[0] + d_x1 * axes[1] + d_x2 * axes[2]
        d_xz = d_x0 * axes[6] + d_x1 * axes[7] + d_x2 * axes[8]
        d_yy = d_y0 * axes[3] + d_y1 * axes[4] + d_y2 * axes[5]
        d_yz = d_y0 * axes[6] + d_y1 * axes[7] + d_y2 * axes[8]
        d_axes = (
            xx * d_x0,
            xx * d_x1,
            xx * d_x2,
            yy * d_y0,
            yy * d_y1,
            yy * d_y2,
            xz * d_x0 + yz * d_y0,
            xz * d_x1 + yz * d_y1,
            xz * d_x2 + yz * d_y2,
        )

        # axes = rotation diag(scales), rotation = view R(quat)
        for k in range(3):
            d_scales[i, k] = (
                d_axes[k] * rotation[k]
                + d_axes[3 + k] * rotation[3 + k]
                + d_axes[6 + k] * rotation[6 + k]
            )
        d_rotation = _multiply(
            from_view, _scale_columns(d_axes, scales[i, 0], scales[i, 1], scales[i, 2])
        )
        d_qw, d_qx, d_qy, d_qz = _rotation_backward(qw, qx, qy, qz, d_rotation)
        along = qw * d_qw + qx * d_qx + qy * d_qy + qz * d_qz
        d_quats[i, 0] = (d_qw - qw * along) * unit_factor
        d_quats[i, 1] = (d_qx - qx * along) * unit_factor
        d_quats[i, 2] = (d_qy - qy * along) * unit_factor
        d_quats[i, 3] = (d_qz - qz * along) * unit_factor

        # J and the centre of the splat depend on the mean. A clamped tangent does not.
        d_tan_x = two * fx * u * sums[SUM_S]
        d_tan_y = two * fy * (v * sums[SUM_S] + w * sums[SUM_T])
        if clamped_x == tan_x:
            d_tan_x -= d_xz * jacobian_x
        if clamped_y == tan_y:
            d_tan_y -= d_yz * jacobian_y
        d_z = sums[SUM_DEPTH] - (d_xx * xx + d_xz * xz + d_yy * yy + d_yz * yz) * inverse_z
        d_z -= (d_tan_x * tan_x + d_tan_y * tan_y) * inverse_z
        d_x, d_y, d_z = _apply_matrix(from_view, d_tan_x * inverse_z, d_tan_y * inverse_z, d_z)
        d_means[i, 0] = d_x + (d_dx - direction_x * radial) * inverse_distance
        d_means[i, 1] = d_y + (d_dy - direction_y * radial) * inverse_distance
        d_means[i, 2] = d_z + (d_dz - direction_z * radial) * inverse_distance


# ---- Fragments: new splats that keep their place, in a frozen layer that is folded once --------


class Fragments(NamedTuple):
    """Fragments of new splats, ordered by tile, pixel and depth.

    Frozen content between two fragments of a pixel is baked into one layer. `SOLID` frozen splats
    behind anything new are fragments themselves, so that pixels end at the same splat as in
    `composite`.
    """

    tiles: np.ndarray
    """Tiles that may have fragments [t] int64."""
    entry_start: np.ndarray
    """Start of the entries of each of them [t + 1] int64."""
    names: np.ndarray
    """New splat of each entry, or the complement of an index into `solid` [e] int32."""
    slots: np.ndarray
    """Slot of the gradient of each entry; -1 if frozen [e] int32."""
    pixel_start: np.ndarray
    """Start of the fragments of each pixel, row by row [t, TILE² + 1] int64."""
    entries: np.ndarray
    """Entry of each fragment in its tile; baked layers are numbered after them [f] int32."""
    falloffs: np.ndarray
    """Alpha at opacity 1, alpha of frozen ones, unused for baked layers [f] float32."""
    baked_start: np.ndarray
    """Start of the baked layers of each tile [t + 1] int64."""
    baked: np.ndarray
    """Transmittance and colour of the baked layers [g, 4] float32."""
    solid: np.ndarray
    """Colours of the frozen splats with entries [s, 3] float32."""
    behind: np.ndarray
    """Colour baked behind the last fragment of each pixel [h, w, 3] float32."""


@njit(cache=True, fastmath={"contract"})
def _clip_box(boxes, i, left, top):
    return (
        max(np.int64(boxes[i, 0]) - left, 0),
        min(np.int64(boxes[i, 1]) - left, TILE),
        max(np.int64(boxes[i, 2]) - top, 0),
        min(np.int64(boxes[i, 3]) - top, TILE),
    )


@njit(cache=True)
def _bound_fragments(tile, left, top, context, new):
    """Bound the number of entries and fragments of a tile."""
    _, c_opacities, c_boxes, c_start, c_entries = context
    _, _, n_boxes, n_start, n_entries = new
    entries = fragments = 0
    for place in range(n_start[tile], n_start[tile + 1]):
        x_from, x_to, y_from, y_to = _clip_box(n_boxes, n_entries[place], left, top)
        entries += 1
        fragments += (x_to - x_from) * (y_to - y_from)
    for place in range(c_start[tile], c_start[tile + 1]):
        if c_opacities[c_entries[place]] > SOLID:
            x_from, x_to, y_from, y_to = _clip_box(c_boxes, c_entries[place], left, top)
            entries += 1
            fragments += (x_to - x_from) * (y_to - y_from)
    return entries, fragments


@njit(cache=True, fastmath={"contract"})
def _cover(pixel, alpha, red, green, blue):
    """Composite a splat behind a pixel, whose transmittance becomes negative if it is full."""
    transmittance = pixel[0]
    after = transmittance * (np.float32(1) - alpha)
    if after <= MIN_TRANSMITTANCE:
        return -transmittance, pixel[1], pixel[2], pixel[3]
    weight = transmittance * alpha
    return after, pixel[1] + weight * red, pixel[2] + weight * green, pixel[3] + weight * blue


@njit(cache=True)
def _sort_by_pixel(
    pixels, entries, falloffs, count, first_fold, behind, begin, starts, to_entries, to_falloffs
):
    """Sort the fragments of a tile by pixel, stably, and number baked layers from `behind`."""
    starts[:] = 0
    for k in range(count):
        starts[pixels[k]] += 1
    place = begin
    for pixel in range(TILE * TILE):
        place, starts[pixel] = place + starts[pixel], place
    for k in range(count):
        place = starts[pixels[k]]
        entry = entries[k]
        if entry < 0:
            entry, falloffs[k] = behind + ~entry - first_fold, 0
        to_entries[place], to_falloffs[place] = entry, falloffs[k]
        starts[pixels[k]] = place + 1
    for pixel in range(TILE * TILE, 0, -1):  # Each is at the start of the next one.
        starts[pixel] = starts[pixel - 1]
    starts[0] = begin


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def find_fragments(begin, end, tiles, context, new, new_slots, where, behind):
    """Find the Fragments of tiles[begin:end] of two layers, and bake the context between them.

    new has the opacities of opaque Gaussians; new_slots [entries] int32 are its slots.
    where [h, w] bool: pixels that get fragments. behind [h, w, 3] float32 is written.
    """
    c_splats, c_opacities, c_boxes, c_start, c_entries = context
    n_splats, n_opacities, n_boxes, n_start, n_entries = new
    height, width, _ = behind.shape
    tiles_x = (width + TILE - 1) // TILE
    state = _allocate_aligned(TILE * 5 * TILE).reshape((TILE, 5, TILE))
    # `state` at the last fragment of each pixel, and one bit per pixel with a new fragment before
    known = np.empty((TILE, 4, TILE), np.float32)
    veiled, falloffs_of_row = np.empty(TILE, np.uint32), np.empty(TILE, np.float32)
    last = np.empty((TILE, TILE), np.int32)
    row_limit = np.empty(TILE, np.int32)
    infinity, one = np.float32(np.inf), np.float32(1)
    position = np.int32(0)

    most = most_entries = most_at_once = 0
    for index in range(begin, end):
        tile = tiles[index]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        bounds = _bound_fragments(tile, left, top, context, new)
        most_entries, most = most_entries + bounds[0], most + bounds[1]
        most_at_once = max(most_at_once, bounds[1])
    # Pages that are never written take no memory.
    pixels = np.empty(2 * most_at_once, np.uint8)
    at_entries = np.empty(2 * most_at_once, np.int32)
    at_falloffs = np.empty(2 * most_at_once, np.float32)
    entry_start = np.zeros(end - begin + 1, np.int64)
    names, slots = np.empty(most_entries, np.int32), np.empty(most_entries, np.int32)
    pixel_start = np.empty((end - begin, TILE * TILE + 1), np.int64)
    entries, falloffs = np.empty(2 * most, np.int32), np.empty(2 * most, np.float32)
    fold_start = np.zeros(end - begin + 1, np.int64)
    folds, solid = np.empty((most, 4), np.float32), np.empty((most_entries, 3), np.float32)
    entry = place = fold = row_of_solid = np.int64(0)

    for index in range(begin, end):
        tile = tiles[index]
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        rows, columns = min(TILE, height - top), min(TILE, width - left)
        state[:] = 0
        # Pixels outside the mask are full from the start.
        state[:, 0] = -1
        row_limit[:] = -1
        open_rows = 0
        for row in range(rows):
            for column in range(columns):
                if where[top + row, left + column]:
                    state[row, 0, column] = 1
                    row_limit[row] = np.iinfo(np.int32).max
            open_rows += row_limit[row] >= 0
        known[:] = 0
        known[:, 0] = 1
        veiled[:] = 0

        first_entry, first_fold, count = entry, fold, np.int64(0)
        c_begin, c_end = c_start[tile], c_start[tile + 1]
        n_begin, n_end = n_start[tile], n_start[tile + 1]
        c, n = c_begin, n_begin
        c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
        n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)
        while open_rows > 0 and (c < c_end or n < n_end):
            frozen = c_depth <= n_depth
            if frozen:
                i = c_entries[c]
                first, stop, splat = _place_in_tile(c_splats, c_opacities, c_boxes, i, left, top)
                x_from, x_to, y_from, y_to = _clip_box(c_boxes, i, left, top)
                c += 1
                c_depth = _get_depth(c_splats, c_entries, c, c_begin, c_end, infinity)
                if c_opacities[i] <= SOLID:
                    open_rows -= _composite_rows(
                        first, stop, position, state, last, row_limit, splat
                    )
                    continue
                names[entry], slots[entry] = ~row_of_solid, -1
            else:
                i = n_entries[n]
                _, _, splat = _place_in_tile(n_splats, n_opacities, n_boxes, i, left, top)
                x_from, x_to, y_from, y_to = _clip_box(n_boxes, i, left, top)
                names[entry], slots[entry] = i, new_slots[n]
                n += 1
                n_depth = _get_depth(n_splats, n_entries, n, n_begin, n_end, infinity)

            begun = count
            red, green, blue = splat[6:9]
            columns_of_splat = (1 << x_to) - (1 << x_from)
            for row in range(y_from, y_to):
                if row_limit[row] < 0:
                    continue
                if frozen and not veiled[row] & columns_of_splat:
                    open_rows -= _composite_rows(
                        row, row + 1, position, state, last, row_limit, splat
                    )
                    continue
                _compute_falloffs(row, falloffs_of_row, splat)
                for column in range(x_from, x_to):
                    falloff = falloffs_of_row[column]
                    if falloff == 0 or state[row, 0, column] < 0:
                        continue
                    alpha = min(falloff, MAX_ALPHA)
                    own = not frozen or (alpha > SOLID and veiled[row] >> column & 1)
                    if own:
                        veiled[row] |= 1 << column
                        pixel = np.uint8(row * TILE + column)
                        # Frozen splats have lowered the transmittance.
                        if state[row, 0, column] != known[row, 0, column]:
                            inverse = one / known[row, 0, column]
                            folds[fold, 0] = state[row, 0, column] * inverse
                            for channel in range(1, 4):
                                rest = state[row, channel, column] - known[row, channel, column]
                                folds[fold, channel] = rest * inverse
                            for channel in range(4):
                                known[row, channel, column] = state[row, channel, column]
                            pixels[count], at_entries[count] = pixel, ~fold
                            fold, count = fold + 1, count + 1
                        pixels[count], at_falloffs[count] = pixel, falloff
                        at_entries[count] = entry - first_entry
                        count += 1
                    if frozen:
                        before = (
                            state[row, 0, column],
                            state[row, 1, column],
                            state[row, 2, column],
                            state[row, 3, column],
                        )
                        after = _cover(before, alpha, red, green, blue)
                        for channel in range(4):
                            state[row, channel, column] = after[channel]
                            if own:
                                known[row, channel, column] = abs(after[channel])
            if count > begun:
                if frozen:
                    solid[row_of_solid, 0], solid[row_of_solid, 1] = red, green
                    solid[row_of_solid, 2] = blue
                    row_of_solid += 1
                entry += 1

        entry_start[index - begin + 1], fold_start[index - begin + 1] = entry, fold
        found = pixels, at_entries, at_falloffs, count, first_fold, entry - first_entry
        _sort_by_pixel(*found, place, pixel_start[index - begin], entries, falloffs)
        place += count
        for row in range(rows):
            for column in range(columns):
                inverse = one / known[row, 0, column]
                for channel in range(3):
                    rest = state[row, 1 + channel, column] - known[row, 1 + channel, column]
                    behind[top + row, left + column, channel] = rest * inverse
    return Fragments(
        tiles[begin:end],
        entry_start,
        names[:entry],
        slots[:entry],
        pixel_start,
        entries[:place],
        falloffs[:place],
        fold_start,
        folds[:fold],
        solid[:row_of_solid],
        behind,
    )


@njit(cache=True)
def _gather_appearance(fragments, index, opacities, colors):
    """Gather opacity and colour of each entry of a tile and its baked layers, and count entries."""
    first, first_fold = fragments.entry_start[index], fragments.baked_start[index]
    count = fragments.entry_start[index + 1] - first
    folds = fragments.baked_start[index + 1] - first_fold
    appearance = np.empty((count + folds, 4), np.float32)
    for k in range(count):
        name = fragments.names[first + k]
        if name >= 0:
            appearance[k, 0] = opacities[name]
            for channel in range(3):
                appearance[k, 1 + channel] = colors[name, channel]
        else:
            appearance[k, 0] = np.float32(1)
            for channel in range(3):
                appearance[k, 1 + channel] = fragments.solid[~name, channel]
    for k in range(folds):
        for column in range(4):
            appearance[count + k, column] = fragments.baked[first_fold + k, column]
    return appearance, count


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def render_fragments(fragments, opacities, colors, image):
    """Render the pixels that have fragments into `image`, without branching on baked layers."""
    tiles, _, _, _, starts, entries, falloffs, _, _, _, behind = fragments
    tiles_x = (behind.shape[1] + TILE - 1) // TILE
    zero, one = np.float32(0), np.float32(1)
    for index in range(len(tiles)):
        left, top = (tiles[index] % tiles_x) * TILE, (tiles[index] // tiles_x) * TILE
        appearance, count = _gather_appearance(fragments, index, opacities, colors)
        for pixel in range(TILE * TILE):
            begin, end = starts[index, pixel], starts[index, pixel + 1]
            if begin == end:
                continue
            y, x = top + pixel // TILE, left + pixel % TILE
            transmittance, red, green, blue = one, zero, zero, zero
            for place in range(begin, end):
                entry = entries[place]
                own, factor = entry < count, appearance[entry, 0]
                raw = factor * falloffs[place]
                alpha = min(raw, MAX_ALPHA) if raw >= MIN_ALPHA else zero
                after = transmittance * (one - alpha if own else factor)
                if own and after <= MIN_TRANSMITTANCE:
                    transmittance = zero
                    break
                weight, transmittance = transmittance * (alpha if own else one), after
                red += weight * appearance[entry, 1]
                green += weight * appearance[entry, 2]
                blue += weight * appearance[entry, 3]
            image[y, x, 0] = red + transmittance * behind[y, x, 0]
            image[y, x, 1] = green + transmittance * behind[y, x, 1]
            image[y, x, 2] = blue + transmittance * behind[y, x, 2]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def compare_fragments(fragments, image, wanted, weights, d_image, errors):
    """Compute squared errors and gradients of the pixels that have fragments.

    d_image [h, w, 3] float32 is written, and errors [tiles] float64: summed over all channels.
    """
    tiles, starts = fragments.tiles, fragments.pixel_start
    tiles_x = (image.shape[1] + TILE - 1) // TILE
    two = np.float32(2)
    for index in range(len(tiles)):
        left, top = (tiles[index] % tiles_x) * TILE, (tiles[index] // tiles_x) * TILE
        error = 0.0
        for pixel in range(TILE * TILE):
            if starts[index, pixel] == starts[index, pixel + 1]:
                continue
            y, x = top + pixel // TILE, left + pixel % TILE
            weight = weights[y, x]
            for channel in range(3):
                missed = image[y, x, channel] - wanted[y, x, channel]
                d_image[y, x, channel] = two * weight * missed
                error += weight * missed * missed
        errors[tiles[index]] = error


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def render_fragments_backward(fragments, opacities, colors, image, d_image, gradients, written):
    """Compute the gradients of the entries from those of the image, front to back.

    Content behind a fragment is the image less what precedes it. gradients [slots, 4]: opacity,
    colour.
    """
    tiles, entry_start, _, slots, starts, entries, falloffs, _, _, _, behind = fragments
    tiles_x = (behind.shape[1] + TILE - 1) // TILE
    zero, one = np.float32(0), np.float32(1)
    for index in range(len(tiles)):
        left, top = (tiles[index] % tiles_x) * TILE, (tiles[index] // tiles_x) * TILE
        appearance, count = _gather_appearance(fragments, index, opacities, colors)
        d_appearance = np.zeros(appearance.shape, np.float32)  # Those of baked layers are not used.
        for pixel in range(TILE * TILE):
            begin, end = starts[index, pixel], starts[index, pixel + 1]
            if begin == end:
                continue
            y, x = top + pixel // TILE, left + pixel % TILE
            d_red, d_green, d_blue = d_image[y, x, 0], d_image[y, x, 1], d_image[y, x, 2]
            if d_red == zero and d_green == zero and d_blue == zero:
                continue
            # Colour times gradient of the content behind
            rest = d_red * image[y, x, 0] + d_green * image[y, x, 1] + d_blue * image[y, x, 2]
            transmittance = one
            for place in range(begin, end):
                entry = entries[place]
                own, factor = entry < count, appearance[entry, 0]
                raw = factor * falloffs[place]
                alpha = min(raw, MAX_ALPHA) if raw >= MIN_ALPHA else zero
                after = transmittance * (one - alpha if own else factor)
                if own and after <= MIN_TRANSMITTANCE:
                    break
                weight = transmittance * (alpha if own else one)
                value = appearance[entry, 1] * d_red + appearance[entry, 2] * d_green
                value += appearance[entry, 3] * d_blue
                rest -= weight * value
                d_appearance[entry, 1] += weight * d_red
                d_appearance[entry, 2] += weight * d_green
                d_appearance[entry, 3] += weight * d_blue
                more = falloffs[place] * (transmittance * value - rest / (one - alpha))
                d_appearance[entry, 0] += more if alpha == raw else zero
                transmittance = after
        first = entry_start[index]
        for k in range(count):
            slot = slots[first + k]
            if slot >= 0:
                written[slot] = True
                for column in range(4):
                    gradients[slot, column] = d_appearance[k, column]


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def shade(begin, end, rows, center, means, sh, colors):
    """Compute the colours of the Gaussians rows[begin:end] as seen from `center`, from 0 up."""
    basis = np.empty(sh.shape[1], np.float32)
    half, zero = np.float32(0.5), np.float32(0)
    for index in range(begin, end):
        i = rows[index]
        x, y, z, _ = _compute_direction(center, means, i)
        _evaluate_basis(x, y, z, basis)
        for channel in range(3):
            color = half
            for k in range(len(basis)):
                color += basis[k] * sh[i, k, channel]
            colors[i, channel] = max(color, zero)


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def shade_backward(begin, end, rows, center, means, colors, d_colors, d_sh):
    """Compute gradients of the harmonics rows[begin:end]; colours cut off at 0 have none."""
    basis = np.empty(d_sh.shape[1], np.float32)
    for index in range(begin, end):
        i = rows[index]
        x, y, z, _ = _compute_direction(center, means, i)
        _evaluate_basis(x, y, z, basis)
        for channel in range(3):
            gradient = d_colors[i, channel] if colors[i, channel] > 0 else np.float32(0)
            for k in range(len(basis)):
                d_sh[i, k, channel] = gradient * basis[k]
