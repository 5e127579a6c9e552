"""Triton functions shared by both passes, and the kernels that list the boxes of each tile (SPEC 4)."""

from __future__ import annotations

import triton
import triton.language as tl

SHARPNESS = tl.constexpr(8.0)
NEVER = tl.constexpr(1 << 30)
"""Lattice index behind all others."""
LAST = tl.constexpr(2147483647)
"""First point of boxes that are not drawn."""


@triton.jit
def ray_in_box(row, u, v):
    """y = p + n spacing q at lattice point n0 + n, for the pixels in column u, row v (float32, whole numbers).

    `row` points at the box's record (see `triton_boxes`).
    """
    du = (u - tl.load(row + 16)) + (0.5 - tl.load(row + 17))
    dv = (v - tl.load(row + 18)) + (0.5 - tl.load(row + 19))
    length = tl.load(row + 13)
    more = du * (tl.load(row + 14) + du * tl.load(row + 27) + dv * tl.load(row + 28))
    more += dv * (tl.load(row + 15) + dv * tl.load(row + 29))
    root = tl.sqrt(length * length + more)
    inverse = 1.0 / root
    shorten = more / (root + length) * inverse
    du, dv = du * inverse, dv * inverse
    along = tl.load(row + 12)
    x, y, z = tl.load(row + 6), tl.load(row + 7), tl.load(row + 8)
    sx = du * tl.load(row) + dv * tl.load(row + 3) - shorten * x
    sy = du * tl.load(row + 1) + dv * tl.load(row + 4) - shorten * y
    sz = du * tl.load(row + 2) + dv * tl.load(row + 5) - shorten * z
    px, py, pz = tl.load(row + 9) + along * sx, tl.load(row + 10) + along * sy, tl.load(row + 11) + along * sz
    return px, py, pz, sx + x, sy + y, sz + z


@triton.jit
def cell(y):
    """Index of the voxel below a coordinate in [-1, 1], and the fraction to the next."""
    u = (y + 1.0) * 3.5
    low = tl.minimum(tl.maximum(u.to(tl.int32), 0), 6)
    return low, u - low.to(tl.float32)


@triton.jit
def window(x, y, z):
    """exp(-8 * sum |y|^8), which fades density towards the faces of a box (SPEC 4)."""
    x2, y2, z2 = x * x, y * y, z * z
    x4, y4, z4 = x2 * x2, y2 * y2, z2 * z2
    return tl.exp((x4 * x4 + y4 * y4 + z4 * z4) * -SHARPNESS)


@triton.jit
def channels(value):
    """Red, green, blue and density of [..., 2, 2] values."""
    first, second = tl.split(value)
    red, blue = tl.split(first)
    green, density = tl.split(second)
    return red, green, blue, density


ENTRY = 4
WIDE_TILE = tl.constexpr(0.5)  # tiles wider than this (about radians) are not bounded by their middle ray
BLUR = tl.constexpr(1e-4)  # relative margin of a box for rounding


@triton.jit
def order_boxes(first_point, order, boxes, LANES: tl.constexpr, CHUNK: tl.constexpr):
    """LANES boxes of one view: their places in the order of their first points, equal ones in that of their index."""
    view = tl.program_id(1).to(tl.int64) * boxes
    k = tl.program_id(0) * LANES + tl.arange(0, LANES)
    own = tl.load(first_point + view + k, k < boxes, 0)[:, None]
    place = tl.zeros((LANES,), tl.int32)
    for start in range(0, boxes, CHUNK):
        i = start + tl.arange(0, CHUNK)
        other = tl.load(first_point + view + i, i < boxes, LAST)[None, :]
        before = (other < own) | ((other == own) & (i[None, :] < k[:, None]))
        place += tl.sum(before.to(tl.int32), 1)
    tl.store(order + view + place, k, k < boxes)


@triton.jit
def _place(written, found, capacity):
    """Reserve room for `found` entries, or for what is left of it: where they begin, and their number.

    The host knows from the totals of `place_boxes` that something was left out, and draws again.
    """
    place = tl.atomic_add(written, found.to(tl.int64))
    return place, tl.minimum(found.to(tl.int64), tl.maximum(capacity - place, 0)).to(tl.int32)


@triton.jit
def list_bins(
    order, indices, entries, begin, count, written, capacity, boxes, across,
    BIN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """One bin of one view: all boxes whose tiles meet it, in `order`."""
    view, bin_ = tl.program_id(1), tl.program_id(0)
    column, row = (bin_ % across) * BIN, (bin_ // across) * BIN
    first_box = view.to(tl.int64) * boxes
    found = tl.zeros((), tl.int32)
    for start in range(0, boxes, LANES):
        i = start + tl.arange(0, LANES)
        k = tl.load(order + first_box + i, i < boxes, 0).to(tl.int32)
        found += tl.sum(_meets(indices, first_box, k, i < boxes, column, row, BIN).to(tl.int32), 0)
    place, found = _place(written, found, capacity)
    stop = place + found
    tl.store(begin + view * tl.num_programs(0) + bin_, place)
    tl.store(count + view * tl.num_programs(0) + bin_, found)
    if found > 0:
        for start in range(0, boxes, LANES):
            i = start + tl.arange(0, LANES)
            k = tl.load(order + first_box + i, i < boxes, 0).to(tl.int32)
            here = _meets(indices, first_box, k, i < boxes, column, row, BIN)
            line = indices + (first_box + k) * 16
            first, last = tl.load(line + 1, here, 0), tl.load(line + 2, here, 0)
            place = _write(entries, place, stop, here, k, first, first, last)


@triton.jit
def list_tiles(
    bin_entries, bin_begin, bin_count, record, indices, entries, begin, count, written, capacity,
    boxes, across, bins_across, bins, spacing,
    BIN: tl.constexpr, TILE_WIDTH: tl.constexpr, TILE_HEIGHT: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """One tile of one view: the boxes of its bin that its rays meet, in the bin's order."""
    view, tile = tl.program_id(1), tl.program_id(0)
    column, row = tile % across, tile // across
    bin_ = view * bins + (row // BIN) * bins_across + column // BIN
    candidates = bin_entries + tl.load(bin_begin + bin_) * 4
    number = tl.load(bin_count + bin_)
    first_box = view.to(tl.int64) * boxes
    list_ = view * tl.num_programs(0) + tile
    found = tl.zeros((), tl.int32)
    for start in range(0, number, LANES):
        i = start + tl.arange(0, LANES)
        k = tl.load(candidates + i * 4, i < number, 0)
        here = _meets(indices, first_box, k, i < number, column, row, 1)
        first, last = _reached(record, indices, first_box + k, column, row, spacing, TILE_WIDTH, TILE_HEIGHT)
        found += tl.sum((here & (first <= last)).to(tl.int32), 0)
    if found == 0:
        tl.store(count + list_, found)
        tl.store(begin + list_, found.to(tl.int64))
    else:
        place, found = _place(written + 1, found, capacity)
        stop = place + found
        tl.store(count + list_, found)
        tl.store(begin + list_, place)
        for start in range(0, number, LANES):
            i = start + tl.arange(0, LANES)
            k = tl.load(candidates + i * 4, i < number, 0)
            here = _meets(indices, first_box, k, i < number, column, row, 1)
            first, last = _reached(record, indices, first_box + k, column, row, spacing, TILE_WIDTH, TILE_HEIGHT)
            sorted_by = tl.load(candidates + i * 4 + 1, i < number, 0)
            place = _write(entries, place, stop, here & (first <= last), k, sorted_by, first, last)


@triton.jit
def _write(entries, place, stop, here, k, sorted_by, first, last):
    """Append entries for those `here`, from `place` on, none from `stop` on; return the next free place."""
    index = place + tl.cumsum(here.to(tl.int32), 0) - 1
    at, fits = entries + index * 4, here & (index < stop)
    tl.store(at, k, fits)
    tl.store(at + 1, sorted_by, fits)
    tl.store(at + 2, first, fits)
    tl.store(at + 3, last, fits)
    return place + tl.sum(here.to(tl.int64), 0)


@triton.jit
def _meets(indices, first_box, k, here, column, row, SIZE: tl.constexpr):
    """Whether boxes touch any of SIZE x SIZE tiles."""
    line = indices + (first_box + k) * 16
    left, right = tl.load(line + 4, here, 0), tl.load(line + 5, here, -1)
    top, bottom = tl.load(line + 6, here, 0), tl.load(line + 7, here, -1)
    across = (left < column + SIZE) & (right >= column)
    return here & across & (top < row + SIZE) & (bottom >= row)


@triton.jit
def _reached(record, indices, k, column, row, spacing, TILE_WIDTH: tl.constexpr, TILE_HEIGHT: tl.constexpr):
    """First and last lattice point of the boxes' contents that any ray of a tile can reach; last < first for none.

    A ray differs from the tile's middle one by d - d0 = Dm / |m0| + d (|m0| - |m|) / |m0|, Dm at most w a + h b for
    half a tile of w x h pixels. On an axis of the box the first term is at most A / |m0|, A = w |W a| + h |W b|;
    with r = |Dm| / |m0| the difference is at most (A / |m0| + |W d0| r) / (1 - r). The middle ray is cut with the box
    grown by as much at the box's far end.
    """
    at, line = record + k * 32, indices + k * 16
    width: tl.constexpr = (TILE_WIDTH - 1) / 2
    height: tl.constexpr = (TILE_HEIGHT - 1) / 2
    u = (column * TILE_WIDTH).to(tl.float32) + width + tl.zeros(k.shape, tl.float32)
    v = (row * TILE_HEIGHT).to(tl.float32) + height + tl.zeros(k.shape, tl.float32)
    px, py, pz, qx, qy, qz = ray_in_box(at, u, v)
    du, dv = (u - tl.load(at + 16)) + (0.5 - tl.load(at + 17)), (v - tl.load(at + 18)) + (0.5 - tl.load(at + 19))
    length = tl.load(at + 13)
    more = du * (tl.load(at + 14) + du * tl.load(at + 27) + dv * tl.load(at + 28))
    more += dv * (tl.load(at + 15) + dv * tl.load(at + 29))
    inverse = 1.0 / tl.sqrt(length * length + more)
    r = (tl.sqrt(tl.load(at + 27)) * width + tl.sqrt(tl.load(at + 29)) * height) * inverse
    n0, first, last = tl.load(line), tl.load(line + 1), tl.load(line + 2)
    far = last.to(tl.float32) * spacing / (1.0 - tl.minimum(r, WIDE_TILE))
    low, high = tl.zeros_like(u) - float("inf"), tl.zeros_like(u) + float("inf")
    low, high = _cut(low, high, px, qx, at, 0, far, inverse, r, width, height)
    low, high = _cut(low, high, py, qy, at, 1, far, inverse, r, width, height)
    low, high = _cut(low, high, pz, qz, at, 2, far, inverse, r, width, height)
    low, high = low / spacing, high / spacing
    # Beyond 2^29 points float32 cannot be turned into an integer that n0 may be added to.
    low, high = tl.maximum(low, -5e8), tl.minimum(high, 5e8)
    missed = low > high
    low, high = tl.minimum(low, 5e8), tl.maximum(high, -5e8)
    near = tl.maximum(first, n0 + tl.floor(low - 0.05).to(tl.int32))
    past = tl.minimum(last, n0 + tl.ceil(high + 0.05).to(tl.int32))
    past = tl.where(missed, near - 1, past)
    return tl.where(r < WIDE_TILE, near, first), tl.where(r < WIDE_TILE, past, last)


@triton.jit
def _cut(low, high, p, q, at, AXIS: tl.constexpr, far, inverse, r, width: tl.constexpr, height: tl.constexpr):
    """[low, high] cut to where p + s q lies between a box's bounds on an axis, grown by how a tile's rays differ."""
    turn = (tl.abs(tl.load(at + AXIS)) * width + tl.abs(tl.load(at + 3 + AXIS)) * height) * inverse
    grown = far * (turn + tl.abs(q) * r) + BLUR
    q = tl.where(tl.abs(q) < 1e-12, 1e-12, q)
    one, two = (tl.load(at + 20 + AXIS) - grown - p) / q, (tl.load(at + 23 + AXIS) + grown - p) / q
    return tl.maximum(low, tl.minimum(one, two)), tl.minimum(high, tl.maximum(one, two))
