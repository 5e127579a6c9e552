"""Ray-box tests and samples of the CPU marcher.

Tests run on LANES rays or boxes at once, as LLVM vector code: one ray and many boxes, or one box and many rays. A box
is a lane of a table of TABLE_ROWS rows, relative to the middle ray of its tile; a ray is the difference of its
direction from the middle ray's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy import ndarray

from primdiffusion.primitives.primitives import WINDOW_SHARPNESS
from primdiffusion.render.cpu.compiled import TILE, index, part
from primdiffusion.render.cpu.vectors import add_sample, power_of_two

LANES = 8
"""Rays or boxes tested at once."""
# Rows of a table of boxes; box i is lane i % LANES of block i // LANES, so a row of a block is one vector.
AT_CENTRE, PER_STEP, TO_LOCAL, STEPS, LOW, HIGH, FIRST = 0, 3, 6, 15, 16, 19, 22
TABLE_ROWS = 23
# Rows of a block of hits: y at the reference point, dy per step, first and last step from that point.
ENTER, LEAVE = 6, 7
HIT_ROWS = 8

_compiled_call: Any = intrinsic  # untyped: callers omit the typing context and pass other types

_FLOAT, _INT32, _INT64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_LEAST_SLOPE = 1e-12
"""Slope of rays parallel to a face, which avoids division by zero; such rays still miss a box beside them."""


@_compiled_call
def hit_boxes(typingctx, hits, begin, table, block, dx, dy, dz):
    """Test one ray against the LANES boxes of the table from `block` on; return a bit mask of hits, lowest first.

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
    """Test LANES rays, from `first` on in rays [3, pixels], against the first box of the table; else as `hit_boxes`."""
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
    """Index of the lowest set bit; bits is not 0."""

    def generate(context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


class _Lanes:
    """Emits the test with an LLVM builder."""

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


SAMPLES = 8
"""Samples whose positions and weights are computed at once."""
PIXELS = TILE * TILE

_DECAY = np.float32(-WINDOW_SHARPNESS / math.log(2))
_EXPONENT = np.float32(-126)


class PackedBoxes(NamedTuple):
    """Boxes in the layout of the kernels. y = to_local (x - T) is in [-1, 1]^3 (SPEC 4)."""

    to_local: Float64[ndarray, "k 3 3"]
    offset: Float64[ndarray, "k 3"]
    """From each box's centre to the camera, metres."""
    stride: Int64[ndarray, "k"]
    nearest: Float64[ndarray, "k"]
    """Lower bound of the distance to the camera, metres; may be negative."""
    low: Float32[ndarray, "k 3"]
    """Bounds of the density in y: low and high per axis."""
    high: Float32[ndarray, "k 3"]
    voxels: Float32[ndarray, "floats"]
    """[k, d, h, w, (red, green, blue, density)], flat."""


@part()
def tile_rays(rays, pixel_to_world, row0, column0):
    """Fill rays [3, PIXELS] (flat) with each pixel's unit direction minus the middle one, which is returned."""
    m = pixel_to_world
    ux, uy, uz, vx, vy, vz = m[0, 0], m[1, 0], m[2, 0], m[0, 1], m[1, 1], m[2, 1]
    u, v = column0 + 0.5 * TILE, row0 + 0.5 * TILE
    cx, cy, cz = ux * u + vx * v + m[0, 2], uy * u + vy * v + m[1, 2], uz * u + vz * v + m[2, 2]
    inverse = 1.0 / math.sqrt(cx * cx + cy * cy + cz * cz)
    middle = (cx * inverse, cy * inverse, cz * inverse)
    for pixel in range(PIXELS):
        right, down = pixel % TILE + (0.5 - 0.5 * TILE), pixel // TILE + (0.5 - 0.5 * TILE)
        x, y, z = cx + right * ux + down * vx, cy + right * uy + down * vy, cz + right * uz + down * vz
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        rays[pixel] = x * inverse - middle[0]
        rays[PIXELS + pixel] = y * inverse - middle[1]
        rays[2 * PIXELS + pixel] = z * inverse - middle[2]
    return middle


@part()
def reference_point(boxes, k, middle, spacing):
    """The lattice index, a multiple of the box's stride, nearest to box k's centre on the tile's middle ray."""
    o = boxes.offset[k]
    step = boxes.stride[k] * spacing
    along = -(middle[0] * o[0] + middle[1] * o[1] + middle[2] * o[2])
    return max(np.int64(along / step + 0.5), 0) * boxes.stride[k]


@part(inline=True)
def tabulate(table, place, boxes, k, middle, reference, spacing):
    """Write the table entries of box k at `place`, relative to its reference point on the tile's middle ray."""
    stride = boxes.stride[k]
    distance, step = reference * spacing, stride * spacing
    x = boxes.offset[k, 0] + distance * middle[0]
    y = boxes.offset[k, 1] + distance * middle[1]
    z = boxes.offset[k, 2] + distance * middle[2]
    for axis in range(3):
        a, b, c = boxes.to_local[k, axis, 0], boxes.to_local[k, axis, 1], boxes.to_local[k, axis, 2]
        table[place + (AT_CENTRE + axis) * LANES] = a * x + b * y + c * z
        table[place + (PER_STEP + axis) * LANES] = step * (a * middle[0] + b * middle[1] + c * middle[2])
        table[place + (TO_LOCAL + 3 * axis) * LANES] = step * a
        table[place + (TO_LOCAL + 3 * axis + 1) * LANES] = step * b
        table[place + (TO_LOCAL + 3 * axis + 2) * LANES] = step * c
        table[place + (LOW + axis) * LANES] = boxes.low[k, axis]
        table[place + (HIGH + axis) * LANES] = boxes.high[k, axis]
    steps = reference // stride
    table[place + STEPS * LANES] = steps
    table[place + FIRST * LANES] = 1 - steps


@part()
def leave_empty(table, place):
    """Write a lane that no ray hits."""
    for row in range(TABLE_ROWS):
        table[place + row * LANES] = 0
    table[place + FIRST * LANES] = np.inf


@part(inline=True)
def place_samples(block, hits, hit, first, size, length):
    """Fill block [8, SAMPLES] (flat) with cells, weights and windows of SAMPLES samples from step `first` on.

    Lane `hit` of `hits` contains y at step 0 and dy per step (see `hit_boxes`). Rows of block: 0-3 the weights of a
    cell's edges, 4 and 5 those of an edge's ends, 6 window * length, 7 the cell's first voxel.
    """
    hit = index(hit)
    one = np.float32(1)
    width = np.float32(size)
    half, last = np.float32(0.5) * (width - one), width - np.float32(2)
    ex, ey, ez = hits[hit], hits[LANES + hit], hits[2 * LANES + hit]
    qx, qy, qz = hits[3 * LANES + hit], hits[4 * LANES + hit], hits[5 * LANES + hit]
    for j in range(SAMPLES):
        step = first + np.float32(j)
        x, y, z = ex + step * qx, ey + step * qy, ez + step * qz
        cu, fu = _cell(x, half, last)
        cv, fv = _cell(y, half, last)
        cw, fw = _cell(z, half, last)
        gv, gw = one - fv, one - fw
        block[j] = gv * gw
        block[SAMPLES + j] = fv * gw
        block[2 * SAMPLES + j] = gv * fw
        block[3 * SAMPLES + j] = fv * fw
        block[4 * SAMPLES + j] = one - fu
        block[5 * SAMPLES + j] = fu
        block[6 * SAMPLES + j] = length * _window(x, y, z)
        block[7 * SAMPLES + j] = (cw * width + cv) * width + cu


@part(inline=True)
def _cell(y, half, last):
    place = y * half + half
    cell = min(max(np.floor(place), np.float32(0)), last)
    return cell, place - cell


@part(inline=True)
def _window(x, y, z):
    """exp(-8 sum |y|^8), to 2e-7 relative."""
    x4, y4, z4 = x * x * (x * x), y * y * (y * y), z * z * (z * z)
    exponent = max(_DECAY * (x4 * x4 + y4 * y4 + z4 * z4), _EXPONENT)
    whole = np.floor(exponent)
    f = exponent - whole
    # 2^f on [0, 1), minimax; pairs have shorter dependency chains than Horner's rule.
    square = f * f
    low = np.float32(6.9315308e-1) * f + np.float32(9.9999994e-1)
    middle = np.float32(5.5826318e-2) * f + np.float32(2.4015361e-1)
    high = np.float32(1.8775767e-3) * f + np.float32(8.9893397e-3)
    return (low + square * (middle + square * high)) * power_of_two(whole)


@part(inline=True)
def add_segment(points, slot, slots, voxels, base, size, block, hits, hit, first, count, length):
    """Add `count` samples of one box, from step `first` on, to points[slot], points[slot + slots], ..."""
    row = size * 4
    slab = size * row
    for begin in range(0, count, SAMPLES):
        place_samples(block, hits, hit, first + np.float32(begin), size, length)
        for j in range(min(SAMPLES, count - begin)):
            corner = base + 4 * np.int64(block[7 * SAMPLES + j])
            add_sample(
                points, slot, voxels, corner, row, slab,
                block[j], block[SAMPLES + j], block[2 * SAMPLES + j], block[3 * SAMPLES + j],
                block[4 * SAMPLES + j], block[5 * SAMPLES + j], block[6 * SAMPLES + j],
            )  # fmt: skip
            slot += slots
