"""The forward pass on the CPU: parallel over tiles, boxes nearest first, lattice points in chunks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt64
from numpy import ndarray

from primdiffusion.render.cpu.compiled import TILE, index, kernel, part, take
from primdiffusion.render.cpu.sampling import (
    ENTER,
    HIT_ROWS,
    LANES,
    LEAVE,
    PIXELS,
    SAMPLES,
    TABLE_ROWS,
    add_segment,
    hit_boxes,
    leave_empty,
    lowest,
    reference_point,
    tabulate,
    tile_rays,
)
from primdiffusion.render.image import SURFACE_OPACITY

CHUNK = 16
"""Lattice points accumulated before compositing: enough to amortise the loop, few enough to stop early."""
NEVER = np.iinfo(np.int64).max
"""Lattice index of saturation for rays that do not saturate."""
NO_BOX = np.iinfo(np.int32).max

COLUMNS = 7
# A hit: box, stride, reference point, index of its test, and first, next and last lattice point.
_BOX, _STRIDE, _REFERENCE, _LINE, _FIRST, _NEXT, _LAST = range(COLUMNS)


class ImageRows(NamedTuple):
    """Output of the forward pass, one row per pixel."""

    rgb: Float32[ndarray, "r 3"]
    alpha: Float32[ndarray, "r"]
    depth: Float32[ndarray, "r"]
    first_hit: Float32[ndarray, "r"]


class SaturationPoints(NamedTuple):
    """The point at which each ray becomes opaque, for the adjoint. Not filled if empty."""

    index: Int64[ndarray, "r"]
    """Lattice index in units of the smallest stride; NEVER if the ray stays transparent."""
    box: Int32[ndarray, "r"]
    """With index order, the box that made it opaque; NO_BOX with mixed compositing."""
    share: Float32[ndarray, "r"]
    """kappa: the fraction of that sample's opacity that contributes (SPEC 4)."""
    rgb: Float32[ndarray, "r 3"]
    """Colour of that sample."""


class _Scratch(NamedTuple):
    """Buffers of one thread, sized for the tile with the most boxes."""

    listed: Int64[ndarray, "n"]
    """The tile's boxes, nearest first."""
    reference: Int64[ndarray, "n"]
    """Reference points of these boxes (see `reference_point`)."""
    earliest: Int64[ndarray, "n"]
    """Lower bound of the lattice index at which a ray enters this or any later box."""
    table: Float32[ndarray, "floats"]
    rays: Float32[ndarray, "floats"]
    tests: Float32[ndarray, "floats"]
    """[blocks, HIT_ROWS, LANES], flat."""
    hits: Int64[ndarray, "n columns"]
    per_stride: Float32[ndarray, "n"]
    """1 / stride of each hit."""
    sequence: UInt64[ndarray, "n"]
    """The hits sorted by first lattice point; unsigned, because numba checks the sign of signed indices."""
    points: Float32[ndarray, "floats"]
    """[CHUNK + 1, 4], flat: colour times opacity and opacity at each lattice point of a chunk; one more as scratch."""
    block: Float32[ndarray, "floats"]


@kernel
def march_tiles(
    taken, picture, ends, counts, boxes, size, rectangle, row_start, row_box, seen, order, limits,
    pixel_to_world, width, height, spacing, index_order,
):  # fmt: skip
    """Render all tiles in the given `order`; `seen` is the number of boxes of each.

    limits [r, 2], may be empty: first and last lattice index of each ray.
    counts [tiles, 2], may be empty: samples evaluated, and samples before rays become opaque.
    """
    most = seen.max()
    blocks = (most + LANES - 1) // LANES
    room = _Scratch(
        np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64),
        np.empty(blocks * LANES * TABLE_ROWS, np.float32), np.empty(3 * PIXELS, np.float32),
        np.empty(blocks * LANES * HIT_ROWS, np.float32),
        np.empty((most, COLUMNS), np.int64), np.empty(most, np.float32), np.empty(most, np.uint64),
        np.empty(4 * (CHUNK + 1), np.float32), np.empty(8 * SAMPLES, np.float32),
    )  # fmt: skip
    i = take(taken)
    while i < len(order):
        _march_tile(
            picture, ends, counts, boxes, size, rectangle, row_start, row_box, order[i], seen[order[i]], limits,
            pixel_to_world, width, height, spacing, index_order, room,
        )  # fmt: skip
        i = take(taken)


@part()
def _march_tile(
    picture, ends, counts, boxes, size, rectangle, row_start, row_box, tile, listed, limits, pixel_to_world, width,
    height, spacing, index_order, room,
):  # fmt: skip
    """Render one tile with `listed` boxes."""
    across = (width + TILE - 1) // TILE
    row0, column0 = (tile // across) * TILE, (tile % across) * TILE
    if listed == 0:
        _leave_blank(picture, ends, row0, column0, width, height)
        return
    middle = tile_rays(room.rays, pixel_to_world, row0, column0)
    _tabulate_tile(room, row_box, row_start, rectangle, tile, across, boxes, middle, spacing)
    for row in range(row0, min(row0 + TILE, height)):
        for column in range(column0, min(column0 + TILE, width)):
            ray = row * width + column
            pixel = (row - row0) * TILE + column - column0
            first, last = 1, NEVER
            if len(limits) > 0:
                first, last = limits[ray, 0], limits[ray, 1]
            evaluated, number = _march_ray(
                picture, ends, ray, pixel, room, listed, first, last, boxes.voxels, boxes.stride, size, spacing,
                index_order,
            )  # fmt: skip
            if len(counts) > 0:
                counts[tile, 0] += evaluated
                counts[tile, 1] += _needed(room.hits, number, boxes.stride, ends.index[ray])


@part()
def _leave_blank(picture, ends, row0, column0, width, height):
    for row in range(row0, min(row0 + TILE, height)):
        for column in range(column0, min(column0 + TILE, width)):
            ray = row * width + column
            picture.rgb[ray, 0], picture.rgb[ray, 1], picture.rgb[ray, 2], picture.alpha[ray] = 0, 0, 0, 0
            picture.depth[ray], picture.first_hit[ray] = np.inf, np.inf
            if len(ends.index) > 0:
                ends.index[ray] = NEVER


@part()
def _tabulate_tile(room, row_box, row_start, rectangle, tile, across, boxes, middle, spacing):
    row, column = tile // across, tile % across
    i = 0
    for entry in range(row_start[row], row_start[row + 1]):
        k = np.int64(row_box[entry])
        if rectangle[k, 0] <= column <= rectangle[k, 1]:
            reference = reference_point(boxes, k, middle, spacing)
            room.listed[i], room.reference[i] = k, reference
            room.earliest[i] = np.int64(max(boxes.nearest[k], 0.0) / spacing) - 1
            tabulate(room.table, i // LANES * LANES * TABLE_ROWS + i % LANES, boxes, k, middle, reference, spacing)
            i += 1
    while i % LANES > 0:
        leave_empty(room.table, i // LANES * LANES * TABLE_ROWS + i % LANES)
        i += 1


@part(inline=True)
def _test_boxes(room, number, begin, pixel, strides, first, last):
    """Append the hits among LANES boxes from `begin` on to the ray's `number` hits; return their new number."""
    dx, dy, dz = room.rays[pixel], room.rays[PIXELS + pixel], room.rays[2 * PIXELS + pixel]
    begin, number = index(begin), index(number)
    place = begin * HIT_ROWS
    tests, hits, sequence = room.tests, room.hits, room.sequence
    hit = hit_boxes(tests, place, room.table, begin * TABLE_ROWS, dx, dy, dz)
    while hit != 0:
        lane = index(lowest(hit))
        hit &= hit - 1
        k, at, line = index(room.listed[begin + lane]), room.reference[begin + lane], place + lane
        stride = strides[k]
        enter = at + np.int64(tests[line + ENTER * LANES]) * stride
        leave = at + np.int64(tests[line + LEAVE * LANES]) * stride
        if enter < first:
            enter += (first - enter + stride - 1) // stride * stride
        if leave > last:
            leave -= (leave - last + stride - 1) // stride * stride
        if enter > leave:
            continue
        hits[number, _BOX], hits[number, _REFERENCE], hits[number, _LINE] = k, at, line
        hits[number, _STRIDE], room.per_stride[number] = stride, np.float32(1) / np.float32(stride)
        hits[number, _FIRST], hits[number, _NEXT], hits[number, _LAST] = enter, enter, leave
        turn = number
        while turn > 0 and hits[sequence[turn - 1], _FIRST] > enter:
            sequence[turn] = sequence[turn - 1]
            turn -= 1
        sequence[turn] = number
        number += 1
    return number


@part(inline=True)
def _march_ray(picture, ends, ray, pixel, room, listed, first, last, voxels, strides, size, spacing, index_order):
    """Composite one ray; return the numbers of samples and of hits examined."""
    hits, sequence, points = room.hits, room.sequence, room.points
    red, green, blue, alpha, moment, first_hit = 0.0, 0.0, 0.0, 0.0, 0.0, np.inf
    evaluated, number, done = 0, 0, 0  # hits before `done` end before the chunk
    begin, tested = 0, 0  # boxes before `tested` have been
    if len(ends.index) > 0:
        ends.index[ray], ends.box[ray] = NEVER, NO_BOX
    while alpha < 1.0:
        following = begin
        if done < number:
            following = max(begin, hits[sequence[done], _FIRST])
        if tested < listed and (done == number or room.earliest[tested] < following + CHUNK):
            number = _test_boxes(room, number, tested, pixel, strides, first, last)
            tested += LANES
            continue
        if done == number:
            break
        begin = following
        points[:] = 0
        evaluated += _gather(room, begin, done, number, voxels, strides, size, spacing)
        slot, before = CHUNK, alpha
        r, g, b, a, m = _sum(points)
        if alpha + a >= 1.0:
            slot, r, g, b, a, m = _sum_to_opaque(points, alpha)
        red, green, blue, alpha, moment = red + r, green + g, blue + b, alpha + a, moment + begin * a + m
        if slot < CHUNK:
            moment += (begin + slot) * (1.0 - alpha)
            k = NO_BOX
            if index_order:
                k, r, g, b, a = _in_index_order(room, slot, begin + slot, alpha, number, voxels, strides, size, spacing)
                red, green, blue, alpha = red + r, green + g, blue + b, alpha + a
            share = (1.0 - alpha) / points[4 * slot + 3]
            red, green = red + share * points[4 * slot], green + share * points[4 * slot + 1]
            blue += share * points[4 * slot + 2]
            alpha = 1.0
            if len(ends.index) > 0:
                _record_saturation(ends, ray, begin + slot, k, share, points, slot)
        if before < SURFACE_OPACITY <= alpha:
            first_hit = begin + _slot_of_surface(points, before, slot)
        begin += CHUNK
        while done < number and hits[sequence[done], _NEXT] > hits[sequence[done], _LAST]:
            done += 1
    picture.rgb[ray, 0], picture.rgb[ray, 1], picture.rgb[ray, 2], picture.alpha[ray] = red, green, blue, alpha
    picture.depth[ray] = moment * spacing / alpha if alpha > 0 else np.inf
    picture.first_hit[ray] = first_hit * spacing
    return evaluated, number


@part(inline=True)
def _gather(room, begin, done, number, voxels, strides, size, spacing):
    """Accumulate all boxes at the lattice points from `begin` to `begin + CHUNK`; return the number of samples."""
    hits, sequence = room.hits, room.sequence
    evaluated, end = 0, begin + CHUNK
    for place in range(done, number):
        hit = sequence[place]
        if hits[hit, _FIRST] >= end:
            break
        upcoming, last = hits[hit, _NEXT], min(hits[hit, _LAST], end - 1)
        if upcoming > last:
            continue
        k, stride = hits[hit, _BOX], hits[hit, _STRIDE]
        # Division of small integers through float32: exact, and much faster than integer division.
        inverse = room.per_stride[hit]
        count = np.int64((np.float32(last - upcoming) + np.float32(0.5)) * inverse) + 1
        first = np.float32(upcoming - hits[hit, _REFERENCE]) * inverse
        length = np.float32(stride * spacing)
        base = 4 * k * size * size * size
        add_segment(
            room.points, upcoming - begin, stride, voxels, base, size, room.block, room.tests, hits[hit, _LINE], first,
            count, length,
        )  # fmt: skip
        hits[hit, _NEXT] = upcoming + count * stride
        evaluated += count
    return evaluated


@part()
def _sum(points):
    """Colour and opacity of the chunk, and the sum of slot * opacity."""
    r, g, b, a, m = np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for slot in range(CHUNK):
        r += points[4 * slot]
        g += points[4 * slot + 1]
        b += points[4 * slot + 2]
        a += points[4 * slot + 3]
        m += points[4 * slot + 3] * np.float32(slot)
    return r, g, b, a, m


@part()
def _sum_to_opaque(points, alpha):
    """The slot that takes alpha to 1 (CHUNK if only rounding did), and as `_sum` for the slots before it."""
    r, g, b, a, m = 0.0, 0.0, 0.0, 0.0, 0.0
    for slot in range(CHUNK):
        opacity = points[4 * slot + 3]
        if alpha + a + opacity >= 1.0 and opacity > 0:
            return slot, r, g, b, a, m
        r, g, b = r + points[4 * slot], g + points[4 * slot + 1], b + points[4 * slot + 2]
        a, m = a + opacity, m + opacity * slot
    return CHUNK, r, g, b, a, m


@part()
def _slot_of_surface(points, alpha, last):
    """The slot at which alpha reaches SURFACE_OPACITY, at most `last`."""
    for slot in range(min(last, CHUNK - 1)):
        alpha += points[4 * slot + 3]
        if alpha >= SURFACE_OPACITY:
            return slot
    return min(last, CHUNK - 1)


@part()
def _in_index_order(room, slot, index, alpha, number, voxels, strides, size, spacing):
    """Composite the boxes at one lattice point, lowest index first, until the ray is opaque.

    Sets points[slot] to the saturating sample; returns its box, and colour and opacity of the samples before it.
    """
    hits, points = room.hits, room.points
    r, g, b, a = 0.0, 0.0, 0.0, 0.0
    r_end, g_end, b_end, a_end = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    box, box_end = np.int64(-1), np.int64(NO_BOX)
    while alpha + a + a_end < 1.0:
        following = -1
        for hit in range(number):
            inside = hits[hit, _FIRST] <= index <= hits[hit, _LAST]
            inside = inside and (index - hits[hit, _FIRST]) % strides[hits[hit, _BOX]] == 0
            if inside and hits[hit, _BOX] > box and (following < 0 or hits[hit, _BOX] < hits[following, _BOX]):
                following = hit
        if following < 0:
            break  # because of rounding the sum does not reach 1: the last box counts as saturating
        box = hits[following, _BOX]
        stride = strides[box]
        scratch = 4 * CHUNK
        for channel in range(4):
            points[scratch + channel] = 0
        first, length = np.float32((index - hits[following, _REFERENCE]) // stride), np.float32(stride * spacing)
        base = 4 * box * size * size * size
        line = hits[following, _LINE]
        add_segment(points, CHUNK, 0, voxels, base, size, room.block, room.tests, line, first, 1, length)
        if points[scratch + 3] > 0:
            r, g, b, a = r + r_end, g + g_end, b + b_end, a + a_end
            r_end, g_end, b_end, a_end = points[scratch], points[scratch + 1], points[scratch + 2], points[scratch + 3]
            box_end = box
    points[4 * slot], points[4 * slot + 1], points[4 * slot + 2], points[4 * slot + 3] = r_end, g_end, b_end, a_end
    return box_end, r, g, b, a


@part()
def _record_saturation(ends, ray, index, box, share, points, slot):
    ends.index[ray], ends.box[ray], ends.share[ray] = index, box, share
    inverse = np.float32(1) / points[4 * slot + 3]
    ends.rgb[ray, 0], ends.rgb[ray, 1] = points[4 * slot] * inverse, points[4 * slot + 1] * inverse
    ends.rgb[ray, 2] = points[4 * slot + 2] * inverse


@part()
def _needed(hits, number, strides, end):
    """Number of samples of a ray's hits at lattice points up to `end`."""
    needed = 0
    for hit in range(number):
        last = min(hits[hit, _LAST], end)
        if last >= hits[hit, _FIRST]:
            needed += (last - hits[hit, _FIRST]) // strides[hits[hit, _BOX]] + 1
    return needed
