"""Vector operations that numba lacks: four channels and two voxels in one vector register.

Voxels are stored [d, h, w, channel] with the channels (red, green, blue, density), so the two voxels of a cell's edge
along w are eight contiguous floats. The functions below emit LLVM vector code, so a cell's corners take four loads
instead of thirty-two, which numba's own vectoriser does not achieve.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS

_compiled_call: Any = intrinsic  # untyped: callers omit the typing context and pass other types

FLOAT, INT32, INT64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
FOUR, EIGHT = ir.VectorType(FLOAT, 4), ir.VectorType(FLOAT, 8)
_WINDOW_SLOPE = FLOAT(-WINDOW_SHARPNESS * WINDOW_POWER)
"""d log(window) / dy = _WINDOW_SLOPE * y ** (WINDOW_POWER - 1)."""


@_compiled_call
def power_of_two(typingctx, exponent):
    """2 ** exponent for an integral float32 in -126 ... 127."""

    def generate(context, builder, signature, arguments):
        bits = builder.shl(builder.add(builder.fptosi(arguments[0], INT32), INT32(127)), INT32(23))
        return builder.bitcast(bits, FLOAT)

    return types.float32(types.float32), generate


@_compiled_call
def add_sample(typingctx, points, slot, voxels, corner, row, slab, w00, w01, w10, w11, gu, fu, length):
    """points[slot] += (a * red, a * green, a * blue, a), a = density * length, of one trilinear sample.

    `corner` is the cell's first float in `voxels`, `row` and `slab` the floats to the next voxel along h and d; wdh are
    the weights of the cell's four edges along w, gu and fu those of an edge's ends.
    """
    weights = (types.float32,) * 7
    signature = types.void(points, types.int64, voxels, types.int64, types.int64, types.int64, *weights)

    def generate(context, builder, signature, arguments):
        points, slot, voxels, *place, w00, w01, w10, w11, gu, fu, length = arguments
        code = Vectors(builder)
        edges = code.edges(code.data(context, signature.args[2], voxels), *place)
        edge = code.weighted(edges, [code.splat(weight, EIGHT) for weight in (w00, w01, w10, w11)])
        value = code.between(edge, gu, fu)
        opacity = code.multiply(code.lane(value, 3), code.splat(length, FOUR))
        value = builder.insert_element(value, FLOAT(1), INT32(3))
        code.accumulate(
            code.data(context, signature.args[0], points),
            builder.mul(slot, INT64(4)),
            code.multiply(value, opacity),
        )
        return context.get_dummy_value()

    return signature, generate


@_compiled_call
def adjoin_sample(
    typingctx, gradient, slopes, path, voxels, base, corner, row, slab, w00, w01, w10, w11, gu, fu, length, half,
    red, green, blue, constant, step,
):  # fmt: skip
    """The adjoint of one sample with dL/da = <colour, (red, green, blue)> + constant.

    The box's voxels begin at `base`; its gradient, laid out like them, receives dL/d(voxels). path [2, 4] holds the
    ray: y = path[0] + step * path[1]. slopes [2, 4] receives dL/dy and the same times `step`; `half` are the voxels per
    y. Weights as in `add_sample`. An empty gradient or empty slopes are not written.
    """
    numbers = (types.float32,) * 13
    signature = types.void(gradient, slopes, path, voxels, *(types.int64,) * 4, *numbers)

    def generate(context, builder, signature, arguments):
        gradient, slopes, path, voxels, base, corner, row, slab, *numbers = arguments
        w00, w01, w10, w11, gu, fu, length, half, *cotangent, constant, step = numbers
        code = Vectors(builder)
        weights = [code.splat(weight, EIGHT) for weight in (w00, w01, w10, w11)]
        edges = code.edges(code.data(context, signature.args[3], voxels), builder.add(base, corner), row, slab)
        edge = code.weighted(edges, weights)
        value = code.between(edge, gu, fu)

        g = code.vector([*cotangent, FLOAT(0)])
        density = builder.extract_element(value, INT32(3))
        opacity = builder.fmul(density, length)
        worth = builder.fadd(code.total(code.multiply(value, g)), constant)
        bar = code.multiply(g, code.splat(opacity, FOUR))
        bar = builder.insert_element(bar, builder.fmul(worth, length), INT32(3))
        bars = code.multiply(code.twice(bar), code.ends(gu, fu))

        array = context.make_array(signature.args[0])(context, builder, gradient)
        with builder.if_then(builder.icmp_signed(">", array.nitems, INT64(0))):
            places = [corner, builder.add(corner, row), builder.add(corner, slab)]
            places.append(builder.add(places[2], row))
            for place, weight in zip(places, weights, strict=True):
                code.accumulate(array.data, place, code.multiply(bars, weight))
        array = context.make_array(signature.args[1])(context, builder, slopes)
        # Without density, the position has no gradient.
        dense = builder.fcmp_ordered(">", density, FLOAT(0))
        with builder.if_then(builder.and_(dense, builder.icmp_signed(">", array.nitems, INT64(0)))):
            v, w = builder.fadd(w01, w11), builder.fadd(w10, w11)
            slope = code.multiply(code.slope(bar, bars, edge, edges, v, w), code.splat(half, FOUR))
            y = code.point(code.data(context, signature.args[2], path), step)
            fade = code.multiply(code.seventh_power(y), code.splat(builder.fmul(worth, opacity), FOUR))
            slope = code.add(slope, code.multiply(fade, code.splat(_WINDOW_SLOPE, FOUR)))
            code.accumulate(array.data, INT64(0), slope)
            code.accumulate(array.data, INT64(4), code.multiply(slope, code.splat(step, FOUR)))
        return context.get_dummy_value()

    return signature, generate


class Vectors:
    """Vector operations of both functions, emitted with an LLVM builder."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    @staticmethod
    def lanes(*lanes):
        return ir.Constant(ir.VectorType(INT32, len(lanes)), list(lanes))

    def data(self, context, kind, array):
        return context.make_array(kind)(context, self.builder, array).data

    def _vector_at(self, data, place, kind):
        return self.builder.bitcast(self.builder.gep(data, [place]), kind.as_pointer())

    def four_at(self, data, place, stride):
        """Four floats from data[place * stride] on."""
        return self.builder.load(self._vector_at(data, self.builder.mul(place, INT64(stride)), FOUR), align=4)

    def edges(self, data, corner, row, slab):
        """The cell's four edges along w: (h, d) = (0, 0), (1, 0), (0, 1), (1, 1)."""
        back = self.builder.add(corner, slab)
        places = (corner, self.builder.add(corner, row), back, self.builder.add(back, row))
        return [self.builder.load(self._vector_at(data, place, EIGHT), align=4) for place in places]

    def accumulate(self, data, place, value):
        pointer = self._vector_at(data, place, value.type)
        self.builder.store(self.add(self.builder.load(pointer, align=4), value), pointer, align=4)

    def multiply(self, a, b):
        return self.builder.fmul(a, b, flags=("contract",))

    def add(self, a, b):
        return self.builder.fadd(a, b, flags=("contract",))

    def subtract(self, a, b):
        return self.builder.fsub(a, b, flags=("contract",))

    def splat(self, value, kind):
        first = self.builder.insert_element(ir.Constant(kind, ir.Undefined), value, INT32(0))
        return self._shuffled(first, *[0] * kind.count)

    def vector(self, values):
        result = ir.Constant(FOUR, ir.Undefined)
        for place, value in enumerate(values):
            result = self.builder.insert_element(result, value, INT32(place))
        return result

    def _shuffled(self, value, *lanes):
        return self.builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), self.lanes(*lanes))

    def lane(self, value, lane):
        return self._shuffled(value, *[lane] * 4)

    def half(self, value, which):
        return self._shuffled(value, *range(4 * which, 4 * which + 4))

    def twice(self, value):
        return self._shuffled(value, *range(4), *range(4))

    def folded(self, value):
        return self.builder.fadd(self.half(value, 0), self.half(value, 1))

    def ends(self, gu, fu):
        return self.builder.shuffle_vector(
            self.splat(gu, FOUR), self.splat(fu, FOUR), self.lanes(0, 0, 0, 0, 4, 4, 4, 4)
        )

    def between(self, edge, gu, fu):
        return self.add(
            self.multiply(self.half(edge, 0), self.splat(gu, FOUR)),
            self.multiply(self.half(edge, 1), self.splat(fu, FOUR)),
        )

    def weighted(self, edges, weights):
        result = self.multiply(edges[0], weights[0])
        for edge, weight in zip(edges[1:], weights[1:], strict=True):
            result = self.add(result, self.multiply(edge, weight))
        return result

    def mix(self, a, b, share):
        """a + share * (b - a)."""
        return self.add(a, self.multiply(self.subtract(b, a), self.splat(share, a.type)))

    def slope(self, bar, bars, edge, edges, v, w):
        """Derivative of the loss in the cell's coordinates (u, v, w), from `bar`, dL/d(value)."""
        near, up, far, far_up = edges
        along_u = self.multiply(bar, self.subtract(self.half(edge, 1), self.half(edge, 0)))
        rise = self.mix(self.subtract(up, near), self.subtract(far_up, far), w)
        depth = self.mix(self.subtract(far, near), self.subtract(far_up, up), v)
        along_v, along_w = self.folded(self.multiply(bars, rise)), self.folded(self.multiply(bars, depth))
        return self.totals(along_u, along_v, along_w)

    def point(self, path, step):
        """path[0] + step * path[1]."""
        first, per_step = (self.builder.load(self._vector_at(path, INT64(place), FOUR), align=4) for place in (0, 4))
        return self.add(first, self.multiply(per_step, self.splat(step, FOUR)))

    def seventh_power(self, y):
        cube = self.multiply(self.multiply(y, y), y)
        return self.multiply(self.multiply(cube, cube), y)

    def totals(self, a, b, c):
        """Sums over the lanes of a, b and c, and 0."""
        none = ir.Constant(FOUR, [0.0] * 4)
        ab, cd = self._paired(a, b, (0, 4, 1, 5), (2, 6, 3, 7)), self._paired(c, none, (0, 4, 1, 5), (2, 6, 3, 7))
        return self._paired(ab, cd, (0, 1, 4, 5), (2, 3, 6, 7))

    def _paired(self, a, b, left, right):
        first = self.builder.shuffle_vector(a, b, self.lanes(*left))
        return self.builder.fadd(first, self.builder.shuffle_vector(a, b, self.lanes(*right)))

    def total(self, value):
        pairs = self.builder.fadd(value, self._shuffled(value, 2, 3, 0, 1))
        both = self.builder.fadd(pairs, self._shuffled(pairs, 1, 0, 3, 2))
        return self.builder.extract_element(both, INT32(0))
