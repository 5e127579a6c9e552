"""Where rays enter and leave boxes, LANES of them at once, as LLVM vector code: one ray and many boxes, or the reverse.

A box is LANES rows of a table, by which `tabulate` describes it as seen along a tile's middle ray; a ray is how its
direction differs from that one.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
"""Rays or boxes that are tested together."""
# Rows of a table of boxes; box i is lane i % LANES of block i // LANES, so a row of a block is one vector.
AT_CENTRE, PER_STEP, TO_LOCAL, STEPS, LOW, HIGH, FIRST = 0, 3, 6, 15, 16, 19, 22
TABLE_ROWS = 23
# Rows of a block of hits: y at the reference point, dy per step, first and last step from that point.
ENTER, LEAVE = 6, 7
HIT_ROWS = 8

_compiled_call: Any = intrinsic  # its callers do not give the typing context, nor see the real types

_FLOAT, _INT32, _INT64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_LEAST_SLOPE = 1e-12
"""What a ray parallel to a face gets instead of a division by zero; beside the box it then still misses."""


@_compiled_call
def hit_boxes(typingctx, hits, begin, table, block, dx, dy, dz):
    """One ray against the LANES boxes of the table from `block` on; returns which it hits, as bits, the lowest first.

    Fills hits [HIT_ROWS, LANES] from `begin` on.
    """
    signature = types.int64(hits, types.int64, table, types.int64, *(types.float32,) * 3)

    def generate(context, builder, signature, arguments):
        hits, begin, table, block, *ray = arguments
        code = _Lanes(context, builder)
        table, hits = code.place(signature.args[2], table, block), code.place(signature.args[0], hits, begin)
        return code.test(hits, [code.splat(d) for d in ray], lambda row: code.load(table, row * LANES))

    return signature, generate


@_compiled_call
def hit_rays(typingctx, hits, table, rays, first, pixels):
    """The LANES rays from `first` on of rays [3, pixels] against the table's first box; otherwise as `hit_boxes`."""
    signature = types.int64(hits, table, rays, types.int64, types.int64)

    def generate(context, builder, signature, arguments):
        hits, table, rays, first, pixels = arguments
        code = _Lanes(context, builder)
        zero = _INT64(0)
        table, hits = code.place(signature.args[1], table, zero), code.place(signature.args[0], hits, zero)
        places = [builder.add(first, builder.mul(pixels, _INT64(axis))) for axis in range(3)]
        ray = [code.load(code.place(signature.args[2], rays, place), 0) for place in places]
        return code.test(hits, ray, lambda row: code.splat(builder.load(builder.gep(table, [_INT64(row * LANES)]))))

    return signature, generate


@_compiled_call
def lowest(typingctx, bits):
    """The place of the lowest bit that is set; bits is not 0."""

    def generate(context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


class _Lanes:
    """The test, written into one LLVM builder."""

    def __init__(self, context: Any, builder: Any) -> None:
        self.context, self.builder = context, builder

    def place(self, kind, array, index):
        return self.builder.gep(self.context.make_array(kind)(self.context, self.builder, array).data, [index])

    def load(self, data, index):
        pointer = self.builder.gep(data, [_INT64(index)])
        return self.builder.load(self.builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)

    def splat(self, value):
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = self.builder.insert_element(undefined, value, _INT32(0))
        return self.builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INT32, LANES), [0] * LANES))

    def _constant(self, value):
        return ir.Constant(_VECTOR, [value] * LANES)

    def _call(self, name, value):
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.v{LANES}f32")
        return self.builder.call(function, [value])

    def _less(self, a, b):
        return self.builder.select(self.builder.fcmp_ordered("<", a, b), a, b)

    def _more(self, a, b):
        return self.builder.select(self.builder.fcmp_ordered(">", a, b), a, b)

    def _multiplied(self, a, b, onto):
        product = self.builder.fmul(a, b, flags=("contract",))
        return product if onto is None else self.builder.fadd(onto, product, flags=("contract",))

    def _axis(self, ray, row, axis):
        """y at the reference point and per step, and the steps at which the ray passes the box's two faces."""
        builder, along = self.builder, None
        for other in range(3):
            along = self._multiplied(row(TO_LOCAL + 3 * axis + other), ray[other], along)
        q = builder.fadd(row(PER_STEP + axis), along)
        e = self._multiplied(row(STEPS), along, row(AT_CENTRE + axis))
        steep = builder.fcmp_ordered(">", self._call("fabs", q), self._constant(_LEAST_SLOPE))
        inverse = builder.fdiv(self._constant(1.0), builder.select(steep, q, self._constant(_LEAST_SLOPE)))
        a, b = (builder.fmul(builder.fsub(row(face + axis), e), inverse) for face in (LOW, HIGH))
        return e, q, self._less(a, b), self._more(a, b)

    def test(self, hits, ray, row):
        builder = self.builder
        y, per_step, enter, leave = zip(*(self._axis(ray, row, axis) for axis in range(3)), strict=True)
        first = self._more(self._more(enter[0], enter[1]), self._more(enter[2], row(FIRST)))
        last = self._less(self._less(leave[0], leave[1]), leave[2])
        first, last = self._call("ceil", first), self._call("floor", last)
        for place, value in enumerate((*y, *per_step, first, last)):
            pointer = builder.gep(hits, [_INT64(place * LANES)])
            builder.store(value, builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)
        hit = builder.fcmp_ordered("<=", first, last)
        return builder.zext(builder.bitcast(hit, ir.IntType(LANES)), _INT64)
