"""The forward pass as a Triton kernel: a program processes a tile of pixels (SPEC 4).

A tile advances along its rays in chunks of lattice points. Every box of its list that overlaps the chunk adds opacity
and colour for all points and pixels at once; then the chunk is composited. The tile ends when its rays are opaque or
its list is finished. Only lattice points that are multiples of GAP are used, in SETS sets: point n is in set
n / GAP % SETS. Boxes whose stride is a multiple of GAP * SETS use the first set only, so that coarse boxes do not pay
for fine ones.

In index order only the point at which a ray becomes opaque differs: `march_tiles` composites it as mixed and notes how
much opacity was missing, and `end_in_order` replaces it.
"""

# pyright: reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# Triton's language is Python by its syntax alone.
from __future__ import annotations

import triton
import triton.language as tl

from primdiffusion.render.cuda.triton_lists import NEVER, cell, channels, ray_in_box, window


@triton.jit
def _add_samples(
    red, green, blue, opacity, n, n0, stride, row, voxels, px, py, pz, qx, qy, qz, first, last, spacing,
    WHOLE: tl.constexpr,
):  # fmt: skip
    """One box's samples at lattice points n [1 or pixels, coarse], on rays p + (n - n0) spacing q [pixels], added."""
    t = (n - n0).to(tl.float32) * spacing
    x, y, z = px[:, None] + t * qx[:, None], py[:, None] + t * qy[:, None], pz[:, None] + t * qz[:, None]
    inside = (x > tl.load(row + 20)) & (x < tl.load(row + 23)) & (y > tl.load(row + 21)) & (y < tl.load(row + 24))
    inside = inside & (z > tl.load(row + 22)) & (z < tl.load(row + 25))
    inside = inside & (n >= first[:, None]) & (n <= last[:, None])
    if not WHOLE:
        inside = inside & ((n % stride) == 0)
    if tl.max(tl.max(inside.to(tl.int32), 1), 0) > 0:
        ix, fx = cell(x)
        iy, fy = cell(y)
        iz, fz = cell(z)
        place = (iz * 64 + iy * 8 + ix) * 4
        channel = tl.arange(0, 4)[None, None, :]
        corner = voxels + place[:, :, None] + channel
        mask = inside[:, :, None]
        value = tl.zeros((x.shape[0], x.shape[1], 4), tl.float32)
        for k in tl.static_range(8):
            wx = fx if k % 2 else 1.0 - fx
            wy = fy if k // 2 % 2 else 1.0 - fy
            wz = fz if k // 4 else 1.0 - fz
            weight = wx * wy * wz
            value += weight[:, :, None] * tl.load(corner + (k % 2 * 4 + k // 2 % 2 * 32 + k // 4 * 256), mask, 0.0)
        r, g, b, density = channels(tl.reshape(value, (x.shape[0], x.shape[1], 2, 2)))
        a = density * window(x, y, z) * tl.load(row + 26)
        a = tl.where(inside, a, 0.0)
        red += a * r
        green += a * g
        blue += a * b
        opacity += a
    return red, green, blue, opacity


@triton.jit
def _opaque(before, opacity, n, ends, halves):
    """The first points, of n and of those found so far, at which `before` plus `opacity` reaches 1 and 1/2."""
    reached = before + opacity
    ends = tl.minimum(ends, tl.where((reached >= 1.0) & (opacity > 0), n, NEVER))
    halves = tl.minimum(halves, tl.where((reached >= 0.5) & (opacity > 0), n, NEVER))
    return ends, halves


@triton.jit
def _weigh(before, red, green, blue, opacity, n, end, base, spacing, sums, final, INDEX_ORDER: tl.constexpr):
    """Adds points n to `sums`, composited (red, green, blue, moment), and the saturating one to `final`.

    `final` is kappa and the mean colour; with INDEX_ORDER the opacity missing before that point instead of kappa.
    """
    mixed = tl.where(opacity > 0, opacity, 1.0)
    at_end = n == end[:, None]
    kappa = tl.where(at_end, tl.minimum(tl.maximum((1.0 - before) / mixed, 0.0), 1.0), 0.0)
    share = tl.where(n < end[:, None], 1.0, kappa)
    t = (n - base).to(tl.float32) * spacing
    r, g, b, moment = sums
    r, g, b = r + share * red, g + share * green, b + share * blue
    moment += share * opacity * t
    k, lr, lg, lb = final
    one = tl.where(at_end, 1.0 / mixed, 0.0)
    if INDEX_ORDER:
        kappa *= mixed
    return (r, g, b, moment), (k + kappa, lr + one * red, lg + one * green, lb + one * blue)


@triton.jit
def _rays(view, tile, height, width, tiles_across, TILE_WIDTH: tl.constexpr, TILE_HEIGHT: tl.constexpr):
    """Rays of a tile: column and row of the pixel, number, and whether it is in the picture."""
    pixel = tl.arange(0, TILE_WIDTH * TILE_HEIGHT)
    column = tile % tiles_across * TILE_WIDTH + pixel % TILE_WIDTH
    line = tile // tiles_across * TILE_HEIGHT + pixel // TILE_WIDTH
    shown = (column < width) & (line < height)
    ray = (view.to(tl.int64) * height + line) * width + column
    return column.to(tl.float32), line.to(tl.float32), ray, shown


@triton.jit
def _list(view, tile, entries, begin, count, tiles_across, lists_across, lists, TILES_OF_LIST: tl.constexpr):
    """A tile's list, and the number of its entries."""
    list_ = view * lists + tile // tiles_across // TILES_OF_LIST * lists_across + tile % tiles_across // TILES_OF_LIST
    number = tl.load(count + list_)
    return entries + tl.load(begin + list_) * 4, number


@triton.jit
def march_tiles(
    record, indices, voxels, entries, begin, count, reach, out_rgb, out_alpha, out_depth, out_first_hit, kept, ends,
    boxes, own_boxes, height, width, tiles_across, lists_across, lists, spacing,
    TILES_OF_LIST: tl.constexpr, HAS_SPAN: tl.constexpr, KEEP: tl.constexpr, WHOLE: tl.constexpr,
    INDEX_ORDER: tl.constexpr,
    TILE_WIDTH: tl.constexpr, TILE_HEIGHT: tl.constexpr, COARSE: tl.constexpr, SETS: tl.constexpr, GAP: tl.constexpr,
):  # fmt: skip
    """One tile of one view. `kept` [.., 6] and `ends` [.., 2] hold what the backward pass needs of a ray (KEEP)."""
    view, tile = tl.program_id(1), tl.program_id(0)
    u, v, ray, shown = _rays(view, tile, height, width, tiles_across, TILE_WIDTH, TILE_HEIGHT)
    if HAS_SPAN:
        first = tl.load(reach + ray * 2, shown, NEVER)
        last = tl.load(reach + ray * 2 + 1, shown, 0)
    else:
        first = tl.where(shown, 1, NEVER)
        last = tl.where(shown, NEVER - 1, 0)

    own, number = _list(view, tile, entries, begin, count, tiles_across, lists_across, lists, TILES_OF_LIST)
    first_box = view.to(tl.int64) * boxes
    zero = tl.zeros((TILE_WIDTH * TILE_HEIGHT,), tl.float32)
    never = tl.zeros((TILE_WIDTH * TILE_HEIGHT,), tl.int32) + NEVER
    r, g, b, moment, kappa, end_r, end_g, end_b = zero, zero, zero, zero, zero, zero, zero, zero
    reached, end, half = zero, never, never
    grid = tl.zeros((TILE_WIDTH * TILE_HEIGHT, COARSE), tl.float32)
    coarse = tl.arange(0, COARSE)[None, :] * (SETS * GAP)

    open_ = tl.zeros((), tl.int32)
    next_point = open_
    if number > 0:
        next_point = tl.load(own + 1) // (SETS * GAP) * (SETS * GAP)
    base = next_point
    alive = tl.max((first <= last).to(tl.int32), 0)
    while (open_ < number) & (alive > 0):
        red0, green0, blue0, opacity0 = grid, grid, grid, grid
        red1, green1, blue1, opacity1 = grid, grid, grid, grid
        red2, green2, blue2, opacity2 = grid, grid, grid, grid
        red3, green3, blue3, opacity3 = grid, grid, grid, grid
        points = next_point + coarse
        stop = next_point + COARSE * SETS * GAP
        entry = open_
        starts = next_point
        following = tl.zeros((), tl.int32) + NEVER
        # Entries that are done stay after `open_`: the list is ordered by where boxes begin, not by where they end.
        while (entry < number) & (starts < stop):
            at = own + entry * 4
            starts = tl.load(at + 1)
            begins, ends_at = tl.load(at + 2), tl.load(at + 3)
            following = tl.where(ends_at >= stop, tl.minimum(following, tl.maximum(begins, stop)), following)
            if (begins < stop) & (ends_at >= next_point):
                k = first_box + tl.load(at)
                row = record + k * 32
                n0 = tl.load(indices + k * 16)
                stride = tl.load(indices + k * 16 + 3)
                source = voxels + (view.to(tl.int64) * own_boxes + (k - first_box)) * 2048
                px, py, pz, qx, qy, qz = ray_in_box(row, u, v)
                red0, green0, blue0, opacity0 = _add_samples(
                    red0, green0, blue0, opacity0, points, n0, stride, row, source, px, py, pz, qx, qy, qz,
                    first, last, spacing, WHOLE,
                )  # fmt: skip
                if SETS == 2:  # noqa: SIM102 (known when compiled, while the stride is not)
                    if stride % (2 * GAP) != 0:
                        red1, green1, blue1, opacity1 = _add_samples(
                            red1, green1, blue1, opacity1, points + GAP, n0, stride, row, source,
                            px, py, pz, qx, qy, qz, first, last, spacing, WHOLE,
                        )  # fmt: skip
                if SETS == 4:
                    if stride % (4 * GAP) != 0:
                        red2, green2, blue2, opacity2 = _add_samples(
                            red2, green2, blue2, opacity2, points + 2 * GAP, n0, stride, row, source,
                            px, py, pz, qx, qy, qz, first, last, spacing, WHOLE,
                        )  # fmt: skip
                    if stride % (2 * GAP) != 0:
                        red1, green1, blue1, opacity1 = _add_samples(
                            red1, green1, blue1, opacity1, points + GAP, n0, stride, row, source,
                            px, py, pz, qx, qy, qz, first, last, spacing, WHOLE,
                        )  # fmt: skip
                        red3, green3, blue3, opacity3 = _add_samples(
                            red3, green3, blue3, opacity3, points + 3 * GAP, n0, stride, row, source,
                            px, py, pz, qx, qy, qz, first, last, spacing, WHOLE,
                        )  # fmt: skip
            entry += 1

        total = opacity0
        if SETS >= 2:
            total += opacity1
        if SETS == 4:
            total += opacity2 + opacity3
        before0 = reached[:, None] + tl.cumsum(total, 1) - total
        nothing = (grid, grid, grid, grid)
        stops, halves = _opaque(before0, opacity0, points, grid.to(tl.int32) + NEVER, grid.to(tl.int32) + NEVER)
        if SETS >= 2:
            before1 = before0 + opacity0
            stops, halves = _opaque(before1, opacity1, points + GAP, stops, halves)
        if SETS == 4:
            before2 = before1 + opacity1
            stops, halves = _opaque(before2, opacity2, points + 2 * GAP, stops, halves)
            before3 = before2 + opacity2
            stops, halves = _opaque(before3, opacity3, points + 3 * GAP, stops, halves)
        end = tl.minimum(end, tl.min(stops, 1))
        half = tl.minimum(half, tl.min(halves, 1))
        s, f = _weigh(before0, red0, green0, blue0, opacity0, points, end, base, spacing, nothing, nothing, INDEX_ORDER)
        if SETS >= 2:
            s, f = _weigh(before1, red1, green1, blue1, opacity1, points + GAP, end, base, spacing, s, f, INDEX_ORDER)
        if SETS == 4:
            s, f = _weigh(
                before2, red2, green2, blue2, opacity2, points + 2 * GAP, end, base, spacing, s, f, INDEX_ORDER
            )
            s, f = _weigh(
                before3, red3, green3, blue3, opacity3, points + 3 * GAP, end, base, spacing, s, f, INDEX_ORDER
            )
        r, g, b = r + tl.sum(s[0], 1), g + tl.sum(s[1], 1), b + tl.sum(s[2], 1)
        moment += tl.sum(s[3], 1)
        if KEEP:
            kappa, end_r = kappa + tl.sum(f[0], 1), end_r + tl.sum(f[1], 1)
            end_g, end_b = end_g + tl.sum(f[2], 1), end_b + tl.sum(f[3], 1)
        reached = tl.where(end < NEVER, 1.0, tl.minimum(reached + tl.sum(total, 1), 1.0))
        last = tl.where(end < NEVER, 0, last)
        alive = tl.max((first <= last).to(tl.int32), 0)

        # The next chunk begins with the next box that has points from there on.
        following = tl.where(starts >= stop, tl.minimum(following, starts), following)
        next_point = following // (SETS * GAP) * (SETS * GAP)
        ends_at = next_point - 1
        open_ = tl.where(following == NEVER, number, open_)
        while (open_ < number) & (ends_at < next_point):
            ends_at = tl.load(own + open_ * 4 + 3)
            if ends_at < next_point:
                open_ += 1

    tl.store(out_rgb + ray * 3, r, shown)
    tl.store(out_rgb + ray * 3 + 1, g, shown)
    tl.store(out_rgb + ray * 3 + 2, b, shown)
    tl.store(out_alpha + ray, reached, shown)
    mean = moment / tl.where(reached > 0, reached, 1.0)
    depth = base.to(tl.float32) * spacing + mean
    tl.store(out_depth + ray, tl.where(reached > 0, depth, float("inf")), shown)
    tl.store(out_first_hit + ray, tl.where(half < NEVER, half.to(tl.float32) * spacing, float("inf")), shown)
    if KEEP:
        tl.store(kept + ray * 8, kappa, shown)
        tl.store(kept + ray * 8 + 1, end_r, shown)
        tl.store(kept + ray * 8 + 2, end_g, shown)
        tl.store(kept + ray * 8 + 3, end_b, shown)
        tl.store(kept + ray * 8 + 4, mean, shown)
        tl.store(kept + ray * 8 + 5, reached, shown)
        tl.store(ends + ray * 2, end, shown)
        tl.store(ends + ray * 2 + 1, tl.zeros_like(end) + base, shown)


@triton.jit
def end_in_order(
    record, indices, voxels, entries, begin, count, out_rgb, kept, ends,
    boxes, own_boxes, height, width, tiles_across, lists_across, lists, spacing,
    TILES_OF_LIST: tl.constexpr, TILE_WIDTH: tl.constexpr, TILE_HEIGHT: tl.constexpr,
):  # fmt: skip
    """One tile of one view, after `march_tiles` with INDEX_ORDER: the point at which its rays become opaque.

    The lists must be in the order of the boxes' index. Boxes add until nothing is missing: this replaces the mixed
    colour in `out_rgb`. `kept` gets the share, the colour and, as 6, the index of the box that completed the ray; NEVER
    for rays that stay open.
    """
    view, tile = tl.program_id(1), tl.program_id(0)
    u, v, ray, shown = _rays(view, tile, height, width, tiles_across, TILE_WIDTH, TILE_HEIGHT)
    own, number = _list(view, tile, entries, begin, count, tiles_across, lists_across, lists, TILES_OF_LIST)
    first_box = view.to(tl.int64) * boxes
    end = tl.load(ends + ray * 2, shown, NEVER)
    ended = end < NEVER
    missing = tl.load(kept + ray * 8, ended, 0.0)
    end_r = tl.load(kept + ray * 8 + 1, ended, 0.0)
    end_g = tl.load(kept + ray * 8 + 2, ended, 0.0)
    end_b = tl.load(kept + ray * 8 + 3, ended, 0.0)
    r, g, b = -missing * end_r, -missing * end_g, -missing * end_b
    kappa, last = tl.zeros_like(missing) + 1.0, tl.zeros_like(end) + NEVER
    zero = tl.zeros((TILE_WIDTH * TILE_HEIGHT, 1), tl.float32)

    entry = tl.zeros((), tl.int32)
    open_ = ended
    while (entry < number) & (tl.max(open_.to(tl.int32), 0) > 0):
        at = own + entry * 4
        begins, ends_at = tl.load(at + 2), tl.load(at + 3)
        met = open_ & (end >= begins) & (end <= ends_at)
        if tl.max(met.to(tl.int32), 0) > 0:
            k = tl.load(at)
            row, line = record + (first_box + k) * 32, indices + (first_box + k) * 16
            source = voxels + (view.to(tl.int64) * own_boxes + k) * 2048
            px, py, pz, qx, qy, qz = ray_in_box(row, u, v)
            n0 = tl.load(line)
            n = tl.where(met, end, n0)[:, None]
            red, green, blue, opacity = _add_samples(
                zero, zero, zero, zero, n, n0, tl.load(line + 3), row, source, px, py, pz, qx, qy, qz,
                tl.where(met, end, NEVER), end, spacing, False,
            )  # fmt: skip
            red, green, blue, opacity = tl.sum(red, 1), tl.sum(green, 1), tl.sum(blue, 1), tl.sum(opacity, 1)
            seen = opacity > 0
            completes = seen & (opacity >= missing)
            adds = seen & (opacity < missing)
            r, g, b = r + tl.where(adds, red, 0.0), g + tl.where(adds, green, 0.0), b + tl.where(adds, blue, 0.0)
            inverse = 1.0 / tl.where(seen, opacity, 1.0)
            end_r, end_g = tl.where(seen, red * inverse, end_r), tl.where(seen, green * inverse, end_g)
            end_b = tl.where(seen, blue * inverse, end_b)
            kappa, last = tl.where(completes, missing * inverse, kappa), tl.where(seen, k, last)
            missing = tl.where(adds, missing - opacity, missing)
            open_ = open_ & (completes == 0)
        entry += 1
    # If rounding leaves something missing, the last box counts as the one that completes the ray.
    r, g, b = r + missing * end_r, g + missing * end_g, b + missing * end_b
    tl.store(out_rgb + ray * 3, tl.load(out_rgb + ray * 3, ended, 0.0) + r, ended)
    tl.store(out_rgb + ray * 3 + 1, tl.load(out_rgb + ray * 3 + 1, ended, 0.0) + g, ended)
    tl.store(out_rgb + ray * 3 + 2, tl.load(out_rgb + ray * 3 + 2, ended, 0.0) + b, ended)
    tl.store(kept + ray * 8, kappa, ended)
    tl.store(kept + ray * 8 + 1, end_r, ended)
    tl.store(kept + ray * 8 + 2, end_g, ended)
    tl.store(kept + ray * 8 + 3, end_b, ended)
    tl.store(kept + ray * 8 + 6, last.to(tl.float32), shown)
