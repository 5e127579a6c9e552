"""What numba's language lacks and the marcher lives on: four channels and two voxels as one vector register.

Voxels are stored [d, h, w, channel] with the channels (red, green, blue, density), so the two voxels of a cell's edge
along w are eight floats in a row. The functions below are LLVM vector code, for any processor LLVM knows; a cell's
corners are then four loads instead of thirty-two, which numba's own vectoriser does not find.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_compiled_call: Any = intrinsic  # its callers do not give the typing context, nor see the real types

_FLOAT, _INT32, _INT64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FOUR, _EIGHT = ir.VectorType(_FLOAT, 4), ir.VectorType(_FLOAT, 8)


@_compiled_call
def power_of_two(typingctx, exponent):
    """2 ** exponent for a whole-numbered float32 in -126 ... 127."""

    def generate(context, builder, signature, arguments):
        bits = builder.shl(builder.add(builder.fptosi(arguments[0], _INT32), _INT32(127)), _INT32(23))
        return builder.bitcast(bits, _FLOAT)

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
        code = _Vectors(builder)
        edges = code.edges(code.data(context, signature.args[2], voxels), *place)
        edge = code.multiply(edges[0], code.splat(w00, _EIGHT))
        for other, weight in zip(edges[1:], (w01, w10, w11), strict=True):
            edge = code.add(edge, code.multiply(other, code.splat(weight, _EIGHT)))
        value = code.between(edge, gu, fu)
        opacity = code.multiply(code.lane(value, 3), code.splat(length, _FOUR))
        value = builder.insert_element(value, _FLOAT(1), _INT32(3))
        code.accumulate(
            code.data(context, signature.args[0], points),
            builder.mul(slot, _INT64(4)),
            code.multiply(value, opacity),
        )
        return context.get_dummy_value()

    return signature, generate


@_compiled_call
def adjoin_sample(
    typingctx, gradient, slopes, voxels, base, corner, row, slab, v, w, gu, fu, length, red, green, blue, constant, step
):
    """The adjoint of one sample: returns a * dL/da.

    dL/da = <colour, (red, green, blue)> + constant. The box's voxels begin at `base`; its gradient, laid out like them,
    receives dL/d(voxels); slopes [2, 4] receives dL/d(u, v, w) and the same times `step`. v and w are the sample's
    fractions along h and d. An empty gradient or empty slopes are not written.
    """
    numbers = (types.float32,) * 10
    signature = types.float32(gradient, slopes, voxels, *(types.int64,) * 4, *numbers)

    def generate(context, builder, signature, arguments):
        gradient, slopes, voxels, base, corner, row, slab, v, w, gu, fu, length, *cotangent, constant, step = arguments
        code = _Vectors(builder)
        first = builder.add(base, corner)
        near, up, far, far_up = code.edges(code.data(context, signature.args[2], voxels), first, row, slab)
        one = _FLOAT(1)
        gv, gw = builder.fsub(one, v), builder.fsub(one, w)
        front = code.mix(near, up, gv, v)
        back = code.mix(far, far_up, gv, v)
        edge = code.mix(front, back, gw, w)
        value = code.between(edge, gu, fu)

        g = code.vector([*cotangent, _FLOAT(0)])
        opacity = builder.fmul(builder.extract_element(value, _INT32(3)), length)
        per_opacity = builder.fadd(code.total(code.multiply(value, g)), constant)
        bar = code.multiply(g, code.splat(opacity, _FOUR))
        bar = builder.insert_element(bar, builder.fmul(per_opacity, length), _INT32(3))
        bars = code.multiply(code.twice(bar), code.ends(gu, fu))

        array = context.make_array(signature.args[0])(context, builder, gradient)
        with builder.if_then(builder.icmp_signed(">", array.nitems, _INT64(0))):
            places = [corner, builder.add(corner, row), builder.add(corner, slab)]
            places.append(builder.add(places[2], row))
            for place, pair in zip(places, ((gv, gw), (v, gw), (gv, w), (v, w)), strict=True):
                weight = builder.fmul(*pair)
                code.accumulate(array.data, place, code.multiply(bars, code.splat(weight, _EIGHT)))
        array = context.make_array(signature.args[1])(context, builder, slopes)
        with builder.if_then(builder.icmp_signed(">", array.nitems, _INT64(0))):
            along_u = code.multiply(bar, builder.fsub(code.half(edge, 1), code.half(edge, 0)))
            rise = code.mix(builder.fsub(up, near), builder.fsub(far_up, far), gw, w)
            along_v = code.folded(code.multiply(bars, rise))
            along_w = code.folded(code.multiply(bars, builder.fsub(back, front)))
            slope = code.totals(along_u, along_v, along_w)
            code.accumulate(array.data, _INT64(0), slope)
            code.accumulate(array.data, _INT64(4), code.multiply(slope, code.splat(step, _FOUR)))
        return builder.fmul(per_opacity, opacity)

    return signature, generate


class _Vectors:
    """The few vector operations of both functions, written into one LLVM builder."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder

    @staticmethod
    def _lanes(*lanes):
        return ir.Constant(ir.VectorType(_INT32, len(lanes)), list(lanes))

    def data(self, context, kind, array):
        return context.make_array(kind)(context, self.builder, array).data

    def _vector_at(self, data, place, kind):
        return self.builder.bitcast(self.builder.gep(data, [place]), kind.as_pointer())

    def edges(self, data, corner, row, slab):
        """The cell's four edges along w: (h, d) = (0, 0), (1, 0), (0, 1), (1, 1)."""
        back = self.builder.add(corner, slab)
        places = (corner, self.builder.add(corner, row), back, self.builder.add(back, row))
        return [self.builder.load(self._vector_at(data, place, _EIGHT), align=4) for place in places]

    def accumulate(self, data, place, value):
        pointer = self._vector_at(data, place, value.type)
        self.builder.store(self.add(self.builder.load(pointer, align=4), value), pointer, align=4)

    def multiply(self, a, b):
        return self.builder.fmul(a, b, flags=("contract",))

    def add(self, a, b):
        return self.builder.fadd(a, b, flags=("contract",))

    def splat(self, value, kind):
        first = self.builder.insert_element(ir.Constant(kind, ir.Undefined), value, _INT32(0))
        return self._shuffled(first, *[0] * kind.count)

    def vector(self, values):
        result = ir.Constant(_FOUR, ir.Undefined)
        for place, value in enumerate(values):
            result = self.builder.insert_element(result, value, _INT32(place))
        return result

    def _shuffled(self, value, *lanes):
        return self.builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), self._lanes(*lanes))

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
            self.splat(gu, _FOUR), self.splat(fu, _FOUR), self._lanes(0, 0, 0, 0, 4, 4, 4, 4)
        )

    def between(self, edge, gu, fu):
        return self.add(
            self.multiply(self.half(edge, 0), self.splat(gu, _FOUR)),
            self.multiply(self.half(edge, 1), self.splat(fu, _FOUR)),
        )

    def mix(self, a, b, at_a, at_b):
        return self.add(self.multiply(a, self.splat(at_a, _EIGHT)), self.multiply(b, self.splat(at_b, _EIGHT)))

    def totals(self, a, b, c):
        """The sums over the lanes of a, of b and of c, and 0."""
        none = ir.Constant(_FOUR, [0.0] * 4)
        ab, cd = self._paired(a, b, (0, 4, 1, 5), (2, 6, 3, 7)), self._paired(c, none, (0, 4, 1, 5), (2, 6, 3, 7))
        return self._paired(ab, cd, (0, 1, 4, 5), (2, 3, 6, 7))

    def _paired(self, a, b, left, right):
        first = self.builder.shuffle_vector(a, b, self._lanes(*left))
        return self.builder.fadd(first, self.builder.shuffle_vector(a, b, self._lanes(*right)))

    def total(self, value):
        pairs = self.builder.fadd(value, self._shuffled(value, 2, 3, 0, 1))
        both = self.builder.fadd(pairs, self._shuffled(pairs, 1, 0, 3, 2))
        return self.builder.extract_element(both, _INT32(0))
