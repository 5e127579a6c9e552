"""Views of a posed figure on the CPU: several samples a pixel, an alpha test, textures, no light; all passes at once.

Edge functions in homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates",
1997): with a triangle's corners p_i in camera space and a pixel's ray d = (x, y, 1), e_i = d . (p_j x p_k) are its
barycentrics times its depth's reciprocal times a constant. They are linear in the pixel and need no clipping where a
triangle crosses the camera's plane. First the nearest triangle of every sample, then the samples' colours. Surfaces are
two-sided.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Float32, UInt8

from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.srgb import decode_srgb
from primdiffusion.raster.figure import PosedFigure

NEAR = 1e-3
"""Metres along the optical axis: nearer surfaces are not seen."""
ALPHA_TEST = 0.5
"""Of 1; the cutoff of the alpha mode MASK."""
COARSE_TEXELS = 8.0
"""Texels under a sample from which on the halved texture is read."""
LINEAR_OF_SIXTEENTH = decode_srgb(np.arange(255 * 16 + 1) / (255 * 16)).astype(np.float32)
"""Linear intensity of sixteenths of an sRGB-encoded byte: textures are interpolated as stored, as Cycles does."""


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
    """1 + the joint that moves the face most; 0 where there is nothing."""


def shoot(posed: PosedFigure, view: View, samples: int = 3) -> Shot:
    """The figure seen from `view` with `samples` squared samples a pixel; the same input gives the same bits.

    Raises:
        ValueError: `samples` is not odd and positive, so that no sample would lie in a pixel's centre.
    """
    if samples < 1 or samples % 2 == 0:
        raise ValueError(f"{samples} samples a pixel's side: choose an odd number, 1, 3, 5, ...")
    figure, textures = posed.figure, posed.figure.textures
    in_camera = posed.vertices @ view.rotation.T + view.translation
    shot = Shot(
        rgb=np.zeros((view.height, view.width, 3), np.float32),
        coverage=np.zeros((view.height, view.width), np.float32),
        depth=np.zeros((view.height, view.width), np.float32),
        normal=np.zeros((view.height, view.width, 3), np.float32),
        part=np.zeros((view.height, view.width), np.uint8),
    )
    left, top, right, bottom = _extent(in_camera, view)
    if left >= right or top >= bottom:
        return shot
    # Sample (column, row) of the fine grid lies at pixel (left, top) + ((column, row) + 1/2) / samples.
    grid = np.array([[samples, 0, -left * samples], [0, samples, -top * samples], [0, 0, 1.0]]) @ view.intrinsics
    edges = np.empty((len(figure.faces), 3, 3))
    nearness = np.zeros(((bottom - top) * samples, (right - left) * samples), np.float32)
    face = np.zeros(nearness.shape, np.int32)
    rgba = textures.rgba.view(np.uint32)[:, 0]
    _draw(
        in_camera, grid, np.linalg.inv(grid), figure.faces, figure.corner_uv, figure.part, rgba, textures.start,
        textures.size, textures.cut_out, edges, nearness, face,
    )  # fmt: skip
    _shade(
        face, samples, left, top, edges, figure.corner_uv, figure.part, rgba, textures.start, textures.size,
        textures.last, textures.cut_out, LINEAR_OF_SIXTEENTH, shot.rgb, shot.coverage,
    )  # fmt: skip
    _look_up(
        face, nearness, samples, left, top, edges, figure.faces, figure.joint, posed.normals, posed.vertices,
        view.position, shot.depth, shot.normal, shot.part,
    )  # fmt: skip
    return shot


def _extent(in_camera: np.ndarray, view: View) -> tuple[int, int, int, int]:
    """Pixels from (left, top) up to (right, bottom) outside of which nothing is seen."""
    if in_camera[:, 2].max() < NEAR:
        return 0, 0, 0, 0
    if in_camera[:, 2].min() < NEAR:
        return 0, 0, view.width, view.height
    homogeneous = in_camera @ view.intrinsics.T
    pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    low = np.floor(np.maximum(pixels.min(0), 0)).astype(int)
    high = np.ceil(np.minimum(pixels.max(0), (view.width, view.height))).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _neighbours(u, v, rows, columns):
    """The four texels about (u, v), wrapping around, as columns, rows and shares of the second of each; v up."""
    x, y = (u - np.floor(u)) * columns - 0.5, (1.0 - (v - np.floor(v))) * rows - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    x1, y1 = x0 + 1, y0 + 1
    return (
        x0 if x0 >= 0 else columns - 1, x1 if x1 < columns else 0, y0 if y0 >= 0 else rows - 1, y1 if y1 < rows else 0,
        np.float32(x - x0), np.float32(y - y0),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _alpha(u, v, rgba, start, rows, columns):
    """Bilinear, of 255."""
    x0, x1, y0, y1, wx, wy = _neighbours(u, v, rows, columns)
    above, below, one = start + y0 * columns, start + y1 * columns, np.float32(1)
    upper = np.float32(rgba[above + x0] >> 24) * (one - wx) + np.float32(rgba[above + x1] >> 24) * wx
    lower = np.float32(rgba[below + x0] >> 24) * (one - wx) + np.float32(rgba[below + x1] >> 24) * wx
    return upper * (one - wy) + lower * wy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw(
    points, grid, inverse_grid, faces, corner_uv, face_part, rgba, start, size, cut_out, edges, nearness, face
):  # fmt: skip
    height, width = face.shape
    furthest = 1.0 / NEAR
    column_of, row_of = np.empty(len(points)), np.empty(len(points))
    for n in range(len(points)):
        z = max(points[n, 2], NEAR)
        column_of[n] = (grid[0, 0] * points[n, 0] + grid[0, 1] * points[n, 1]) / z + grid[0, 2]  # K: upper triangular
        row_of[n] = grid[1, 1] * points[n, 1] / z + grid[1, 2]
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if min(points[i, 2], points[j, 2], points[k, 2]) >= NEAR:
            left = int(np.ceil(max(min(column_of[i], column_of[j], column_of[k]) - 0.5, 0.0)))
            right = int(np.floor(min(max(column_of[i], column_of[j], column_of[k]) - 0.5, width - 1.0)))
            top = int(np.ceil(max(min(row_of[i], row_of[j], row_of[k]) - 0.5, 0.0)))
            bottom = int(np.floor(min(max(row_of[i], row_of[j], row_of[k]) - 0.5, height - 1.0)))
            if left > right or top > bottom:
                continue
        elif max(points[i, 2], points[j, 2], points[k, 2]) < NEAR:
            continue
        # Cross products of shared edges are each other's exact negatives, so no ray slips between two triangles.
        e, volume = edges[f], 0.0
        for corner in range(3):
            p, q = points[faces[f, (corner + 1) % 3]], points[faces[f, (corner + 2) % 3]]
            x, y, z = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
            volume += (
                points[faces[f, corner], 0] * x + points[faces[f, corner], 1] * y + points[faces[f, corner], 2] * z
            )
            for axis in range(3):
                e[corner, axis] = x * inverse_grid[0, axis] + y * inverse_grid[1, axis] + z * inverse_grid[2, axis]
        if volume == 0.0:
            continue
        if volume < 0.0:
            for corner in range(3):
                for axis in range(3):
                    e[corner, axis] = -e[corner, axis]
        scale, part = 3.0 / abs(volume), face_part[f]  # the sum counted the volume three times
        for row in range(top, bottom + 1):
            y = row + 0.5
            a0, b0, c0 = e[0, 1] * y + e[0, 2], e[1, 1] * y + e[1, 2], e[2, 1] * y + e[2, 2]
            for column in range(left, right + 1):
                x = column + 0.5
                a, b, c = e[0, 0] * x + a0, e[1, 0] * x + b0, e[2, 0] * x + c0
                if (a < 0.0) | (b < 0.0) | (c < 0.0):
                    continue
                total = a + b + c
                near = np.float32(total * scale)
                if near <= nearness[row, column] or near > furthest:
                    continue
                if cut_out[part]:
                    u = (a * corner_uv[f, 0, 0] + b * corner_uv[f, 1, 0] + c * corner_uv[f, 2, 0]) / total
                    v = (a * corner_uv[f, 0, 1] + b * corner_uv[f, 1, 1] + c * corner_uv[f, 2, 1]) / total
                    if _alpha(u, v, rgba, start[part, 0], size[part, 0, 0], size[part, 0, 1]) < 255 * ALPHA_TEST:
                        continue
                nearness[row, column] = near
                face[row, column] = f + 1


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _level(u, v, e, uv, scale, texels_of_uv, last):
    """Which halved texture suits a sample: by the texels in its footprint, the determinant of d(u, v) / d(x, y)."""
    ux = e[0, 0] * (uv[0, 0] - u) + e[1, 0] * (uv[1, 0] - u) + e[2, 0] * (uv[2, 0] - u)
    uy = e[0, 1] * (uv[0, 0] - u) + e[1, 1] * (uv[1, 0] - u) + e[2, 1] * (uv[2, 0] - u)
    vx = e[0, 0] * (uv[0, 1] - v) + e[1, 0] * (uv[1, 1] - v) + e[2, 0] * (uv[2, 1] - v)
    vy = e[0, 1] * (uv[0, 1] - v) + e[1, 1] * (uv[1, 1] - v) + e[2, 1] * (uv[2, 1] - v)
    texels, level = abs(ux * vy - uy * vx) * scale * scale * texels_of_uv, 0
    while level < last and texels > COARSE_TEXELS:
        texels *= 0.25
        level += 1
    return level


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _shade(
    face, samples, left, top, edges, corner_uv, face_part, rgba, start, size, last, cut_out, linear, rgb, coverage
):  # fmt: skip
    share, one = np.float32(1 / (samples * samples)), np.float32(1)
    for pixel_row in range(face.shape[0] // samples):
        for pixel in range(face.shape[1] // samples):
            covered = 0
            for row in range(pixel_row * samples, (pixel_row + 1) * samples):
                for column in range(pixel * samples, (pixel + 1) * samples):
                    covered += face[row, column] > 0
            if covered == 0:
                continue
            # Where nothing but the person is seen, every other sample, as on a chessboard, tells its colour.
            stride = 2 if covered == samples * samples else 1
            red, green, blue, hits, before, level, part, holed = one * 0, one * 0, one * 0, 0, -1, 0, 0, False
            for row in range(pixel_row * samples, (pixel_row + 1) * samples):
                first = pixel * samples + (row - pixel_row * samples) % stride
                for column in range(first, (pixel + 1) * samples, stride):
                    f = face[row, column] - 1
                    if f < 0:
                        continue
                    e, uv, x, y = edges[f], corner_uv[f], column + 0.5, row + 0.5
                    a = e[0, 0] * x + (e[0, 1] * y + e[0, 2])
                    b = e[1, 0] * x + (e[1, 1] * y + e[1, 2])
                    c = e[2, 0] * x + (e[2, 1] * y + e[2, 2])
                    scale = 1 / (a + b + c)
                    u = (a * uv[0, 0] + b * uv[1, 0] + c * uv[2, 0]) * scale
                    v = (a * uv[0, 1] + b * uv[1, 1] + c * uv[2, 1]) * scale
                    if f != before:
                        before, part = f, face_part[f]
                        holed = cut_out[part]
                        level = _level(u, v, e, uv, scale, size[part, 0, 0] * size[part, 0, 1], last[part])
                    columns = size[part, level, 1]
                    x0, x1, y0, y1, wx, wy = _neighbours(u, v, size[part, level, 0], columns)
                    above, below = start[part, level] + y0 * columns, start[part, level] + y1 * columns
                    p, q, r, s = rgba[above + x0], rgba[above + x1], rgba[below + x0], rgba[below + x1]
                    w, t = (one - wx) * (one - wy), wx * (one - wy)
                    m, n = (one - wx) * wy, wx * wy
                    sixteenths = np.float32(16)
                    if holed:
                        w, t, m, n = w * (p >> 24), t * (q >> 24), m * (r >> 24), n * (s >> 24)
                        weights = w + t + m + n
                        sixteenths = np.float32(16 / weights) if weights > 0 else np.float32(0)
                    total = w * (p & 255) + t * (q & 255) + m * (r & 255) + n * (s & 255)
                    red += linear[int(total * sixteenths + 0.5)]
                    total = w * (p >> 8 & 255) + t * (q >> 8 & 255) + m * (r >> 8 & 255) + n * (s >> 8 & 255)
                    green += linear[int(total * sixteenths + 0.5)]
                    total = w * (p >> 16 & 255) + t * (q >> 16 & 255) + m * (r >> 16 & 255) + n * (s >> 16 & 255)
                    blue += linear[int(total * sixteenths + 0.5)]
                    hits += 1
            at = rgb[top + pixel_row, left + pixel]
            coverage[top + pixel_row, left + pixel] = covered * share
            scale = covered * share / hits
            at[0], at[1], at[2] = red * scale, green * scale, blue * scale


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(
    face, nearness, samples, left, top, edges, faces, joint, normals, vertices, eye, depth, normal, part
):  # fmt: skip
    direction = np.zeros(3)
    for pixel_row in range(face.shape[0] // samples):
        row = pixel_row * samples + samples // 2
        for pixel in range(face.shape[1] // samples):
            column = pixel * samples + samples // 2
            f = face[row, column] - 1
            if f < 0:
                continue
            depth[top + pixel_row, left + pixel] = 1 / nearness[row, column]
            part[top + pixel_row, left + pixel] = 1 + joint[f]
            towards, length = 0.0, 0.0
            direction[:] = 0
            for c in range(3):
                weight = edges[f, c, 0] * (column + 0.5) + (edges[f, c, 1] * (row + 0.5) + edges[f, c, 2])
                for axis in range(3):
                    direction[axis] += weight * normals[faces[f, c], axis]
            for axis in range(3):
                towards += direction[axis] * (eye[axis] - vertices[faces[f, 0], axis])
                length += direction[axis] * direction[axis]
            scale = (1.0 if towards >= 0 else -1.0) / max(np.sqrt(length), 1e-30)
            for axis in range(3):
                normal[top + pixel_row, left + pixel, axis] = direction[axis] * scale
