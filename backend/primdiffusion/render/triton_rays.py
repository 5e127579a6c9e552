"""What the marcher's forward and backward Triton kernels share: a ray as a box sees it, and a box's voxels."""

# pyright: reportGeneralTypeIssues=false, reportAttributeAccessIssue=false
# Triton's language is Python by its syntax alone.
from __future__ import annotations

import triton
import triton.language as tl

SHARPNESS = tl.constexpr(8.0)
NEVER = tl.constexpr(1 << 30)
"""Lattice point behind all others."""


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
    """The voxel below a coordinate in [-1, 1] and the way from it to the next, in voxels."""
    u = (y + 1.0) * 3.5
    low = tl.minimum(tl.maximum(u.to(tl.int32), 0), 6)
    return low, u - low.to(tl.float32)


@triton.jit
def window(x, y, z):
    """exp(-8 * sum |y|^8), the fading of density towards a box's faces (SPEC 4)."""
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
