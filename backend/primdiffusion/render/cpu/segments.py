"""Vector code for stored derivatives (`cpu_linear`): merging samples, and products over the entries of a segment.

An entry has a voxel and five weights, (red, green, blue, alpha) by density and then colour by colour; the products keep
four columns in one register.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from primdiffusion.render.cpu.vectors import EIGHT, FLOAT, FOUR, INT32, INT64, Vectors

_compiled_call: Any = intrinsic  # untyped: callers omit the typing context and pass other types

_NONE = ir.Constant(FOUR, [0.0] * 4)
WIDTH = 8
"""Floats of a voxel's merged weights: five, padded to a register."""


@_compiled_call
def merge_sample(
    typingctx, sums, voxels, base, corner, size, slab, w00, w01, w10, w11, gu, fu, opacity, red, green, blue
):  # fmt: skip
    """Add one sample's weights to those of its eight voxels, sums [voxels of a box, WIDTH].

    The box's voxels begin at `base`; `corner` is the cell's first voxel, `opacity` the sample's at a density of 1 per
    metre, (red, green, blue) the colour behind it. Weights as in `add_sample`.
    """
    signature = types.void(sums, voxels, *(types.int64,) * 4, *(types.float32,) * 10)

    def generate(context, builder, signature, arguments):
        sums, voxels, base, corner, size, slab, *numbers, opacity, red, green, blue = arguments
        code = Vectors(builder)
        *weights, gu, fu = numbers
        four = INT64(4)
        first = builder.add(base, builder.mul(corner, four))
        edges = code.edges(
            code.data(context, signature.args[1], voxels), first, builder.mul(size, four), builder.mul(slab, four)
        )
        value = code.between(code.weighted(edges, [code.splat(weight, EIGHT) for weight in weights]), gu, fu)
        density = builder.extract_element(value, INT32(3))
        own = code.subtract(value, code.vector([red, green, blue, FLOAT(0)]))
        own = builder.insert_element(own, FLOAT(1), INT32(3))
        by_colour = builder.insert_element(_NONE, density, INT32(0))
        wide = builder.shuffle_vector(own, by_colour, code.lanes(*range(8)))
        wide = code.multiply(wide, code.splat(opacity, EIGHT))
        ends = [code.multiply(wide, code.splat(end, EIGHT)) for end in (gu, fu)]
        sums = code.data(context, signature.args[0], sums)
        back = builder.add(corner, slab)
        places = (corner, builder.add(corner, size), back, builder.add(back, size))
        for place, weight in zip(places, weights, strict=True):
            at = builder.mul(place, INT64(WIDTH))
            for number, end in enumerate(ends):
                code.accumulate(
                    sums, builder.add(at, INT64(WIDTH * number)), code.multiply(end, code.splat(weight, EIGHT))
                )
        return context.get_dummy_value()

    return signature, generate


@_compiled_call
def add_product(typingctx, out, pixel, x, base, voxel, weight, first, last):
    """out[pixel] += the entries from `first` to `last` - 1 times x [voxels, 4], of a box with voxels from `base`."""
    signature = types.void(out, types.int64, x, types.int64, voxel, weight, types.int64, types.int64)

    def generate(context, builder, signature, arguments):
        out, pixel, x, base, voxel, weight, first, last = arguments
        code = Vectors(builder)
        x, weight = code.data(context, signature.args[2], x), code.data(context, signature.args[5], weight)
        by_colour, by_density = (cgutils.alloca_once_value(builder, _NONE) for _ in range(2))
        with cgutils.for_range_slice(builder, first, last, INT64(1), inc=True) as (entry, _):
            own = code.four_at(x, _voxel(code, context, signature.args[4], voxel, entry, base), 4)
            at = builder.mul(entry, INT64(5))
            colour = code.splat(builder.load(builder.gep(weight, [builder.add(at, INT64(4))])), FOUR)
            _onto(code, by_colour, code.multiply(own, colour))
            _onto(code, by_density, code.multiply(code.lane(own, 3), code.four_at(weight, at, 1)))
        total = code.add(_without_alpha(builder, builder.load(by_colour)), builder.load(by_density))
        code.accumulate(code.data(context, signature.args[0], out), builder.mul(pixel, INT64(4)), total)
        return context.get_dummy_value()

    return signature, generate


@_compiled_call
def add_transposed_product(typingctx, out, base, y, pixel, voxel, weight, first, last):
    """out [voxels, 4] += the same entries, transposed, times y[pixel]."""
    signature = types.void(out, types.int64, y, types.int64, voxel, weight, types.int64, types.int64)

    def generate(context, builder, signature, arguments):
        out, base, y, pixel, voxel, weight, first, last = arguments
        code = Vectors(builder)
        out, weight = code.data(context, signature.args[0], out), code.data(context, signature.args[5], weight)
        own = code.four_at(code.data(context, signature.args[2], y), pixel, 4)
        rgb = _without_alpha(builder, own)
        with cgutils.for_range_slice(builder, first, last, INT64(1), inc=True) as (entry, _):
            at = builder.mul(entry, INT64(5))
            colour = code.splat(builder.load(builder.gep(weight, [builder.add(at, INT64(4))])), FOUR)
            density = code.total(code.multiply(code.four_at(weight, at, 1), own))
            change = builder.insert_element(code.multiply(rgb, colour), density, INT32(3))
            place = _voxel(code, context, signature.args[4], voxel, entry, base)
            code.accumulate(out, builder.mul(place, INT64(4)), change)
        return context.get_dummy_value()

    return signature, generate


@_compiled_call
def add_four_columns(typingctx, out, at, x, base, columns, column, voxel, weight, first, last):
    """out[at : at + 4] += the entries from `first` to `last` - 1, of one weight each, times four columns of x."""
    signature = types.void(out, types.int64, x, *(types.int64,) * 3, voxel, weight, types.int64, types.int64)

    def generate(context, builder, signature, arguments):
        out, at, x, base, columns, column, voxel, weight, first, last = arguments
        code = Vectors(builder)
        x, weight = code.data(context, signature.args[2], x), code.data(context, signature.args[7], weight)
        total = cgutils.alloca_once_value(builder, _NONE)
        with cgutils.for_range_slice(builder, first, last, INT64(1), inc=True) as (entry, _):
            place = _voxel(code, context, signature.args[6], voxel, entry, base)
            place = builder.add(builder.mul(place, columns), column)
            value = code.splat(builder.load(builder.gep(weight, [entry])), FOUR)
            _onto(code, total, code.multiply(code.four_at(x, place, 1), value))
        code.accumulate(code.data(context, signature.args[0], out), at, builder.load(total))
        return context.get_dummy_value()

    return signature, generate


@_compiled_call
def add_four_transposed(typingctx, out, base, columns, column, y, at, voxel, weight, first, last):
    """Four columns of out += the same entries, transposed, times y[at : at + 4]."""
    signature = types.void(out, *(types.int64,) * 3, y, types.int64, voxel, weight, types.int64, types.int64)

    def generate(context, builder, signature, arguments):
        out, base, columns, column, y, at, voxel, weight, first, last = arguments
        code = Vectors(builder)
        out, weight = code.data(context, signature.args[0], out), code.data(context, signature.args[7], weight)
        own = code.four_at(code.data(context, signature.args[4], y), at, 1)
        with cgutils.for_range_slice(builder, first, last, INT64(1), inc=True) as (entry, _):
            place = _voxel(code, context, signature.args[6], voxel, entry, base)
            value = code.splat(builder.load(builder.gep(weight, [entry])), FOUR)
            place = builder.add(builder.mul(place, columns), column)
            code.accumulate(out, place, code.multiply(own, value))
        return context.get_dummy_value()

    return signature, generate


def _voxel(code, context, kind, voxel, entry, base):
    """The voxel of an entry."""
    builder = code.builder
    return builder.add(base, builder.sext(builder.load(builder.gep(code.data(context, kind, voxel), [entry])), INT64))


def _onto(code, total, value):
    code.builder.store(code.add(code.builder.load(total), value), total)


def _without_alpha(builder, four):
    return builder.insert_element(four, FLOAT(0), INT32(3))
