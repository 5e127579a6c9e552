"""Triton kernels that pack boxes for the marcher: contents as 16-byte voxels, positions as a record per view (SPEC 4).

A sample is y = W (o + t d - T), W = diag(1 / half_extent) R^T. Far from the camera t d and T - o nearly cancel, so a
box has a reference point near itself, computed in float64: the lattice point n0 on the ray through its centre, whose
direction is D and whose pixel is (u0, v0). With d = D + delta and t = (n0 + n) * spacing

    y = e + t0 W delta + n spacing W d,      e = W (o + t0 D - T),

in which every term has the magnitude of the box, and delta follows from pixel differences: m = R_c^T K^-1 [u, v, 1] is
m0 + du a + dv b, and delta = (du a + dv b - D (|m| - |m0|)) / |m| with |m|^2 = |m0|^2 + du (g + ...) + dv (h + ...).
"""

# pyright: reportGeneralTypeIssues=false, reportAttributeAccessIssue=false, reportArgumentType=false
# Triton's language is Python by its syntax alone.
from __future__ import annotations

import triton
import triton.language as tl

RECORD = 32
"""Floats of a box as one view sees it: W a 0-2, W b 3-5, W D 6-8, e 9-11, t0 12, |m0| 13, 2 m0.a 14, 2 m0.b 15, pixel
u0, v0 as whole and fraction 16-19, bounds of its content 20-25, length of a sample 26, a.a 27, 2 a.b 28, b.b 29."""
INDICES = 16
"""Integers of a box as one view sees it: n0 0, first and last lattice point of its content 1-2, stride 3, tile
columns and rows that its content touches 4-7, pixel columns and rows that all of it touches 8-11, blocks in them 12."""

ORTHOGONAL = tl.constexpr(1e-2)
NEARLY_ORTHOGONAL = tl.constexpr(0.045)  # of a camera, the rows of whose matrix are compared here, not its columns
# Totals: 0 errors, as bits (content 1, place 2, camera 4; `check_scene` produces the message), 1 pairs of boxes and
# bins, 2 pairs of boxes and tiles, 3 units of the adjoint, 4 spans with NaN, 5 whether a stride is odd (1), or even and
# no multiple of 4 (2).
TOTALS = 6

OPTICAL = tl.constexpr(1e-2)  # a centre further off the optical axis than arccos of this has no pixel to refer to
MARGIN = tl.constexpr(0.01)  # pixels added around a rectangle against rounding
FAR_PIXEL = tl.constexpr(1e6)
LAST_POINT = tl.constexpr(1 << 30)


@triton.jit
def pack_boxes(rgb, density, voxels, bounds):
    """One box: [3, 512] and [512] to [512, 4], and to `bounds` the range of visible voxel indices, and 1 for errors."""
    box = tl.program_id(0).to(tl.int64)
    i = tl.arange(0, 512)
    red = tl.load(rgb + box * 1536 + i)
    green = tl.load(rgb + box * 1536 + 512 + i)
    blue = tl.load(rgb + box * 1536 + 1024 + i)
    opacity = tl.load(density + box * 512 + i)
    together = tl.reshape(tl.join(tl.join(red, blue), tl.join(green, opacity)), (2048,))
    tl.store(voxels + box * 2048 + tl.arange(0, 2048), together)

    sound = (tl.abs(red) < float("inf")) & (tl.abs(green) < float("inf")) & (tl.abs(blue) < float("inf"))
    sound = sound & (opacity >= 0) & (opacity < float("inf"))
    tl.store(bounds + box * 8 + 6, 1 - tl.min(sound.to(tl.int32), 0))

    # A cell next to a voxel with density may have density; the others are empty.
    seen = opacity > 0
    for axis in tl.static_range(3):
        index = (i // (8**axis)) % 8
        low = tl.min(tl.where(seen, index, 8), 0) - 1
        high = tl.max(tl.where(seen, index, -2), 0) + 1
        tl.store(bounds + box * 8 + axis, tl.maximum(low, 0))
        tl.store(bounds + box * 8 + 3 + axis, tl.minimum(high, 7))


@triton.jit
def _row(matrix, row: tl.constexpr, columns: tl.constexpr):
    """Three entries of a small float32 matrix, in float64."""
    x = tl.load(matrix + row * columns).to(tl.float64)
    y = tl.load(matrix + row * columns + 1).to(tl.float64)
    z = tl.load(matrix + row * columns + 2).to(tl.float64)
    return x, y, z


@triton.jit
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@triton.jit
def _corner(CORNER: tl.constexpr, lx, ly, lz, hx, hy, hz):
    """One of the eight corners of [l, h]."""
    return (hx if CORNER % 2 else lx), (hy if CORNER // 2 % 2 else ly), (hz if CORNER // 4 else lz)


@triton.jit
def _other(EDGE: tl.constexpr):
    """One of the twelve edges of a cube as the numbers of its two corners, 8 * first + second."""
    AXIS: tl.constexpr = EDGE // 4
    LOW: tl.constexpr = EDGE % 4
    FIRST: tl.constexpr = LOW * 2 if AXIS == 0 else (LOW % 2 + LOW // 2 * 4 if AXIS == 1 else LOW)
    return 8 * FIRST + FIRST + (1 if AXIS == 0 else 2 if AXIS == 1 else 4)


@triton.jit
def _grow(u0, u1, v0, v1, x, y, z, seen, fx, skew, cx, fy, cy):
    """A rectangle grown to hold the pixel of a point in the camera's coordinates, where `seen`."""
    inverse = 1.0 / tl.where(seen, z, 1.0)
    v = tl.minimum(tl.maximum(fy * y * inverse + cy, -FAR_PIXEL), FAR_PIXEL)
    u = tl.minimum(tl.maximum((fx * x + skew * y) * inverse + cx, -FAR_PIXEL), FAR_PIXEL)
    u0, u1 = tl.where(seen, tl.minimum(u0, u), u0), tl.where(seen, tl.maximum(u1, u), u1)
    v0, v1 = tl.where(seen, tl.minimum(v0, v), v0), tl.where(seen, tl.maximum(v1, v), v1)
    return u0, u1, v0, v1


@triton.jit
def _place(a, b, c, centre, x, y, z):
    """centre + a x + b y + c z of vectors."""
    return (
        centre[0] + a * x[0] + b * y[0] + c * z[0],
        centre[1] + a * x[1] + b * y[1] + c * z[1],
        centre[2] + a * x[2] + b * y[2] + c * z[2],
    )


@triton.jit
def _rectangle(centre, x, y, z, lx, ly, lz, hx, hy, hz, near, width, height, fx, skew, cx, fy, cy):
    """First and last pixel column and row that see the part [l, h] of a box, and how far that part extends.

    The box's centre and half axes are in the camera's coordinates, in float32. Edges are cut at the plane z = near.
    """
    none = centre[2] * 0
    u0, u1, v0, v1 = none + FAR_PIXEL, none - FAR_PIXEL, none + FAR_PIXEL, none - FAR_PIXEL
    reach, nearest, furthest = none, none + float("inf"), none - float("inf")
    for corner in tl.static_range(8):
        a, b, c = _corner(corner, lx, ly, lz, hx, hy, hz)
        px, py, pz = _place(a, b, c, centre, x, y, z)
        reach = tl.maximum(reach, px * px + py * py + pz * pz)
        nearest, furthest = tl.minimum(nearest, pz), tl.maximum(furthest, pz)
        u0, u1, v0, v1 = _grow(u0, u1, v0, v1, px, py, pz, pz >= near, fx, skew, cx, fy, cy)
    if tl.max(((nearest < near) & (furthest >= near)).to(tl.int32), 0) > 0:
        for edge in tl.static_range(12):
            a, b, c = _corner(_other(edge) // 8, lx, ly, lz, hx, hy, hz)
            px, py, pz = _place(a, b, c, centre, x, y, z)
            a, b, c = _corner(_other(edge) % 8, lx, ly, lz, hx, hy, hz)
            qx, qy, qz = _place(a, b, c, centre, x, y, z)
            crosses = (pz < near) != (qz < near)
            share = (near - pz) / tl.where(crosses, qz - pz, 1.0)
            kx, ky = px + share * (qx - px), py + share * (qy - py)
            u0, u1, v0, v1 = _grow(u0, u1, v0, v1, kx, ky, none + near, crosses, fx, skew, cx, fy, cy)
    left = tl.maximum(tl.ceil(u0 - tl.abs(u0) * 1e-5 - (MARGIN + 0.5)), 0.0).to(tl.int32)
    right = tl.minimum(tl.floor(u1 + tl.abs(u1) * 1e-5 + (MARGIN - 0.5)), width - 1.0).to(tl.int32)
    top = tl.maximum(tl.ceil(v0 - tl.abs(v0) * 1e-5 - (MARGIN + 0.5)), 0.0).to(tl.int32)
    bottom = tl.minimum(tl.floor(v1 + tl.abs(v1) * 1e-5 + (MARGIN - 0.5)), height - 1.0).to(tl.int32)
    return left, right, top, bottom, tl.sqrt(reach)


@triton.jit
def place_boxes(
    position, rotation, half_extent, bounds, intrinsics, world_to_camera, lattice, record, indices, first_point, totals,
    boxes, own_boxes, width, height, blocks_of_unit,
    STRIDES: tl.constexpr, TILE_WIDTH: tl.constexpr, TILE_HEIGHT: tl.constexpr, BIN: tl.constexpr,
    BLOCK_WIDTH: tl.constexpr, BLOCK_HEIGHT: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """LANES boxes in one view: their records (see RECORD, INDICES), and the totals by which lists are allocated.

    `own_boxes` is 0 if all views share one set of boxes. `lattice` contains, in float64, the spacing of lattice points
    and for each of STRIDES the smallest voxel edge that it suits.
    """
    view = tl.program_id(1)
    k = tl.program_id(0) * LANES + tl.arange(0, LANES)
    here = k < boxes
    source = view.to(tl.int64) * own_boxes + k
    target = view.to(tl.int64) * boxes + k
    spacing = tl.load(lattice)

    # The camera: x_camera = r x + t, its rows r0, r1, r2; the origin o = -r^T t.
    r0x, r0y, r0z = _row(world_to_camera + view * 12, 0, 4)
    r1x, r1y, r1z = _row(world_to_camera + view * 12, 1, 4)
    r2x, r2y, r2z = _row(world_to_camera + view * 12, 2, 4)
    t0 = tl.load(world_to_camera + view * 12 + 3).to(tl.float64)
    t1 = tl.load(world_to_camera + view * 12 + 7).to(tl.float64)
    t2 = tl.load(world_to_camera + view * 12 + 11).to(tl.float64)
    fx, skew, cx = _row(intrinsics + view * 9, 0, 3)
    _, fy, cy = _row(intrinsics + view * 9, 1, 3)
    ox, oy, oz = -_dot(r0x, r1x, r2x, t0, t1, t2), -_dot(r0y, r1y, r2y, t0, t1, t2), -_dot(r0z, r1z, r2z, t0, t1, t2)
    # A pixel to the right moves m by a, one down by b.
    ax, ay, az = r0x / fx, r0y / fx, r0z / fx
    shear = skew / fx
    bx, by, bz = (r1x - shear * r0x) / fy, (r1y - shear * r0y) / fy, (r1z - shear * r0z) / fy
    sum_camera = tl.abs(ox) + tl.abs(oy) + tl.abs(oz) + _dot(tl.abs(ax), tl.abs(ay), tl.abs(az), 1.0, 1.0, 1.0)
    sum_camera += tl.abs(cx) + tl.abs(cy) + _dot(tl.abs(bx), tl.abs(by), tl.abs(bz), 1.0, 1.0, 1.0)
    sum_camera += tl.abs(r2x) + tl.abs(r2y) + tl.abs(r2z)

    # The boxes: columns of R, half extents, centre.
    px = tl.load(position + source * 3, here, 0.0).to(tl.float64)
    py = tl.load(position + source * 3 + 1, here, 0.0).to(tl.float64)
    pz = tl.load(position + source * 3 + 2, here, 0.0).to(tl.float64)
    h0_single = tl.load(half_extent + source * 3, here, 0.0)
    h1_single = tl.load(half_extent + source * 3 + 1, here, 0.0)
    h2_single = tl.load(half_extent + source * 3 + 2, here, 0.0)
    shortest = tl.minimum(tl.minimum(h0_single, h1_single), h2_single)
    xx = tl.load(rotation + source * 9, here, 1.0).to(tl.float64)
    yx = tl.load(rotation + source * 9 + 1, here, 0.0).to(tl.float64)
    zx = tl.load(rotation + source * 9 + 2, here, 0.0).to(tl.float64)
    xy = tl.load(rotation + source * 9 + 3, here, 0.0).to(tl.float64)
    yy = tl.load(rotation + source * 9 + 4, here, 1.0).to(tl.float64)
    zy = tl.load(rotation + source * 9 + 5, here, 0.0).to(tl.float64)
    xz = tl.load(rotation + source * 9 + 6, here, 0.0).to(tl.float64)
    yz = tl.load(rotation + source * 9 + 7, here, 0.0).to(tl.float64)
    zz = tl.load(rotation + source * 9 + 8, here, 1.0).to(tl.float64)

    shear_off = tl.maximum(tl.abs(_dot(xx, xy, xz, xx, xy, xz) - 1), tl.abs(_dot(yx, yy, yz, yx, yy, yz) - 1))
    shear_off = tl.maximum(shear_off, tl.abs(_dot(zx, zy, zz, zx, zy, zz) - 1))
    shear_off = tl.maximum(shear_off, tl.abs(_dot(xx, xy, xz, yx, yy, yz)))
    shear_off = tl.maximum(shear_off, tl.abs(_dot(xx, xy, xz, zx, zy, zz)))
    shear_off = tl.maximum(shear_off, tl.abs(_dot(yx, yy, yz, zx, zy, zz)))
    size_sum = tl.abs(px) + tl.abs(py) + tl.abs(pz) + tl.abs(h0_single) + tl.abs(h1_single) + tl.abs(h2_single)
    # `maximum` of a device drops NaN, sums keep it.
    size_sum += tl.abs(xx) + tl.abs(xy) + tl.abs(xz) + tl.abs(yx) + tl.abs(yy) + tl.abs(yz)
    size_sum += tl.abs(zx) + tl.abs(zy) + tl.abs(zz)
    sound = (shear_off <= ORTHOGONAL) & (size_sum < float("inf"))
    if tl.min((sound | (here == 0)).to(tl.int32), 0) == 0:
        tl.atomic_or(totals, 2)
    bent = tl.maximum(tl.abs(_dot(r0x, r0y, r0z, r0x, r0y, r0z) - 1), tl.abs(_dot(r1x, r1y, r1z, r1x, r1y, r1z) - 1))
    bent = tl.maximum(bent, tl.abs(_dot(r2x, r2y, r2z, r2x, r2y, r2z) - 1))
    bent = tl.maximum(bent, tl.abs(_dot(r0x, r0y, r0z, r1x, r1y, r1z)))
    bent = tl.maximum(bent, tl.abs(_dot(r0x, r0y, r0z, r2x, r2y, r2z)))
    bent = tl.maximum(bent, tl.abs(_dot(r1x, r1y, r1z, r2x, r2y, r2z)))
    rigid = (k * 0 + sum_camera < float("inf")) & (k * 0 + bent <= NEARLY_ORTHOGONAL)
    if tl.min(rigid.to(tl.int32), 0) == 0:
        tl.atomic_or(totals, 4)
    if tl.max(tl.load(bounds + source * 8 + 6, here, 0), 0) > 0:
        tl.atomic_or(totals, 1)
    # The host looks at errors when the picture is under way: boxes with errors could take billions of samples.
    solid = here & (shortest > 0) & sound & rigid
    h0 = tl.where(solid, h0_single, 1.0).to(tl.float64)
    h1 = tl.where(solid, h1_single, 1.0).to(tl.float64)
    h2 = tl.where(solid, h2_single, 1.0).to(tl.float64)

    # The reference: direction D through pixel (u0, v0), lattice point n0.
    wx, wy, wz = px - ox, py - oy, pz - oz
    distance = tl.sqrt(_dot(wx, wy, wz, wx, wy, wz))
    depth = _dot(r2x, r2y, r2z, px, py, pz) + t2
    beside = _dot(r0x, r0y, r0z, px, py, pz) + t0
    below = _dot(r1x, r1y, r1z, px, py, pz) + t1
    ahead = (depth > distance * OPTICAL) & solid & (distance < float("inf"))
    safe = tl.where(ahead, depth, 1.0)
    x0, y0 = tl.where(ahead, beside / safe, 0.0), tl.where(ahead, below / safe, 0.0)
    n0 = tl.where(ahead, tl.floor(distance / spacing + 0.5), 0.0)
    n0 = tl.minimum(n0, LAST_POINT * 1.0)
    mx, my, mz = r0x * x0 + r1x * y0 + r2x, r0y * x0 + r1y * y0 + r2y, r0z * x0 + r1z * y0 + r2z
    length = tl.sqrt(_dot(mx, my, mz, mx, my, mz))
    dx, dy, dz = mx / length, my / length, mz / length
    u0 = tl.minimum(tl.maximum(fx * x0 + skew * y0 + cx, -FAR_PIXEL), FAR_PIXEL)
    v0 = tl.minimum(tl.maximum(fy * y0 + cy, -FAR_PIXEL), FAR_PIXEL)
    along = n0 * spacing
    ex, ey, ez = along * dx - wx, along * dy - wy, along * dz - wz

    i0, i1, i2 = 1.0 / h0, 1.0 / h1, 1.0 / h2
    row = record + target * 32
    tl.store(row, (_dot(xx, xy, xz, ax, ay, az) * i0).to(tl.float32), here)
    tl.store(row + 1, (_dot(yx, yy, yz, ax, ay, az) * i1).to(tl.float32), here)
    tl.store(row + 2, (_dot(zx, zy, zz, ax, ay, az) * i2).to(tl.float32), here)
    tl.store(row + 3, (_dot(xx, xy, xz, bx, by, bz) * i0).to(tl.float32), here)
    tl.store(row + 4, (_dot(yx, yy, yz, bx, by, bz) * i1).to(tl.float32), here)
    tl.store(row + 5, (_dot(zx, zy, zz, bx, by, bz) * i2).to(tl.float32), here)
    tl.store(row + 6, (_dot(xx, xy, xz, dx, dy, dz) * i0).to(tl.float32), here)
    tl.store(row + 7, (_dot(yx, yy, yz, dx, dy, dz) * i1).to(tl.float32), here)
    tl.store(row + 8, (_dot(zx, zy, zz, dx, dy, dz) * i2).to(tl.float32), here)
    tl.store(row + 9, (_dot(xx, xy, xz, ex, ey, ez) * i0).to(tl.float32), here)
    tl.store(row + 10, (_dot(yx, yy, yz, ex, ey, ez) * i1).to(tl.float32), here)
    tl.store(row + 11, (_dot(zx, zy, zz, ex, ey, ez) * i2).to(tl.float32), here)
    tl.store(row + 12, along.to(tl.float32), here)
    tl.store(row + 13, length.to(tl.float32), here)
    tl.store(row + 14, (2 * _dot(mx, my, mz, ax, ay, az)).to(tl.float32), here)
    tl.store(row + 15, (2 * _dot(mx, my, mz, bx, by, bz)).to(tl.float32), here)
    tl.store(row + 16, tl.floor(u0).to(tl.float32), here)
    tl.store(row + 17, (u0 - tl.floor(u0)).to(tl.float32), here)
    tl.store(row + 18, tl.floor(v0).to(tl.float32), here)
    tl.store(row + 19, (v0 - tl.floor(v0)).to(tl.float32), here)
    tl.store(row + 27, (k * 0 + _dot(ax, ay, az, ax, ay, az)).to(tl.float32), here)
    tl.store(row + 28, (k * 0 + 2 * _dot(ax, ay, az, bx, by, bz)).to(tl.float32), here)
    tl.store(row + 29, (k * 0 + _dot(bx, by, bz, bx, by, bz)).to(tl.float32), here)

    # The visible part of the box.
    l0 = tl.load(bounds + source * 8, here, 0) / 3.5 - 1.0
    l1 = tl.load(bounds + source * 8 + 1, here, 0) / 3.5 - 1.0
    l2 = tl.load(bounds + source * 8 + 2, here, 0) / 3.5 - 1.0
    g0 = tl.load(bounds + source * 8 + 3, here, 0) / 3.5 - 1.0
    g1 = tl.load(bounds + source * 8 + 4, here, 0) / 3.5 - 1.0
    g2 = tl.load(bounds + source * 8 + 5, here, 0) / 3.5 - 1.0
    tl.store(row + 20, l0.to(tl.float32), here)
    tl.store(row + 21, l1.to(tl.float32), here)
    tl.store(row + 22, l2.to(tl.float32), here)
    tl.store(row + 23, g0.to(tl.float32), here)
    tl.store(row + 24, g1.to(tl.float32), here)
    tl.store(row + 25, g2.to(tl.float32), here)

    voxel = (2.0 * tl.where(solid, shortest, 1.0).to(tl.float64) / 7.0).to(tl.float32)
    stride = k * 0 + STRIDES[len(STRIDES) - 1]
    for i in tl.static_range(len(STRIDES)):
        threshold = tl.load(lattice + len(STRIDES) - i).to(tl.float32)
        stride = tl.where(voxel >= threshold, STRIDES[len(STRIDES) - 1 - i], stride)
    tl.store(row + 26, (stride * spacing).to(tl.float32), here)

    # Half axes and centre as the camera sees them.
    axis_x = _turned(r0x, r0y, r0z, r1x, r1y, r1z, r2x, r2y, r2z, xx * h0, xy * h0, xz * h0)
    axis_y = _turned(r0x, r0y, r0z, r1x, r1y, r1z, r2x, r2y, r2z, yx * h1, yy * h1, yz * h1)
    axis_z = _turned(r0x, r0y, r0z, r1x, r1y, r1z, r2x, r2y, r2z, zx * h2, zy * h2, zz * h2)
    centre = (beside.to(tl.float32), below.to(tl.float32), depth.to(tl.float32))
    near = (1e-4 * spacing).to(tl.float32)
    f0, f1, f2 = fx.to(tl.float32), skew.to(tl.float32), cx.to(tl.float32)
    f3, f4 = fy.to(tl.float32), cy.to(tl.float32)
    left, right, top, bottom, reach = _rectangle(
        centre, axis_x, axis_y, axis_z, l0, l1, l2, g0, g1, g2, near, width, height, f0, f1, f2, f3, f4
    )
    # The nearest point of that part: the origin in the box's coordinates, moved into it.
    nx, ny, nz = (
        -_dot(xx, xy, xz, wx, wy, wz) * i0,
        -_dot(yx, yy, yz, wx, wy, wz) * i1,
        -_dot(zx, zy, zz, wx, wy, wz) * i2,
    )
    nx, ny = nx - tl.minimum(tl.maximum(nx, l0), g0), ny - tl.minimum(tl.maximum(ny, l1), g1)
    nz = nz - tl.minimum(tl.maximum(nz, l2), g2)
    nx, ny, nz = nx * h0, ny * h1, nz * h2
    first = tl.ceil(tl.sqrt(nx * nx + ny * ny + nz * nz) * (1 - 1e-6) / spacing - 0.01)
    last = tl.floor(reach.to(tl.float64) * (1 + 1e-6) / spacing + 0.01)
    first = tl.minimum(tl.maximum(first, 1.0), LAST_POINT * 1.0).to(tl.int32)
    last = tl.minimum(last, LAST_POINT * 1.0).to(tl.int32)
    shown = solid & (g0 > l0) & (left <= right) & (top <= bottom) & (first <= last)
    left, right = left // TILE_WIDTH, tl.where(shown, right // TILE_WIDTH, -1)
    top, bottom = top // TILE_HEIGHT, tl.where(shown, bottom // TILE_HEIGHT, -1)
    line = indices + target * 16
    tl.store(line, n0.to(tl.int32), here)
    tl.store(line + 1, first, here)
    tl.store(line + 2, last, here)
    tl.store(line + 3, stride, here)
    tl.store(line + 4, left, here)
    tl.store(line + 5, right, here)
    tl.store(line + 6, top, here)
    tl.store(line + 7, bottom, here)
    low_bits = tl.sum(tl.where(shown & (stride % 2 != 0), 1, 0), 0)
    next_bits = tl.sum(tl.where(shown & (stride % 4 == 2), 1, 0), 0)
    tl.atomic_or(totals + 5, tl.where(low_bits > 0, 1, 0).to(tl.int64) + tl.where(next_bits > 0, 2, 0))
    tl.store(first_point + target, tl.where(shown, first, 2147483647), here)
    tiles = (right - left + 1).to(tl.int64) * (bottom - top + 1)
    bins = (right // BIN - left // BIN + 1).to(tl.int64) * (bottom // BIN - top // BIN + 1)

    # All of it: empty voxels receive gradients too.
    one = l0 * 0 + 1.0
    left, right, top, bottom, _ = _rectangle(
        centre, axis_x, axis_y, axis_z, -one, -one, -one, one, one, one, near, width, height, f0, f1, f2, f3, f4
    )
    met = solid & (left <= right) & (top <= bottom)
    columns, rows = (right - left) // BLOCK_WIDTH + 1, (bottom - top) // BLOCK_HEIGHT + 1
    blocks = tl.where(met, columns * rows, 0)
    tl.store(line + 8, left, here)
    tl.store(line + 9, right, here)
    tl.store(line + 10, top, here)
    tl.store(line + 11, bottom, here)
    tl.store(line + 12, blocks, here)
    units = (blocks + blocks_of_unit - 1) // blocks_of_unit
    tl.atomic_add(totals + 1, tl.sum(tl.where(shown, bins, 0), 0))
    tl.atomic_add(totals + 2, tl.sum(tl.where(shown, tiles, 0), 0))
    tl.atomic_add(totals + 3, tl.sum(units, 0).to(tl.int64))


@triton.jit
def _turned(r0x, r0y, r0z, r1x, r1y, r1z, r2x, r2y, r2z, x, y, z):
    """A vector as the camera sees it, in float32."""
    a, b, c = _dot(r0x, r0y, r0z, x, y, z), _dot(r1x, r1y, r1z, x, y, z), _dot(r2x, r2y, r2z, x, y, z)
    return a.to(tl.float32), b.to(tl.float32), c.to(tl.float32)
