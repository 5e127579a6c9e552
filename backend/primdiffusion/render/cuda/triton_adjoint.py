"""The backward pass as Triton kernels: a program processes a box in a view, or a part of its pixels (SPEC 4).

Compositing is additive, so the gradient of a sample depends on itself and on a few numbers of its ray, which
`seed_rays` writes, in any order. At lattice point n, with share = 1 before the point that saturates the ray, kappa at
it and 0 behind it,

    dL/da = share (<c, g_rgb> + g_distance (n - base) spacing + h),      dL/dc = share a g_rgb.

The gradient of a box's voxels is a sum over samples of hat(x) hat(y) hat(z) dL/d(c, density), which factors: with rows
(z, y) and columns (x, channel) it is a matrix product over samples, and runs on the tensor cores without atomics.
"""

# pyright: reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# Triton's language is Python by its syntax alone.
from __future__ import annotations

import triton
import triton.language as tl

from primdiffusion.render.cuda.triton_lists import NEVER, cell, channels, ray_in_box, window

SUMS = 24
"""Floats per unit besides voxels: sums of G = dL/dy 0-2, of G y^T 3-11, of dc v^T 12-20 (see `_on_direction`)."""


@triton.jit
def seed_rays(
    g_rgb, g_alpha, g_depth, kept, ends, seeds, rays, spacing, INDEX_ORDER: tl.constexpr, LANES: tl.constexpr
):  # fmt: skip
    """Per-ray inputs of the samples' gradients: g_rgb 0-2, g_distance 3, h 4, kappa 5, with INDEX_ORDER its box 6."""
    ray = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    here = ray < rays
    red = tl.load(g_rgb + ray * 3, here, 0.0)
    green = tl.load(g_rgb + ray * 3 + 1, here, 0.0)
    blue = tl.load(g_rgb + ray * 3 + 2, here, 0.0)
    end = tl.load(ends + ray * 2, here, NEVER)
    base = tl.load(ends + ray * 2 + 1, here, 0)
    mean = tl.load(kept + ray * 8 + 4, here, 0.0)
    alpha = tl.load(kept + ray * 8 + 5, here, 0.0)
    # depth = moment / alpha; it is infinite and has no gradient for background.
    seen = alpha > 0
    distance = tl.where(seen, tl.load(g_depth + ray, here, 0.0) / tl.where(seen, alpha, 1.0), 0.0)
    opaque = end < NEVER
    at_end = tl.load(kept + ray * 8 + 1, here, 0.0) * red + tl.load(kept + ray * 8 + 2, here, 0.0) * green
    at_end += tl.load(kept + ray * 8 + 3, here, 0.0) * blue + distance * (end - base).to(tl.float32) * spacing
    open_ = tl.load(g_alpha + ray, here, 0.0) - distance * mean
    tl.store(seeds + ray * 8, red, here)
    tl.store(seeds + ray * 8 + 1, green, here)
    tl.store(seeds + ray * 8 + 2, blue, here)
    tl.store(seeds + ray * 8 + 3, distance, here)
    tl.store(seeds + ray * 8 + 4, tl.where(opaque, -at_end, open_), here)
    tl.store(seeds + ray * 8 + 5, tl.where(opaque, tl.load(kept + ray * 8, here, 0.0), 1.0), here)
    if INDEX_ORDER:
        tl.store(seeds + ray * 8 + 6, tl.load(kept + ray * 8 + 6, here, 0.0), here)


@triton.jit
def _interval(p, q, low, high):
    """Interval of s with p + s q in [-1, 1], clipped to [low, high]."""
    q = tl.where(tl.abs(q) < 1e-12, 1e-12, q)
    inverse = 1.0 / q
    middle, half = -p * inverse, tl.abs(inverse)
    return tl.maximum(low, middle - half), tl.minimum(high, middle + half)


@triton.jit
def _weighted(v, red, green, blue, density):
    """The four channels of a corner [lanes, 4], weighted and added."""
    r, g, b, d = channels(tl.reshape(v, (v.shape[0], 2, 2)))
    return r * red + g * green + b * blue + d * density


@triton.jit
def _mixed(a, b, f):
    return a + f * (b - a)


@triton.jit
def _rounded(x):
    """Round x to tf32, ten bits of mantissa: tensor cores truncate, which would bias sums."""
    return ((x.to(tl.int32, bitcast=True) + 0x1000) & -0x2000).to(tl.float32, bitcast=True)


@triton.jit
def _hats(u, grid):
    """hat(u - i) of each sample [columns] for grid points i [rows]."""
    return tl.maximum(1.0 - tl.abs(u[None, :] - grid[:, None]), 0.0)


@triton.jit
def _to_world(rotation, half_extent, x, y, z):
    """W^T [x, y, z] with W = diag(1 / half_extent) R^T."""
    x, y, z = x / tl.load(half_extent), y / tl.load(half_extent + 1), z / tl.load(half_extent + 2)
    return (
        tl.load(rotation) * x + tl.load(rotation + 1) * y + tl.load(rotation + 2) * z,
        tl.load(rotation + 3) * x + tl.load(rotation + 4) * y + tl.load(rotation + 5) * z,
        tl.load(rotation + 6) * x + tl.load(rotation + 7) * y + tl.load(rotation + 8) * z,
    )


@triton.jit
def _on_direction(rotation, half_extent, lens, camera, column, down, x, y, z):
    """From sum t dL/dy of a ray to v = dL/dm, where d = m / |m| and m = R_c^T [x, y, 1]; also these x and y."""
    wx, wy, wz = _to_world(rotation, half_extent, x, y, z)
    y = (down + (0.5 - tl.load(lens + 5))) / tl.load(lens + 4)
    x = (column + (0.5 - tl.load(lens + 2)) - tl.load(lens + 1) * y) / tl.load(lens)
    mx = tl.load(camera) * x + tl.load(camera + 4) * y + tl.load(camera + 8)
    my = tl.load(camera + 1) * x + tl.load(camera + 5) * y + tl.load(camera + 9)
    mz = tl.load(camera + 2) * x + tl.load(camera + 6) * y + tl.load(camera + 10)
    inverse = 1.0 / tl.sqrt(mx * mx + my * my + mz * mz)
    mx, my, mz = mx * inverse, my * inverse, mz * inverse
    along = mx * wx + my * wy + mz * wz
    return x, y, (wx - along * mx) * inverse, (wy - along * my) * inverse, (wz - along * mz) * inverse


@triton.jit
def adjoint_boxes(
    record, indices, voxels, reach, seeds, ends, unit_box, unit_part,
    rotation, half_extent, intrinsics, world_to_camera, out_voxels, out_sums,
    boxes, own_boxes, height, width, blocks_of_unit, spacing,
    HAS_SPAN: tl.constexpr, INDEX_ORDER: tl.constexpr, BLOCK_WIDTH: tl.constexpr, BLOCK_HEIGHT: tl.constexpr,
):  # fmt: skip
    """One unit: up to `blocks_of_unit` blocks of the pixels that a box covers in a view.

    With INDEX_ORDER, at the point that saturates a ray only the box in its seed has the share kappa: boxes of lower
    index have 1, those of higher index 0.
    """
    unit = tl.program_id(0).to(tl.int64)
    k = tl.load(unit_box + unit).to(tl.int64)
    view = k // boxes
    row, line = record + k * 32, indices + k * 16
    box = view * own_boxes + k % boxes
    source = voxels + box * 2048
    n0, stride = tl.load(line), tl.load(line + 3)
    left, right, top, bottom = tl.load(line + 8), tl.load(line + 9), tl.load(line + 10), tl.load(line + 11)
    length = tl.load(row + 26)
    across = (right - left) // BLOCK_WIDTH + 1
    begin = tl.load(unit_part + unit).to(tl.int32) * blocks_of_unit
    stop = tl.minimum(begin + blocks_of_unit, tl.load(line + 12))
    camera, lens = world_to_camera + view * 12, intrinsics + view * 9
    step = spacing * stride.to(tl.float32)
    along = tl.load(row + 12)

    LANES: tl.constexpr = BLOCK_WIDTH * BLOCK_HEIGHT
    lane = tl.arange(0, LANES)
    quad = tl.arange(0, 4)[None, :]
    grid_z, grid_y = (tl.arange(0, 64) // 8).to(tl.float32), (tl.arange(0, 64) % 8).to(tl.float32)
    grid_x, channel = (tl.arange(0, 32) // 4).to(tl.float32), tl.arange(0, 32) % 4
    gradient = tl.zeros((64, 32), tl.float32)
    zero = tl.zeros((LANES,), tl.float32)
    g0, g1, g2 = zero, zero, zero
    g00, g01, g02, g10, g11, g12, g20, g21, g22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    s00, s01, s02, s10, s11, s12, s20, s21, s22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for block in range(begin, stop):
        column = left + block % across * BLOCK_WIDTH + lane % BLOCK_WIDTH
        down = top + block // across * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        here = (column <= right) & (down <= bottom)
        ray = (view * height + down) * width + column
        end = tl.load(ends + ray * 2, here, 0)
        u, v = column.to(tl.float32), down.to(tl.float32)
        px, py, pz, qx, qy, qz = ray_in_box(row, u, v)
        low, high = zero - n0.to(tl.float32) * spacing, zero + 1e30
        low, high = _interval(px, qx, low, high)
        low, high = _interval(py, qy, low, high)
        low, high = _interval(pz, qz, low, high)
        # Slightly too wide, for rounding; |y| < 1 is tested below.
        met = here & (low <= high + 0.1 * step)
        low = tl.where(met, low, 0.0) / spacing
        high = tl.where(met, high, -1.0) / spacing
        first = n0 + tl.ceil(tl.minimum(tl.maximum(low, -1e9), 1e9) - 0.01).to(tl.int32)
        last = n0 + tl.floor(tl.minimum(tl.maximum(high, -1e9), 1e9) + 0.01).to(tl.int32)
        first, last = tl.maximum(first, 1), tl.minimum(last, end)
        if INDEX_ORDER:
            own, saturating = (k % boxes).to(tl.float32), tl.load(seeds + ray * 8 + 6, here, 0.0)
            last = tl.where(own > saturating, tl.minimum(last, end - 1), last)
            end = tl.where(own == saturating, end, NEVER)
        if HAS_SPAN:
            first = tl.maximum(first, tl.load(reach + ray * 2, here, NEVER))
            last = tl.minimum(last, tl.load(reach + ray * 2 + 1, here, 0))
        first = (first + stride - 1) // stride * stride
        number = tl.where(met & (first <= last), (last - first) // stride + 1, 0)
        most = tl.max(number, 0)
        if most > 0:
            red = tl.load(seeds + ray * 8, here, 0.0)
            green = tl.load(seeds + ray * 8 + 1, here, 0.0)
            blue = tl.load(seeds + ray * 8 + 2, here, 0.0)
            distance = tl.load(seeds + ray * 8 + 3, here, 0.0)
            rest = tl.load(seeds + ray * 8 + 4, here, 0.0)
            kappa = tl.load(seeds + ray * 8 + 5, here, 0.0)
            base = tl.load(ends + ray * 2 + 1, here, 0)
            a0, a1, a2, b0, b1, b2 = zero, zero, zero, zero, zero, zero
            for i in range(0, most):
                n = first + i * stride
                t = (n - n0).to(tl.float32) * spacing
                x, y, z = px + t * qx, py + t * qy, pz + t * qz
                inside = (i < number) & (tl.abs(x) < 1) & (tl.abs(y) < 1) & (tl.abs(z) < 1)
                # High powers far outside would be infinite, and NaN when multiplied by 0.
                x, y, z = tl.where(inside, x, 0.0), tl.where(inside, y, 0.0), tl.where(inside, z, 0.0)
                ix, fx = cell(x)
                iy, fy = cell(y)
                iz, fz = cell(z)
                corner = source + ((iz * 64 + iy * 8 + ix) * 4)[:, None] + quad
                mask = inside[:, None]
                v000, v001 = tl.load(corner, mask, 0.0), tl.load(corner + 4, mask, 0.0)
                v010, v011 = tl.load(corner + 32, mask, 0.0), tl.load(corner + 36, mask, 0.0)
                v100, v101 = tl.load(corner + 256, mask, 0.0), tl.load(corner + 260, mask, 0.0)
                v110, v111 = tl.load(corner + 288, mask, 0.0), tl.load(corner + 292, mask, 0.0)
                wx, wy, wz = fx[:, None], fy[:, None], fz[:, None]
                low_z = _mixed(_mixed(v000, v001, wx), _mixed(v010, v011, wx), wy)
                high_z = _mixed(_mixed(v100, v101, wx), _mixed(v110, v111, wx), wy)
                r, g, b, density = channels(tl.reshape(_mixed(low_z, high_z, wz), (LANES, 2, 2)))
                share = tl.where(inside, tl.where(n == end, kappa, 1.0), 0.0)
                visible = window(x, y, z) * length
                a = density * visible
                on_a = r * red + g * green + b * blue + distance * ((n - base).to(tl.float32) * spacing) + rest
                on_a *= share
                on_red, on_green, on_blue, on_density = (
                    share * a * red,
                    share * a * green,
                    share * a * blue,
                    on_a * visible,
                )

                # Gradient by position, through interpolation and window.
                c000 = _weighted(v000, on_red, on_green, on_blue, on_density)
                c001 = _weighted(v001, on_red, on_green, on_blue, on_density)
                c010 = _weighted(v010, on_red, on_green, on_blue, on_density)
                c011 = _weighted(v011, on_red, on_green, on_blue, on_density)
                c100 = _weighted(v100, on_red, on_green, on_blue, on_density)
                c101 = _weighted(v101, on_red, on_green, on_blue, on_density)
                c110 = _weighted(v110, on_red, on_green, on_blue, on_density)
                c111 = _weighted(v111, on_red, on_green, on_blue, on_density)
                on_x = _mixed(_mixed(c001 - c000, c011 - c010, fy), _mixed(c101 - c100, c111 - c110, fy), fz)
                on_y = _mixed(_mixed(c010 - c000, c011 - c001, fx), _mixed(c110 - c100, c111 - c101, fx), fz)
                on_z = _mixed(_mixed(c100 - c000, c101 - c001, fx), _mixed(c110 - c010, c111 - c011, fx), fy)
                fade = on_a * a * -64.0
                x2, y2, z2 = x * x, y * y, z * z
                on_x = 3.5 * on_x + fade * (x2 * x2 * x2 * x)
                on_y = 3.5 * on_y + fade * (y2 * y2 * y2 * y)
                on_z = 3.5 * on_z + fade * (z2 * z2 * z2 * z)
                a0, a1, a2 = a0 + on_x, a1 + on_y, a2 + on_z
                b0, b1, b2 = b0 + t * on_x, b1 + t * on_y, b2 + t * on_z

                # Gradient by contents. Samples outside have on_* = 0.
                rows = _hats(iz.to(tl.float32) + fz, grid_z) * _hats(iy.to(tl.float32) + fy, grid_y)
                c = channel[:, None]
                low_c = tl.where(c == 0, on_red[None, :], on_green[None, :])
                high_c = tl.where(c == 2, on_blue[None, :], on_density[None, :])
                # Written as [32, LANES], so that each thread stays with its sample.
                columns = _hats(ix.to(tl.float32) + fx, grid_x) * tl.where(c < 2, low_c, high_c)
                gradient = tl.dot(_rounded(rows), tl.trans(_rounded(columns)), gradient, input_precision="tf32")

            # sum G, sum G y^T with y = p + t q, and the gradient of the ray's direction.
            g0, g1, g2 = g0 + a0, g1 + a1, g2 + a2
            g00, g01, g02 = g00 + a0 * px + b0 * qx, g01 + a0 * py + b0 * qy, g02 + a0 * pz + b0 * qz
            g10, g11, g12 = g10 + a1 * px + b1 * qx, g11 + a1 * py + b1 * qy, g12 + a1 * pz + b1 * qz
            g20, g21, g22 = g20 + a2 * px + b2 * qx, g21 + a2 * py + b2 * qy, g22 + a2 * pz + b2 * qz
            x, y, v0, v1, v2 = _on_direction(
                rotation + box * 9, half_extent + box * 3, lens, camera, u, v,
                along * a0 + b0, along * a1 + b1, along * a2 + b2,
            )  # fmt: skip
            s00, s01, s02 = s00 + x * v0, s01 + x * v1, s02 + x * v2
            s10, s11, s12 = s10 + y * v0, s11 + y * v1, s12 + y * v2
            s20, s21, s22 = s20 + v0, s21 + v1, s22 + v2

    i, j = tl.arange(0, 64), tl.arange(0, 32)
    tl.store(out_voxels + unit * 2048 + i[:, None] * 32 + j[None, :], gradient)
    sums = out_sums + unit * 24
    _store_row(sums, g0, g1, g2)
    _store_row(sums + 3, g00, g01, g02)
    _store_row(sums + 6, g10, g11, g12)
    _store_row(sums + 9, g20, g21, g22)
    _store_row(sums + 12, s00, s01, s02)
    _store_row(sums + 15, s10, s11, s12)
    _store_row(sums + 18, s20, s21, s22)


@triton.jit
def _store_row(at, x, y, z):
    tl.store(at, tl.sum(x, 0))
    tl.store(at + 1, tl.sum(y, 0))
    tl.store(at + 2, tl.sum(z, 0))


@triton.jit
def finish_boxes(
    unit_end, unit_voxels, unit_sums, rotation, half_extent,
    on_position, on_rotation, on_half_extent, on_rgb, on_density, on_camera, views, boxes, own_boxes,
):  # fmt: skip
    """One box: sum its units of all views that share it, and convert the sums to gradients.

    `unit_end` [view, box] is the cumulative number of units. `on_camera` [view, box, 12] gets the box's contribution to
    dL/do, o the camera position, and to sum dc v^T.
    """
    k = tl.program_id(0).to(tl.int64)
    box = tl.program_id(1) * own_boxes + k
    here, extent = rotation + box * 9, half_extent + box * 3
    i, j = tl.arange(0, 64)[:, None], tl.arange(0, 32)[None, :]
    voxels = tl.zeros((64, 32), tl.float32)
    lane = tl.arange(0, 32)
    total = tl.zeros((32,), tl.float32)
    first_view = tl.program_id(1)
    for view in range(first_view, first_view + views):
        sums = tl.zeros((32,), tl.float32)
        at = view * boxes + k
        stop = tl.load(unit_end + at)
        begin = tl.load(unit_end + at - 1, at > 0, 0)
        for unit in range(begin, stop):
            voxels += tl.load(unit_voxels + unit * 2048 + i * 32 + j)
            sums += tl.load(unit_sums + unit * 24 + lane, lane < 21, 0.0)
        ox, oy, oz = _to_world(here, extent, _pick(sums, 0), _pick(sums, 1), _pick(sums, 2))
        solid = stop > begin
        tl.store(on_camera + at * 12, tl.where(solid, ox, 0.0))
        tl.store(on_camera + at * 12 + 1, tl.where(solid, oy, 0.0))
        tl.store(on_camera + at * 12 + 2, tl.where(solid, oz, 0.0))
        tl.store(on_camera + at * 12 + lane - 9, sums, (lane >= 12) & (lane < 21))
        total += sums
    channel, column = j % 4, j // 4
    voxel = i * 8 + column
    tl.store(on_rgb + (box * 3 + channel) * 512 + voxel, voxels, channel < 3)
    tl.store(on_density + box * 512 + voxel, voxels, channel == 3)

    # With W = diag(1 / h) R^T and x - T = R diag(h) y: dL/dW = (sum G y^T) diag(h) R^T.
    for axis in tl.static_range(3):
        h = tl.load(extent + axis)
        inverse = tl.where(h > 0, 1.0 / h, 0.0)
        tl.store(on_half_extent + box * 3 + axis, -_pick(total, 4 * axis + 3) * inverse)
        gx = _pick(total, 3 * axis + 3) * tl.load(extent)
        gy = _pick(total, 3 * axis + 4) * tl.load(extent + 1)
        gz = _pick(total, 3 * axis + 5) * tl.load(extent + 2)
        on_place = tl.zeros((), tl.float32)
        for j3 in tl.static_range(3):
            at_row = here + 3 * j3
            along = tl.load(at_row) * gx + tl.load(at_row + 1) * gy + tl.load(at_row + 2) * gz
            tl.store(on_rotation + box * 9 + 3 * j3 + axis, along * inverse)
            # dL/dT = -W^T sum G, one component at a time.
            own = tl.load(extent + j3)
            on_place -= tl.load(here + 3 * axis + j3) * _pick(total, j3) * tl.where(own > 0, 1.0 / own, 0.0)
        tl.store(on_position + box * 3 + axis, on_place)


@triton.jit
def _pick(values, i: tl.constexpr):
    """One of 32 values."""
    return tl.sum(tl.where(tl.arange(0, 32) == i, values, 0.0), 0)
