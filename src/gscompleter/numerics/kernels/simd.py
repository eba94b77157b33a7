"""Splats over the rows of a tile: vectors of 16 pixels in LLVM's intermediate language.

LLVM does not find these vectors itself, so the loops over rows are intrinsics.

A splat's falloff is `alpha = opacity * exp(-(s² + t²))` with whitened coordinates
`s = u dx + v dy`, `t = w dy` of the offset (dx, dy) from its centre, and `U = [[u, v], [0, w]]`,
`UᵀU = ½ Σ⁻¹` for the 2D covariance Σ. Unlike Σ⁻¹ it does not cancel for thin oblique splats.

A tile is composited front to back along the list of its splats; the `position` of a splat is that
in the list. A pixel is full when it has no transmittance left, and a row when its pixels are.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

TILE = 16
"""Side of a tile in pixels, and the number of lanes of a vector."""

MIN_ALPHA = np.float32(1 / 255)
"""Smallest alpha that is drawn."""
MAX_ALPHA = np.float32(0.999)
"""Largest alpha of a splat in a pixel."""
MIN_TRANSMITTANCE = np.float32(1e-4)
"""Transmittance at which a pixel is full."""

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_LONG = ir.IntType(64)
_FLOATS = ir.VectorType(_FLOAT, TILE)
_INTS = ir.VectorType(_INT, TILE)

# Least squares polynomial of 2**x on [-1, 0], highest power first: relative error 2e-7.
_EXP2 = (0.000938116473, 0.00918687438, 0.055278135, 0.240171588, 0.693142171, 0.999999923)
_LOG2_E = 1.4426950408889634


class _Lanes:
    """Sixteen values of a function under construction, float32 unless said otherwise."""

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
        """Compute self * factor + plus, rounded once where the CPU can, in both passes alike."""
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
        """Keep the lanes of a mask, and set the others."""
        value = self.builder.select(mask, self.value, self._unwrap(otherwise))
        return _Lanes(self.builder, value)


def _sum_lanes(builder, vectors):
    """Sum the lanes of each vector, of up to sixteen, into its own lane of the result."""
    # A tree of pairs: two vectors become one that holds the sums of both, with half as many lanes
    # each. Sixteen vectors take 15 additions instead of 16 times 4.
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
    return _Lanes(builder, values[0])


def _make_constant(value):
    return ir.Constant(_FLOATS, [float(np.float32(value))] * TILE)


def _broadcast(builder, scalar, vector_type=_FLOATS):
    undefined = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    lanes = builder.shuffle_vector(first, undefined, ir.Constant(_INTS, [0] * TILE))
    return _Lanes(builder, lanes)


def _exp_negative_lanes(values):
    """Compute exp(-values) for values >= 0; those above 83 give 2**-120, practically 0."""
    builder = values.builder
    # exp(-x) = 2**power, as the product of 2**whole and 2**fraction.
    power = values * -_LOG2_E
    power = power.where(power.compare(">", -120.0), -120.0)
    # Truncation leaves a fraction in (-1, 0], where the polynomial holds.
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
    """An array of a tile, whose rows are several vectors each."""

    def __init__(self, context, builder, array_type, array, vector_type, vectors_per_row):
        self.builder, self.vector_type = builder, vector_type
        self.data = context.make_array(array_type)(context, builder, array).data
        self.stride = vectors_per_row * TILE

    def _get_pointer(self, row, index):
        offset = self.builder.mul(row, ir.Constant(_LONG, self.stride))
        offset = self.builder.add(offset, ir.Constant(_LONG, index * TILE))
        pointer = self.builder.gep(self.data, [offset])
        return self.builder.bitcast(pointer, self.vector_type.as_pointer())

    # NumPy aligns arrays to their elements, not to whole vectors: hence the 4 bytes.
    def load(self, row, index):
        value = self.builder.load(self._get_pointer(row, index), align=4)
        return _Lanes(self.builder, value)

    def store(self, row, index, lanes):
        self.builder.store(lanes.value, self._get_pointer(row, index), align=4)


class _Total:
    """Sixteen sums, 0 at first."""

    def __init__(self, builder):
        self.builder = builder
        self.pointer = cgutils.alloca_once_value(builder, _make_constant(0.0))

    def load(self):
        return _Lanes(self.builder, self.builder.load(self.pointer))

    def store(self, lanes):
        self.builder.store(lanes.value, self.pointer)


class _Splat:
    """A splat relative to its tile, as the intrinsics receive it."""

    def __init__(self, builder, x, y, u, v, w, opacity, red, green, blue, depth):
        self.builder = builder
        self.y, self.v, self.w = y, v, w
        self.channels = [_broadcast(builder, value) for value in (red, green, blue, depth)]
        lane_numbers = ir.Constant(_FLOATS, [float(lane) for lane in range(TILE)])
        self.dx = _Lanes(builder, lane_numbers) - _broadcast(builder, x)
        self.u_dx = self.dx * _broadcast(builder, u)
        self.opacity = _broadcast(builder, opacity)

    def compute_falloff(self, row):
        """Return dy of a row, alpha before and after it is capped, and the mask of drawn lanes."""
        builder = self.builder
        dy = builder.fsub(builder.sitofp(row, _FLOAT), self.y)
        s = self.u_dx + _broadcast(builder, builder.fmul(self.v, dy))
        t = builder.fmul(self.w, dy)
        sigma = s.multiply_add(s, plus=_broadcast(builder, builder.fmul(t, t)))
        raw = self.opacity * _exp_negative_lanes(sigma)
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
    """Composite a splat over a row; return its weights, and masks of visible and passing lanes.

    With transmittance T, weight = alpha T and T' = T - alpha T. A pixel closes with the splat that
    would lower T to `MIN_TRANSMITTANCE`, which is not drawn; its T is kept with a minus sign.
    """
    _, _, alpha, visible = splat.compute_falloff(row)
    alpha = alpha.where(visible, 0.0)
    before = state.load(row, 0)
    after = alpha.multiply_add(0.0 - before, plus=before)
    passing = after.compare(">", MIN_TRANSMITTANCE)
    weight = (alpha * before).where(passing, 0.0)
    # The transmittance of a full pixel is negative already, so that no further splat passes.
    closed = before.where(before.compare("<", 0.0), 0.0 - before)
    state.store(row, 0, after.where(passing, closed))
    # The state has a sum for each of the first channels, three or four.
    for index, channel in enumerate(splat.channels[: state.stride // TILE - 1], start=1):
        state.store(row, index, weight.multiply_add(channel, plus=state.load(row, index)))
    return weight, visible, passing


def _close_if_full(builder, passing, limits, row, filled):
    """Set the limit of a row to -1 and count it in `filled` if no pixel let the splat pass."""
    any_passing = builder.bitcast(passing, ir.IntType(TILE))
    none = builder.icmp_unsigned("==", any_passing, ir.Constant(ir.IntType(TILE), 0))
    with builder.if_then(none, likely=False):
        builder.store(ir.Constant(_INT, -1), builder.gep(limits, [row]))
        builder.store(builder.add(builder.load(filled), ir.Constant(_LONG, 1)), filled)


@intrinsic
def composite_rows(typing, begin, end, position, state, last, row_limit, splat):
    """Composite a splat over the rows begin..end (excluded) of a tile; return how many it filled.

    state [16, 5, 16]: transmittances of a row, negative in full pixels; sums of colour and depth.
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
            last.store(row, 0, positions.where(contributes, last.load(row, 0)))
            _close_if_full(builder, passing, limits, row, filled)

        _loop_over_rows(builder, (begin, end), position, limits, composite_row)
        return builder.load(filled)

    return signature, generate


@intrinsic
def weigh_rows(typing, begin, end, place, state, row_limit, kept, splat):
    """Composite a splat, without depth, as `composite_rows`, and keep its weights.

    state [16, 4, 16] has no sum of depth. kept [rows, 16] receives the weights of begin..end from
    its row `place` on, zeros for full rows. row_limit [16] int32: 0, or -1 in full rows.
    """
    signature = types.int64(types.int64, types.int64, types.int64, state, row_limit, kept, splat)

    def generate(context, builder, signature, arguments):
        begin, end, place, state, row_limit, kept, splat = arguments
        splat = _Splat(builder, *cgutils.unpack_tuple(builder, splat))
        state = _Rows(context, builder, signature.args[3], state, _FLOATS, 4)
        limits = context.make_array(signature.args[4])(context, builder, row_limit).data
        kept = _Rows(context, builder, signature.args[5], kept, _FLOATS, 1)
        filled = cgutils.alloca_once_value(builder, ir.Constant(_LONG, 0))
        with cgutils.for_range(builder, end, start=begin, intp=_LONG) as loop:
            row = loop.index
            at = builder.add(place, builder.sub(loop.index, begin))
            limit = builder.load(builder.gep(limits, [row]))
            is_open = builder.icmp_signed(">=", limit, ir.Constant(_INT, 0))
            # Every row is written, since `kept` holds the weights of an earlier splat.
            with builder.if_else(is_open) as (open_row, full_row):
                with open_row:
                    weight, _, passing = _blend(splat, state, row)
                    kept.store(at, 0, weight)
                    _close_if_full(builder, passing, limits, row, filled)
                with full_row:
                    kept.store(at, 0, _Lanes(builder, _make_constant(0.0)))
        return builder.load(filled)

    return signature, generate


@intrinsic
def sum_weighted_rows(typing, begin, end, place, state, kept, sums):
    """Sum kept weights times the values in `state`, and kept weights, over rows begin..end.

    state [16, 4, 16]: three values after the transmittance. kept [rows, 16]: the weights from row
    `place` on. sums [16] receives the sums of the three channels, and that of the weights.
    """
    signature = types.void(types.int64, types.int64, types.int64, state, kept, sums)

    def generate(context, builder, signature, arguments):
        begin, end, place, state, kept, sums = arguments
        state = _Rows(context, builder, signature.args[3], state, _FLOATS, 4)
        kept = _Rows(context, builder, signature.args[4], kept, _FLOATS, 1)
        totals = [_Total(builder) for _ in range(4)]
        with cgutils.for_range(builder, end, start=begin, intp=_LONG) as loop:
            at = builder.add(place, builder.sub(loop.index, begin))
            weight = kept.load(at, 0)
            for index, total in enumerate(totals[:3], start=1):
                value = state.load(loop.index, index)
                total.store(weight.multiply_add(value, plus=total.load()))
            totals[3].store(totals[3].load() + weight)
        out = _Rows(context, builder, signature.args[5], sums, _FLOATS, 1)
        columns = [total.load() for total in totals]
        out.store(ir.Constant(_LONG, 0), 0, _sum_lanes(builder, columns))
        return context.get_dummy_value()

    return signature, generate


def _make_revert(wanted):
    """Make an intrinsic that reverts a splat, with the sums of its `wanted` gradients.

    "nothing" sums none, and "colour" only weight times dL/d red, green and blue.
    """

    @intrinsic
    def undraw_rows(typing, begin, end, position, state, last, row_limit, sums, splat):
        """Revert the rows begin..end of the frontmost splat that is left.

        Splats are reverted back to front. last [16, 16] int32: position of the last contribution to
        a pixel; row_limit [16] int32: the largest of a row.
        state [16, 7, 16]: per row the transmittance and the sum of weight times gradient behind the
        splat, and dL/d of red, green, blue, depth sum and alpha. sums [16] receives the sums of q,
        q dx, q dy, q dx², q dx dy, q dy² (q = alpha dL/dalpha), and of weight times dL/d depth,
        red, green and blue.
        """
        arrays = state, last, row_limit, sums
        signature = types.void(types.int64, types.int64, types.int32, *arrays, splat)

        def generate(context, builder, signature, arguments):
            begin, end, position, state, last, row_limit, sums, splat = arguments
            splat = _Splat(builder, *cgutils.unpack_tuple(builder, splat))
            state = _Rows(context, builder, signature.args[3], state, _FLOATS, 7)
            last = _Rows(context, builder, signature.args[4], last, _INTS, 1)
            limits = context.make_array(signature.args[5])(context, builder, row_limit).data
            positions = _broadcast(builder, position, _INTS)
            count = {"nothing": 0, "colour": 3, "all": 7}[wanted]
            totals = [_Total(builder) for _ in range(count)]

            def revert(row):
                dy, raw, alpha, visible = splat.compute_falloff(row)
                reached = builder.icmp_signed("<=", positions.value, last.load(row, 0).value)
                contributes = builder.and_(visible, reached)
                alpha = alpha.where(contributes, 0.0)
                gradients = [state.load(row, index) for index in range(2, 7)]
                behind = state.load(row, 1)

                # Back to front, T before a splat is T behind it over 1 - alpha. With c the gradient
                # of the loss along the splat's channels (`value`) and B the sum of weight times c
                # behind it, dL/dalpha = T c - B / (1 - alpha).
                inverse_passing = 1.0 / (1.0 - alpha)
                before = state.load(row, 0) * inverse_passing
                weight = alpha * before
                value = gradients[4]
                for channel, gradient in zip(splat.channels, gradients[:4], strict=True):
                    value = channel.multiply_add(gradient, plus=value)
                state.store(row, 0, before)
                state.store(row, 1, weight.multiply_add(value, plus=behind))
                if wanted == "nothing":
                    return

                if wanted == "colour":
                    for total, gradient in zip(totals, gradients[:3], strict=True):
                        total.store(weight.multiply_add(gradient, plus=total.load()))
                    return

                q = (before * value - behind * inverse_passing) * alpha
                # A capped alpha does not depend on the splat.
                q = q.where(raw.compare("<=", MAX_ALPHA), 0.0)
                dys = _broadcast(builder, dy)
                terms = [q, q * dys, q * dys * dys]
                terms += [weight * gradients[index] for index in (3, 0, 1, 2)]
                for total, term in zip(totals, terms, strict=True):
                    total.store(total.load() + term)

            _loop_over_rows(builder, (begin, end), position, limits, revert)

            # dx is the same in all rows of a lane, so that the moments in it are made once, here.
            columns = [total.load() for total in totals]
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


# Splats of the context have no gradients, but those in front of them need the state before them.
pass_rows = _make_revert("nothing")
revert_rows_for_color = _make_revert("colour")
revert_rows = _make_revert("all")


def _make_revert_for_opacity(is_summed):
    """Make an intrinsic that reverts a splat for several images, with or without its sums."""

    @intrinsic
    def undraw_images(
        typing, begin, end, position, count, passing, behinds, images, last, row_limit, sums, splat
    ):
        """Revert the rows begin..end of the frontmost splat that is left, for `count` images dL/dC.

        What depends on the splat alone, its falloff above all, is computed once for all images, and
        every sum is that of `revert_rows` with the image alone.
        passing [16, 16]: transmittances behind the splat. behinds [16 count, 16], row by row, image
        by image: the sum of weight times dL/dC behind it. images [16 count, 3, 16]: dL/dC.
        sums [count, 16] receives the sum of alpha dL/dalpha of each image in its first lane.
        """
        arrays = passing, behinds, images, last, row_limit, sums
        numbers = types.int64, types.int64, types.int32, types.int64
        signature = types.void(*numbers, *arrays, splat)

        def generate(context, builder, signature, arguments):
            begin, end, position, count, *arrays, row_limit, sums, splat = arguments
            splat = _Splat(builder, *cgutils.unpack_tuple(builder, splat))
            types_of_arrays = signature.args[4:10]
            forms = (_FLOATS, 1), (_FLOATS, 1), (_FLOATS, 3), (_INTS, 1)
            passing, behinds, images, last = [
                _Rows(context, builder, array_type, array, *form)
                for array_type, array, form in zip(types_of_arrays[:4], arrays, forms, strict=True)
            ]
            limits = context.make_array(types_of_arrays[4])(context, builder, row_limit).data
            sums = _Rows(context, builder, types_of_arrays[5], sums, _FLOATS, 1)
            positions = _broadcast(builder, position, _INTS)
            zero = ir.Constant(_LONG, 0)
            if is_summed:
                with cgutils.for_range(builder, count, start=zero, intp=_LONG) as image:
                    sums.store(image.index, 0, _Lanes(builder, _make_constant(0.0)))

            def revert(row):
                _, raw, alpha, visible = splat.compute_falloff(row)
                reached = builder.icmp_signed("<=", positions.value, last.load(row, 0).value)
                alpha = alpha.where(builder.and_(visible, reached), 0.0)
                inverse_passing = 1.0 / (1.0 - alpha)
                before = passing.load(row, 0) * inverse_passing
                weight = alpha * before
                passing.store(row, 0, before)
                # A capped alpha does not depend on the splat.
                is_uncapped = raw.compare("<=", MAX_ALPHA)
                first = builder.mul(row, count)
                with cgutils.for_range(builder, count, start=zero, intp=_LONG) as image:
                    place = builder.add(first, image.index)
                    value = splat.channels[0] * images.load(place, 0)
                    for index in (1, 2):
                        gradient = images.load(place, index)
                        value = splat.channels[index].multiply_add(gradient, plus=value)
                    behind = behinds.load(place, 0)
                    behinds.store(place, 0, weight.multiply_add(value, plus=behind))
                    if is_summed:
                        q = (before * value - behind * inverse_passing) * alpha
                        total = sums.load(image.index, 0) + q.where(is_uncapped, 0.0)
                        sums.store(image.index, 0, total)

            _loop_over_rows(builder, (begin, end), position, limits, revert)
            if is_summed:
                with cgutils.for_range(builder, count, start=zero, intp=_LONG) as image:
                    total = _sum_lanes(builder, [sums.load(image.index, 0)])
                    sums.store(image.index, 0, total)
            return context.get_dummy_value()

        return signature, generate

    return undraw_images


pass_images = _make_revert_for_opacity(is_summed=False)
revert_images = _make_revert_for_opacity(is_summed=True)
