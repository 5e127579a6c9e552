"""Views of a posed figure on the CPU: several samples a pixel, an alpha test, textures, no light; all passes at once.

Edge functions in homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates",
1997): with a triangle's corners p_i in camera space and a pixel's ray d = (x, y, 1), e_i = d . (p_j x p_k) are its
barycentrics times its depth's reciprocal times a constant. They are linear in the pixel and need no clipping where a
triangle crosses the camera's plane. First the nearest triangle of every sample, then the colour of each sample, then a
filter over them. Surfaces are two-sided.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from primdiffusion.body.model import J
from primdiffusion.capture.figure import PosedFigure
from primdiffusion.capture.rasterise import LINEAR_OF_BYTE
from primdiffusion.capture.rig import View

NEAR = 1e-3
"""Metres along the optical axis: nearer surfaces are not seen."""
BLACKMAN_HARRIS = (0.35875, -0.48829, 0.14128, -0.01168)
FILTER_WIDTH = 1.5
"""Pixels: the filter of Cycles, whose pictures these stand in for."""
ALPHA_TEST = 0.5
"""Of 1; the cutoff of the alpha mode MASK."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """What a camera sees of a person. Colour and coverage are means about a pixel; the rest is at its centre."""

    rgb: Float32[np.ndarray, "H W 3"]
    """Linear, premultiplied by `coverage`."""
    coverage: Float32[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "H W"]
    """Metres along the optical axis; 0 where there is nothing."""
    normal: Float32[np.ndarray, "H W 3"]
    """Of the world, unit, towards the camera; 0 where there is nothing."""
    part: UInt8[np.ndarray, "H W"]
    """1 + the joint that moves the surface most; 0 where there is nothing."""


def shoot(posed: PosedFigure, view: View, samples: int = 3) -> Shot:
    """The figure seen from `view` with `samples` squared samples a pixel; the same input gives the same bits.

    Raises:
        ValueError: `samples` is not odd and positive, so that no sample would lie in a pixel's centre.
    """
    if samples < 1 or samples % 2 == 0:
        raise ValueError(f"{samples} samples a pixel's side: choose an odd number, 1, 3, 5, ...")
    figure, textures = posed.figure, posed.figure.textures
    in_camera = posed.vertices @ view.rotation.T + view.translation
    # Sample (column, row) of the fine grid lies at pixel ((column + 1/2) / samples, (row + 1/2) / samples).
    grid = np.diag([samples, samples, 1.0]) @ view.intrinsics
    height, width = view.height * samples, view.width * samples
    edges = np.empty((len(figure.faces), 3, 3))
    nearness = np.zeros((height, width), np.float32)
    face = np.zeros((height, width), np.int32)
    low, high = np.array([width, height]), np.array([-1, -1])
    _draw(
        in_camera, grid, np.linalg.inv(grid), figure.faces, figure.corner_uv, figure.part,
        textures.rgba, textures.start, textures.size, textures.cut_out, edges, nearness, face, low, high,
    )  # fmt: skip
    shot = Shot(
        rgb=np.zeros((view.height, view.width, 3), np.float32),
        coverage=np.zeros((view.height, view.width), np.float32),
        depth=np.zeros((view.height, view.width), np.float32),
        normal=np.zeros((view.height, view.width, 3), np.float32),
        part=np.zeros((view.height, view.width), np.uint8),
    )
    if high[0] < 0:
        return shot
    left, top, right, bottom = low[0] // samples, low[1] // samples, high[0] // samples + 1, high[1] // samples + 1
    fine = np.zeros(((bottom - top) * samples, (right - left) * samples, 4), np.float32)
    at = (slice(top * samples, bottom * samples), slice(left * samples, right * samples))
    _shade(
        face[at], left * samples, top * samples, edges, figure.corner_uv, figure.part,
        textures.rgba, textures.start, textures.size, textures.last, textures.cut_out, LINEAR_OF_BYTE, fine,
    )  # fmt: skip
    taps = filter_taps(samples)
    _filter(fine, taps, samples, left, top, shot.rgb, shot.coverage)
    centres = (slice(samples // 2, None, samples),) * 2
    _look_up(
        face[centres], nearness[centres], samples, edges, figure.faces, posed.normals, figure.skin_index,
        figure.skin_weight, posed.vertices, view.position, left, top, right, bottom, shot.depth, shot.normal, shot.part,
    )  # fmt: skip
    return shot


def filter_taps(samples: int) -> NDArray[np.float32]:
    """Weights of the samples about a pixel's centre along one axis, an odd number; they sum to 1."""
    reach = int(FILTER_WIDTH * samples / 2)
    place = np.arange(-reach, reach + 1) / (FILTER_WIDTH * samples) + 0.5
    taps = sum(weight * np.cos(2 * np.pi * k * place) for k, weight in enumerate(BLACKMAN_HARRIS))
    return (taps / np.sum(taps)).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, nogil=True)
def _texel_alpha(u, v, rgba, start, rows, columns):
    """Bilinear, wrapping around; of 255."""
    x, y = (u - np.floor(u)) * columns - 0.5, (1.0 - (v - np.floor(v))) * rows - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    a, b = x - x0, y - y0
    x0, x1, y0, y1 = x0 % columns, (x0 + 1) % columns, start + y0 % rows * columns, start + (y0 + 1) % rows * columns
    above = rgba[y0 + x0, 3] * (1 - a) + rgba[y0 + x1, 3] * a
    below = rgba[y1 + x0, 3] * (1 - a) + rgba[y1 + x1, 3] * a
    return above * (1 - b) + below * b


@numba.njit(cache=True, nogil=True)
def _draw(
    points, grid, inverse_grid, faces, corner_uv, face_part, rgba, start, size, cut_out,
    edges, nearness, face, low, high,
):  # fmt: skip
    height, width = face.shape
    furthest = 1.0 / NEAR
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        nearest = min(points[i, 2], points[j, 2], points[k, 2])
        if max(points[i, 2], points[j, 2], points[k, 2]) < NEAR:
            continue
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if nearest >= NEAR:
            x_low, x_high, y_low, y_high = np.inf, -np.inf, np.inf, -np.inf
            for c in range(3):
                p = points[faces[f, c]]
                x = (grid[0, 0] * p[0] + grid[0, 1] * p[1]) / p[2] + grid[0, 2]  # K is upper triangular
                y = grid[1, 1] * p[1] / p[2] + grid[1, 2]
                x_low, x_high, y_low, y_high = min(x_low, x), max(x_high, x), min(y_low, y), max(y_high, y)
            left, right = int(np.ceil(max(x_low - 0.5, 0.0))), int(np.floor(min(x_high - 0.5, width - 1.0)))
            top, bottom = int(np.ceil(max(y_low - 0.5, 0.0))), int(np.floor(min(y_high - 0.5, height - 1.0)))
            if left > right or top > bottom:
                continue
        # Cross products of shared edges are each other's exact negatives, so no ray slips between two triangles.
        first, second, third = _cross(points[j], points[k]), _cross(points[k], points[i]), _cross(points[i], points[j])
        volume = points[i, 0] * first[0] + points[i, 1] * first[1] + points[i, 2] * first[2]
        if volume == 0.0:
            continue
        sign = 1.0 if volume > 0 else -1.0
        for axis in range(3):
            for c in range(3):
                n = first if c == 0 else (second if c == 1 else third)
                edge = n[0] * inverse_grid[0, axis] + n[1] * inverse_grid[1, axis] + n[2] * inverse_grid[2, axis]
                edges[f, c, axis] = sign * edge
        e = edges[f]
        scale = 1.0 / abs(volume)
        part = face_part[f]
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                a = e[0, 0] * x + (e[0, 1] * y + e[0, 2])
                b = e[1, 0] * x + (e[1, 1] * y + e[1, 2])
                c = e[2, 0] * x + (e[2, 1] * y + e[2, 2])
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                total = a + b + c
                near = np.float32(total * scale)
                if near <= nearness[row, column] or near > furthest:
                    continue
                if cut_out[part]:
                    u = (a * corner_uv[f, 0, 0] + b * corner_uv[f, 1, 0] + c * corner_uv[f, 2, 0]) / total
                    v = (a * corner_uv[f, 0, 1] + b * corner_uv[f, 1, 1] + c * corner_uv[f, 2, 1]) / total
                    alpha = _texel_alpha(u, v, rgba, start[part, 0], size[part, 0, 0], size[part, 0, 1])
                    if alpha < 255 * ALPHA_TEST:
                        continue
                nearness[row, column] = near
                face[row, column] = f + 1
                low[0], low[1] = min(low[0], column), min(low[1], row)
                high[0], high[1] = max(high[0], column), max(high[1], row)


@numba.njit(cache=True, nogil=True)
def _shade(
    face, left, top, edges, corner_uv, face_part, rgba, start, size, last, cut_out, linear_of_byte, fine
):  # fmt: skip
    for row in range(face.shape[0]):
        y = top + row + 0.5
        for column in range(face.shape[1]):
            f = face[row, column] - 1
            if f < 0:
                continue
            x = left + column + 0.5
            e, uv, part = edges[f], corner_uv[f], face_part[f]
            a = e[0, 0] * x + (e[0, 1] * y + e[0, 2])
            b = e[1, 0] * x + (e[1, 1] * y + e[1, 2])
            c = e[2, 0] * x + (e[2, 1] * y + e[2, 2])
            total = 1 / (a + b + c)
            u = (a * uv[0, 0] + b * uv[1, 0] + c * uv[2, 0]) * total
            v = (a * uv[0, 1] + b * uv[1, 1] + c * uv[2, 1]) * total
            level = 0
            if last[part] > 0:
                # Texels under a sample's footprint: the determinant of d(u, v) / d(x, y), by the quotient rule.
                ux = e[0, 0] * (uv[0, 0] - u) + e[1, 0] * (uv[1, 0] - u) + e[2, 0] * (uv[2, 0] - u)
                uy = e[0, 1] * (uv[0, 0] - u) + e[1, 1] * (uv[1, 0] - u) + e[2, 1] * (uv[2, 0] - u)
                vx = e[0, 0] * (uv[0, 1] - v) + e[1, 0] * (uv[1, 1] - v) + e[2, 0] * (uv[2, 1] - v)
                vy = e[0, 1] * (uv[0, 1] - v) + e[1, 1] * (uv[1, 1] - v) + e[2, 1] * (uv[2, 1] - v)
                texels = abs(ux * vy - uy * vx) * total * total * size[part, 0, 0] * size[part, 0, 1]
                while level < last[part] and texels > 8.0:
                    texels *= 0.25
                    level += 1
            rows, columns, first = size[part, level, 0], size[part, level, 1], start[part, level]
            sx, sy = (u - np.floor(u)) * columns - 0.5, (1.0 - (v - np.floor(v))) * rows - 0.5
            x0, y0 = int(np.floor(sx)), int(np.floor(sy))
            wx, wy = np.float32(sx - x0), np.float32(sy - y0)
            x0, x1 = x0 % columns, (x0 + 1) % columns
            y0, y1 = first + y0 % rows * columns, first + (y0 + 1) % rows * columns
            one = np.float32(1)
            red, green, blue, weights = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for corner in range(4):
                texel = rgba[(y1 if corner > 1 else y0) + (x1 if corner % 2 else x0)]
                weight = (wy if corner > 1 else one - wy) * (wx if corner % 2 else one - wx)
                if cut_out[part]:
                    weight *= np.float32(texel[3])
                red += weight * linear_of_byte[texel[0]]
                green += weight * linear_of_byte[texel[1]]
                blue += weight * linear_of_byte[texel[2]]
                weights += weight
            if weights > 0:
                fine[row, column, 0] = red / weights
                fine[row, column, 1] = green / weights
                fine[row, column, 2] = blue / weights
            fine[row, column, 3] = 1.0


@numba.njit(cache=True, nogil=True)
def _filter(fine, taps, samples, left, top, rgb, coverage):
    """A separable filter at every pixel's centre; writes one pixel beyond the fine grid, where there is one."""
    height, width = coverage.shape
    rows, columns = fine.shape[0], fine.shape[1]
    reach, middle = taps.shape[0] // 2, samples // 2
    first, last = max(left - 1, 0), min(left + columns // samples + 1, width)
    across = np.zeros((rows, last - first, 4), np.float32)
    for row in range(rows):
        for pixel in range(first, last):
            centre = (pixel - left) * samples + middle
            for t in range(max(0, reach - centre), min(2 * reach + 1, columns + reach - centre)):
                for channel in range(4):
                    across[row, pixel - first, channel] += taps[t] * fine[row, centre - reach + t, channel]
    for pixel_row in range(max(top - 1, 0), min(top + rows // samples + 1, height)):
        centre = (pixel_row - top) * samples + middle
        for t in range(max(0, reach - centre), min(2 * reach + 1, rows + reach - centre)):
            for pixel in range(first, last):
                values = across[centre - reach + t, pixel - first]
                for channel in range(3):
                    rgb[pixel_row, pixel, channel] += taps[t] * values[channel]
                coverage[pixel_row, pixel] += taps[t] * values[3]


@numba.njit(cache=True, nogil=True)
def _look_up(
    face, nearness, samples, edges, faces, normals, skin_index, skin_weight, vertices, eye, left, top, right, bottom,
    depth, normal, part,
):  # fmt: skip
    shares = np.zeros(J, np.float64)
    for row in range(top, bottom):
        y = row * samples + samples // 2 + 0.5
        for column in range(left, right):
            f = face[row, column] - 1
            if f < 0:
                continue
            x = column * samples + samples // 2 + 0.5
            depth[row, column] = 1 / nearness[row, column]
            shares[:] = 0
            direction, towards, length = np.zeros(3), 0.0, 0.0
            for c in range(3):
                vertex = faces[f, c]
                weight = edges[f, c, 0] * x + (edges[f, c, 1] * y + edges[f, c, 2])
                for axis in range(3):
                    direction[axis] += weight * normals[vertex, axis]
                for m in range(skin_index.shape[1]):
                    shares[skin_index[vertex, m]] += weight * skin_weight[vertex, m]
            part[row, column] = 1 + shares.argmax()
            corner = vertices[faces[f, 0]]
            for axis in range(3):
                towards += direction[axis] * (eye[axis] - corner[axis])
                length += direction[axis] * direction[axis]
            scale = (1.0 if towards >= 0 else -1.0) / max(np.sqrt(length), 1e-30)
            for axis in range(3):
                normal[row, column, axis] = direction[axis] * scale
