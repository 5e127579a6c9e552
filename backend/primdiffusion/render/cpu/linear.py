"""The derivative of an image with respect to voxels, as a sparse matrix (SPEC 4); numba, float32, CPU.

If the points where rays saturate are held fixed, an image is linear in colour and in density: a ray is the sum of its
samples, and each sample is a trilinear mean of eight voxels. `linearise` stores these sums, merged over the samples of
a ray in a box, so that products with the matrix and its transpose cost a fraction of a march.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int16, Int32, Int64
from numpy import ndarray

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu.adjoint import counted_steps
from primdiffusion.render.cpu.compiled import THREADS, TILE, at_once, index, kernel, on_all_threads, part, take
from primdiffusion.render.cpu.forward import NEVER
from primdiffusion.render.cpu.march import draw_with_ends
from primdiffusion.render.cpu.sampling import (
    HIT_ROWS,
    LANES,
    PIXELS,
    SAMPLES,
    TABLE_ROWS,
    hit_rays,
    lowest,
    place_samples,
    reference_point,
    tabulate,
    tile_rays,
)
from primdiffusion.render.cpu.segments import (
    WIDTH,
    add_four_columns,
    add_four_transposed,
    add_product,
    add_transposed_product,
    merge_sample,
)
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import MarchSettings

DENSITY, OPACITY, COLOUR = 0, 3, 4
"""Columns of `PictureJacobian.weight`: of a voxel's density for red, green and blue, and for alpha; of its colour."""
WEIGHTS = 5
SHORTEST = 4e-5
"""Entries with less than this length of ray (metres) are dropped: 0.8 % of opacity at a density of 200 per metre."""
FIRST_ROOM, ROOM_PER_PIXEL = 2_000_000, 16
"""Initial capacity in entries; an image of a human has 1.5 million with 176 x 176 pixels, 3 million with 512 x 512."""
PARTS = 4
"""Ranges of boxes, or images, computed at once."""
BOXES_AT_ONCE = 64
"""Boxes that all images multiply in turn; their voxels fit a processor's cache."""


class PictureJacobian(NamedTuple):
    """d(rgb, alpha) / d(colour, density) of one image; a segment is the part of a ray in one box."""

    box_start: Int64[ndarray, "k+1"]
    """First segment of each box."""
    ray: Int32[ndarray, "segments"]
    """Pixel of each segment, row-major."""
    start: Int64[ndarray, "segments+1"]
    """First entry of each segment."""
    voxel: Int16[ndarray, "entries"]
    """Index of the voxel in its box, order D, H, W."""
    weight: Float32[ndarray, "entries 5"]
    """See COLOUR, DENSITY and OPACITY."""
    rays: int
    """Number of pixels."""

    @property
    def voxels(self) -> int:
        """Voxels of a box times boxes."""
        return (len(self.box_start) - 1) * VOXELS


VOXELS = 512
"""Voxels of a box; indices have 16 bits."""


def linearise(primitives: Primitives, camera: Camera, background: float) -> tuple[Rendering, PictureJacobian]:
    """The image of `march_cpu` over black, and its derivative when composited over a grey `background`.

    `background` is linear. Raises ValueError as `march_reference` does, and for boxes of other than 8^3 voxels.
    """
    size = primitives.density.shape[-1]
    if size**3 != VOXELS:
        raise ValueError(f"boxes of {size}^3 voxels cannot be linearised: give boxes of 8^3")
    rendering, view, scene, ends = draw_with_ends(primitives, camera, MarchSettings())
    saturates = ends.index != NEVER
    share = np.where(saturates, ends.share, np.float32(1))
    behind = np.where(saturates[:, None], ends.rgb, np.float32(background)).astype(np.float32)
    room = max(FIRST_ROOM, ROOM_PER_PIXEL * len(behind)) // (PARTS if THREADS > 1 else 1)

    def entries_of(first: int, last: int) -> tuple[ndarray, ...]:
        """The arrays of PictureJacobian for a range of boxes."""
        capacity = room
        while True:
            box_start = np.zeros(last - first + 1, np.int64)
            ray, start = np.empty(capacity // 8, np.int32), np.empty(capacity // 8 + 1, np.int64)
            voxel, weight = np.empty(capacity, np.int16), np.empty((capacity, WEIGHTS), np.float32)
            segments, entries = _linearise(
                first, last, box_start, ray, start, voxel, weight, ends.index, share, ends.box, behind,
                scene.boxes, scene.size, scene.rectangle, view.limits, scene.pixel_to_world, view.width, view.height,
                view.spacing,
            )  # fmt: skip
            if segments >= 0:
                return box_start[:-1], ray[:segments], start[:segments], voxel[:entries], weight[:entries]
            capacity *= 2

    ranges = _ranges(_tiles(scene.rectangle)) if THREADS > 1 else [(0, len(scene.rectangle))]
    parts = list(zip(*at_once([functools.partial(entries_of, *one) for one in ranges]), strict=True))
    jacobian = PictureJacobian(
        _joined(parts[0], parts[1]),
        _whole(parts[1]),
        _joined(parts[2], parts[3]),
        _whole(parts[3]),
        _whole(parts[4]),
        len(behind),
    )
    return rendering, jacobian


def _whole(parts: Sequence[ndarray]) -> ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _tiles(rectangle: Int32[ndarray, "k 4"]) -> Int64[ndarray, "k"]:
    """Number of tiles that each box may be seen in: an estimate of its work."""
    sides = (rectangle[:, 1::2] - rectangle[:, ::2] + 1).clip(0).astype(np.int64)
    return sides[:, 0] * sides[:, 1]


def _ranges(work: Int64[ndarray, "k"]) -> list[tuple[int, int]]:
    """PARTS ranges (first, last + 1) of boxes with about the same work."""
    total = np.concatenate([[0], np.cumsum(work + 1)])
    bounds = np.searchsorted(total, np.linspace(0, total[-1], PARTS + 1))
    return list(itertools.pairwise(bounds.tolist()))


def _joined(starts: Sequence[Int64[ndarray, "n"]], items: Sequence[ndarray]) -> Int64[ndarray, "m+1"]:
    """Starts of the parts' groups of items, in the parts joined; the last is the number of items."""
    offsets = np.cumsum([0, *map(len, items)])
    return np.concatenate([*(start + offset for start, offset in zip(starts, offsets, strict=False)), offsets[-1:]])


def apply(
    jacobians: Sequence[PictureJacobian],
    change: Float32[ndarray, "v 4"],
    alpha_free: Sequence[Float32[ndarray, "r"]],
) -> list[Float32[ndarray, "r 4"]]:
    """J x of each image: the change of rgb and alpha of every pixel with the voxels' colours and densities (1/m).

    `alpha_free` is 1 where alpha follows density and 0 where the ray is opaque.
    """
    out = _applied(_apply, [jacobian[:-1] for jacobian in jacobians], change, [one.rays for one in jacobians])
    for pixels, free in zip(out, alpha_free, strict=True):
        pixels[:, 3] *= free
    return out


def add_transposed(
    jacobians: Sequence[PictureJacobian],
    pixels: Sequence[Float32[ndarray, "r 4"]],
    alpha_free: Sequence[Float32[ndarray, "r"]],
    out: Float32[ndarray, "v 4"],
) -> None:
    """out += J^T y, summed over images."""
    freed = [
        y * np.stack([*np.ones((3, len(y)), np.float32), free], 1) for y, free in zip(pixels, alpha_free, strict=True)
    ]
    _transposed_onto(_add_transposed, [jacobian[:-1] for jacobian in jacobians], freed, out)


Arrays = tuple[ndarray, ...]
"""Arrays of a matrix, as its kernels take them; the first are the first segments of boxes."""


def _applied(kernel: Any, matrices: Sequence[Arrays], x: ndarray, rays: Sequence[int]) -> list[ndarray]:
    """The product of each matrix with x. All matrices multiply some boxes before the next, whose voxels stay cached."""
    out = [np.zeros((count, x.shape[1]), np.float32) for count in rays]

    def part(number: int) -> None:
        for first in range(0, len(x) // VOXELS, BOXES_AT_ONCE):
            for arrays, pixels in zip(matrices[number::PARTS], out[number::PARTS], strict=True):
                kernel(first, min(first + BOXES_AT_ONCE, len(arrays[0]) - 1), *arrays, x, pixels)

    at_once([functools.partial(part, number) for number in range(min(PARTS, len(matrices)))])
    return out


def _transposed_onto(kernel: Any, matrices: Sequence[Arrays], pixels: Sequence[ndarray], out: ndarray) -> None:
    """Add the product of each transposed matrix with its pixels; likewise."""

    def part(begin: int, end: int) -> None:
        for first in range(begin, end, BOXES_AT_ONCE):
            for arrays, y in zip(matrices, pixels, strict=True):
                kernel(first, min(first + BOXES_AT_ONCE, end), *arrays, y, out)

    work = np.sum([np.diff(arrays[0]) for arrays in matrices], axis=0)
    at_once([functools.partial(part, *one) for one in _ranges(work)])


def add_diagonal(
    jacobian: PictureJacobian,
    weight: Float32[ndarray, "r 4"],
    alpha_free: Float32[ndarray, "r"],
    out: Float32[ndarray, "v 4"],
) -> None:
    """out += diag(J^T W J), merged entries squared, for a diagonal W of the pixels' weights."""
    freed = weight.copy()
    freed[:, 3] *= alpha_free
    arrays = jacobian.box_start, jacobian.ray, jacobian.start, jacobian.voxel, jacobian.weight
    on_all_threads(_add_diagonal, *arrays, freed, out)


def apply_to_codes(
    jacobian: PictureJacobian,
    slope: Float32[ndarray, "v 4"],
    basis: Float32[ndarray, "b 512 4 c"],
    region: Int64[ndarray, "k"],
    codes: Float32[ndarray, "k c n"],
    alpha_free: Float32[ndarray, "r"],
) -> Float32[ndarray, "r 4 n"]:
    """J X for n changes X of the voxels that are given by codes: those of box k are slope * basis[region[k]] codes[k].

    As `apply` on each of the n columns, but a small part of its work: segments are multiplied by the basis, not by the
    columns.
    """
    out = np.zeros((jacobian.rays, 4, codes.shape[-1]), np.float32)
    for k, (first, last) in enumerate(zip(jacobian.box_start[:-1], jacobian.box_start[1:], strict=True)):
        if first == last:
            continue
        part = np.zeros((last - first, 4, basis.shape[-1]), np.float32)
        own = slope[k * VOXELS : (k + 1) * VOXELS]
        _add_in_basis(jacobian.start[first : last + 1], jacobian.voxel, jacobian.weight, own, basis[region[k]], part)
        out[jacobian.ray[first:last]] += part @ codes[k]  # a ray crosses a box once
    out[:, 3] *= alpha_free[:, None]
    return out


class ColourMatrix(NamedTuple):
    """The colour part of a `PictureJacobian`; exact, because opacity does not depend on colour."""

    box_start: Int64[ndarray, "k+1"]
    ray: Int32[ndarray, "segments"]
    start: Int64[ndarray, "segments+1"]
    voxel: Int16[ndarray, "entries"]
    weight: Float32[ndarray, "entries"]
    rays: int

    @classmethod
    def of(cls, jacobian: PictureJacobian) -> ColourMatrix:
        """The colour part of a Jacobian; shares all arrays except the weights."""
        weight = np.ascontiguousarray(jacobian.weight[:, COLOUR])
        return cls(jacobian.box_start, jacobian.ray, jacobian.start, jacobian.voxel, weight, jacobian.rays)

    def add_diagonal(self, weight: Float32[ndarray, "r c"], out: Float32[ndarray, "v c"]) -> None:
        """out += diag(A^T W A)."""
        add_colours_transposed([self._replace(weight=self.weight * self.weight)], [weight], out)


def apply_colours(matrices: Sequence[ColourMatrix], colours: Float32[ndarray, "v c"]) -> list[Float32[ndarray, "r c"]]:
    """A x of each image for any number of columns, such as red, green and blue of several colourings."""
    return _applied(_apply_colours, [matrix[:-1] for matrix in matrices], colours, [one.rays for one in matrices])


def add_colours_transposed(
    matrices: Sequence[ColourMatrix], pixels: Sequence[Float32[ndarray, "r c"]], out: Float32[ndarray, "v c"]
) -> None:
    """out += A^T y, summed over images."""
    _transposed_onto(_add_colours_transposed, [matrix[:-1] for matrix in matrices], pixels, out)


@kernel
def _linearise(
    begin_box, end_box, box_start, ray_of, start, voxel, weight, ends, shares, last_box, behind, boxes,
    size, rectangle, limits, pixel_to_world, width, height, spacing,
):  # fmt: skip
    """Fill the matrix; return the numbers of segments and entries, or -1 if they exceed its capacity."""
    rays = np.empty(3 * PIXELS, np.float32)
    table = np.empty(LANES * TABLE_ROWS, np.float32)
    hits = np.empty(HIT_ROWS * LANES, np.float32)
    block = np.empty(8 * SAMPLES, np.float32)
    sums = np.zeros((VOXELS, WIDTH), np.float32)
    touched = np.empty(VOXELS, np.int64)
    seen = np.zeros(VOXELS, np.bool_)
    segments, entries = 0, 0
    for k in range(begin_box, end_box):
        box_start[k - begin_box] = segments
        if rectangle[k, 0] > rectangle[k, 1]:
            continue
        stride = boxes.stride[k]
        step = stride * spacing
        length = np.float32(step)
        for tile_row in range(rectangle[k, 2], rectangle[k, 3] + 1):
            for tile_column in range(rectangle[k, 0], rectangle[k, 1] + 1):
                row0, column0 = tile_row * TILE, tile_column * TILE
                middle = tile_rays(rays, pixel_to_world, row0, column0)
                reference = reference_point(boxes, k, middle, spacing)
                tabulate(table, 0, boxes, k, middle, reference, spacing)
                for begin in range(0, PIXELS, LANES):
                    hit = hit_rays(hits, table, rays, begin, PIXELS)
                    while hit != 0:
                        j = index(lowest(hit))
                        hit &= hit - 1
                        row, column = row0 + (begin + j) // TILE, column0 + (begin + j) % TILE
                        if row >= height or column >= width:
                            continue
                        ray = row * width + column
                        enter, leave = counted_steps(
                            hits, j, reference, stride, limits, index(ray), ends[ray], k, last_box[ray]
                        )
                        if enter > leave:
                            continue
                        share = shares[ray] if reference + leave * stride == ends[ray] else np.float32(1)
                        count = _merge_segment(
                            sums, touched, seen, boxes.voxels, 4 * k * VOXELS, behind[ray, 0], behind[ray, 1],
                            behind[ray, 2], block, hits, j, enter, leave, size, length, share,
                        )  # fmt: skip
                        if entries + count > len(voxel) or segments + 1 >= len(ray_of):
                            return -1, -1
                        first = entries
                        for i in range(count):
                            v = touched[i]
                            seen[v] = False
                            if sums[v, OPACITY] > SHORTEST:
                                voxel[entries] = v
                                for column_of_weight in range(WEIGHTS):
                                    weight[entries, column_of_weight] = sums[v, column_of_weight]
                                entries += 1
                            sums[v] = 0
                        if entries > first:
                            ray_of[segments], start[segments] = ray, first
                            segments += 1
    box_start[end_box - begin_box] = segments
    return segments, entries


@part()
def _merge_segment(
    sums, touched, seen, voxels, base, red, green, blue, block, hits, lane, enter, leave, size, length, share
):  # fmt: skip
    """Add the samples of a ray in a box to `sums`; return the number of voxels touched, listed in `touched`."""
    count, slab, before = 0, size * size, -1
    for begin in range(enter, leave + 1, SAMPLES):
        place_samples(block, hits, lane, np.float32(begin), size, length)
        samples = min(SAMPLES, leave + 1 - begin)
        if begin + samples > leave:
            block[6 * SAMPLES + samples - 1] *= share
        for s in range(samples):
            opacity = block[6 * SAMPLES + s]  # at a density of 1 per metre
            if opacity < np.float32(2e-5):
                continue
            corner = np.int64(block[7 * SAMPLES + s])
            merge_sample(
                sums, voxels, base, corner, size, slab,
                block[s], block[SAMPLES + s], block[2 * SAMPLES + s], block[3 * SAMPLES + s],
                block[4 * SAMPLES + s], block[5 * SAMPLES + s], opacity, red, green, blue,
            )  # fmt: skip
            if corner == before:
                continue
            before = corner
            for edge in range(4):
                first = corner + (edge & 1) * size + (edge >> 1) * slab
                for v in range(first, first + 2):
                    if not seen[v]:
                        seen[v] = True
                        touched[count] = v
                        count += 1
    return count


@kernel
def _apply(begin_box, end_box, box_start, ray, start, voxel, weight, x, out):
    for k in range(begin_box, end_box):
        base = k * VOXELS
        for segment in range(box_start[k], box_start[k + 1]):
            first, last = start[segment], start[segment + 1]
            add_product(out, np.int64(ray[segment]), x, base, voxel, weight, first, last)


@kernel
def _add_transposed(begin_box, end_box, box_start, ray, start, voxel, weight, y, out):
    for k in range(begin_box, end_box):
        base = k * VOXELS
        for segment in range(box_start[k], box_start[k + 1]):
            first, last = start[segment], start[segment + 1]
            add_transposed_product(out, base, y, np.int64(ray[segment]), voxel, weight, first, last)


@kernel
def _add_diagonal(taken, box_start, ray, start, voxel, weight, y, out):
    while True:
        k = take(taken)
        if k >= len(box_start) - 1:
            break
        base = k * VOXELS
        for segment in range(box_start[k], box_start[k + 1]):
            i = ray[segment]
            for entry in range(start[segment], start[segment + 1]):
                v = base + np.int64(voxel[entry])
                w = weight[entry, COLOUR] * weight[entry, COLOUR]
                for channel in range(3):
                    out[v, channel] += w * y[i, channel]
                for channel in range(4):
                    out[v, 3] += weight[entry, channel] * weight[entry, channel] * y[i, channel]


@kernel
def _apply_colours(begin_box, end_box, box_start, ray, start, voxel, weight, x, out):
    columns = x.shape[1]
    for k in range(begin_box, end_box):
        base = k * VOXELS
        for segment in range(box_start[k], box_start[k + 1]):
            i, first, last = np.int64(ray[segment]), start[segment], start[segment + 1]
            for column in range(0, columns - 3, 4):
                add_four_columns(out, i * columns + column, x, base, columns, column, voxel, weight, first, last)
            for column in range(columns // 4 * 4, columns):
                for entry in range(first, last):
                    out[i, column] += weight[entry] * x[base + np.int64(voxel[entry]), column]


@kernel
def _add_colours_transposed(begin_box, end_box, box_start, ray, start, voxel, weight, y, out):
    columns = y.shape[1]
    for k in range(begin_box, end_box):
        base = k * VOXELS
        for segment in range(box_start[k], box_start[k + 1]):
            i, first, last = np.int64(ray[segment]), start[segment], start[segment + 1]
            for column in range(0, columns - 3, 4):
                add_four_transposed(out, base, columns, column, y, i * columns + column, voxel, weight, first, last)
            for column in range(columns // 4 * 4, columns):
                for entry in range(first, last):
                    out[base + np.int64(voxel[entry]), column] += weight[entry] * y[i, column]


@kernel
def _add_in_basis(start, voxel, weight, slope, basis, out):
    for segment in range(len(start) - 1):
        for entry in range(start[segment], start[segment + 1]):
            v = np.int64(voxel[entry])
            for channel in range(3):
                a = weight[entry, COLOUR] * slope[v, channel]
                for c in range(basis.shape[2]):
                    out[segment, channel, c] += a * basis[v, channel, c]
            for channel in range(4):
                a = weight[entry, channel] * slope[v, 3]
                for c in range(basis.shape[2]):
                    out[segment, channel, c] += a * basis[v, 3, c]
