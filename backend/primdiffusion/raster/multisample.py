"""Views of a posed human for captures: several samples per pixel, textures, an alpha test, no light.

The z-buffer finds the nearest triangle of each sample. A triangle's edge functions, scaled to its corners' depths, are
linear in the pixel and proportional to its perspective-correct barycentric coordinates, so colours, normals and texture
footprints follow from them. Surfaces are two-sided.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, UInt8

from primdiffusion.body.model import J
from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.srgb import decode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.rasterise import NEAR, flatten
from primdiffusion.raster.textures import TexturePyramid, texels_around, texture_pyramid
from primdiffusion.raster.z_buffer import AlphaTest, project, z_buffer

SAME_PLACE = 1e-6
"""Vertices of a part closer than this in the rest pose (metres) share a normal, so texture seams stay smooth."""
COARSE_TEXELS = 8.0
"""Texels under a sample above which the halved texture is read."""
LINEAR_OF_SIXTEENTH = decode_srgb(np.arange(255 * 16 + 1) / (255 * 16)).astype(np.float32)
"""Linear intensity of sixteenths of an sRGB-encoded byte: textures are interpolated as stored, as Cycles does."""


@dataclasses.dataclass(frozen=True, eq=False)
class Figure:
    """A mesh prepared for rendering in many poses: what does not depend on the pose, all parts concatenated."""

    mesh: TexturedMesh
    """In the rest pose."""
    faces: Int32[np.ndarray, "F 3"]
    corner_uv: Float32[np.ndarray, "F 3 2"]
    part: Int32[np.ndarray, "F"]
    """Part of each face."""
    textures: TexturePyramid
    joint: UInt8[np.ndarray, "F"]
    """Joint with the largest weight at each face's corners."""
    corner: Int32[np.ndarray, "V"]
    """Index shared by coincident vertices of a part, over which normals are averaged."""

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> PosedFigure:
        """Pose the figure by linear blend skinning, world <- rest."""
        vertices = self.points(skinning)
        return PosedFigure(self, vertices, self._normals(vertices))

    def points(self, skinning: Float[np.ndarray, "J 4 4"]) -> Float64[np.ndarray, "V 3"]:
        """The vertices of all parts in a pose."""
        return np.concatenate([part.posed(skinning).vertices for part in self.mesh.parts])

    def _normals(self, vertices: np.ndarray) -> np.ndarray:
        """Area-weighted unit normals of vertices."""
        corners = vertices[self.faces]
        doubled_area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        places = self.corner[self.faces]
        total = np.stack(
            [
                np.bincount(places.ravel(), np.repeat(doubled_area[:, axis], 3), minlength=self.corner.max() + 1)
                for axis in range(3)
            ],
            -1,
        )
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
        return total[self.corner].astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class PosedFigure:
    """A figure in a pose."""

    figure: Figure
    vertices: Float64[np.ndarray, "V 3"]
    """Metres."""
    normals: Float32[np.ndarray, "V 3"]
    """Unit, outwards from the front of faces."""

    def seen_from(self, view: View, samples: int) -> RenderedView:
        """See `render_view`."""
        return render_view(self, view, samples)


def figure_from_mesh(mesh: TexturedMesh) -> Figure:
    """Prepare a mesh for `render_view`.

    Raises:
        ValueError: as `flatten`.
    """
    soup = flatten(mesh)
    first = 0
    corners = []
    for part in mesh.parts:
        places = np.round(part.vertices / SAME_PLACE).astype(np.int64)
        _, corner = np.unique(places, axis=0, return_inverse=True)
        corners.append(corner.reshape(-1) + first)
        first += len(part.vertices)
    return Figure(
        mesh=mesh,
        faces=soup.faces,
        corner_uv=soup.corner_uv,
        part=soup.part,
        textures=texture_pyramid(mesh),
        joint=np.concatenate([_joints_of_faces(part) for part in mesh.parts]),
        corner=np.concatenate(corners).astype(np.int32),
    )


def _joints_of_faces(part: TexturedPart) -> UInt8[np.ndarray, "F"]:
    sums = np.zeros((len(part.faces), J))
    rows = np.arange(len(part.faces))[:, None]
    for corner in part.faces.T:
        np.add.at(sums, (rows, part.skin_index[corner]), part.skin_weight[corner])
    return sums.argmax(1).astype(np.uint8)


@dataclasses.dataclass(frozen=True, eq=False)
class RenderedView:
    """The passes of a view. Colour and coverage are means over each pixel; the others are samples at its centre."""

    rgb: Float32[np.ndarray, "H W 3"]
    """Linear, premultiplied by `coverage`."""
    coverage: Float32[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "H W"]
    """Metres along the optical axis; 0 for background."""
    normal: Float32[np.ndarray, "H W 3"]
    """World space, unit, towards the camera; 0 for background."""
    part: UInt8[np.ndarray, "H W"]
    """1 + the joint that moves the face most; 0 for background."""


def render_view(posed: PosedFigure, view: View, samples: int = 3) -> RenderedView:
    """Render the figure with `samples` x `samples` samples per pixel; deterministic.

    Raises:
        ValueError: `samples` is not odd and positive, so that no sample would be at the pixel's centre.
    """
    if samples < 1 or samples % 2 == 0:
        raise ValueError(f"samples is {samples}: give an odd number, 1, 3, 5, ...")
    figure, textures = posed.figure, posed.figure.textures
    in_camera = posed.vertices @ view.rotation.T + view.translation
    rendered = RenderedView(
        rgb=np.zeros((view.height, view.width, 3), np.float32),
        coverage=np.zeros((view.height, view.width), np.float32),
        depth=np.zeros((view.height, view.width), np.float32),
        normal=np.zeros((view.height, view.width, 3), np.float32),
        part=np.zeros((view.height, view.width), np.uint8),
    )
    left, top, right, bottom = _extent(in_camera, view)
    if left >= right or top >= bottom:
        return rendered
    # Sample (column, row) of the fine grid lies at pixel (left, top) + ((column, row) + 1/2) / samples.
    grid = np.array([[samples, 0, -left * samples], [0, samples, -top * samples], [0, 0, 1.0]]) @ view.intrinsics
    points = project(in_camera, grid, NEAR)
    nearest = z_buffer(
        points, figure.faces, (bottom - top) * samples, (right - left) * samples, (NEAR, np.inf),
        alpha_test=AlphaTest(figure.corner_uv, figure.part, textures.full_size, bilinear=True),
    )  # fmt: skip
    face, rgba = nearest.triangle, textures.rgba.view(np.uint32)[:, 0]
    edges = np.empty((len(figure.faces), 3, 3))
    _edge_functions(points, figure.faces, face, edges)
    _shade(
        face, samples, left, top, edges, figure.corner_uv, figure.part, rgba, textures.start, textures.size,
        textures.last, textures.cut_out, LINEAR_OF_SIXTEENTH, rendered.rgb, rendered.coverage,
    )  # fmt: skip
    _look_up(
        face, nearest.depth, samples, left, top, edges, figure.faces, figure.joint, posed.normals, posed.vertices,
        view.position, rendered.depth, rendered.normal, rendered.part,
    )  # fmt: skip
    return rendered


def _extent(in_camera: np.ndarray, view: View) -> tuple[int, int, int, int]:
    """Bounds of the visible pixels: left, top, right and bottom, the last two exclusive."""
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
def _edge_functions(points, faces, face, edges):
    """Write the edge functions (linear in column, row, 1) of the visible faces, scaled to barycentric weights."""
    seen = np.zeros(len(faces), np.bool_)
    for f in face.ravel():
        if f >= 0:
            seen[f] = True
    for f in np.flatnonzero(seen):
        for corner in range(3):
            p, q = points[faces[f, (corner + 1) % 3]], points[faces[f, (corner + 2) % 3]]
            scale = points[faces[f, corner], 3]
            edges[f, corner, 0] = (p[1] * q[2] - p[2] * q[1]) * scale
            edges[f, corner, 1] = (p[2] * q[0] - p[0] * q[2]) * scale
            edges[f, corner, 2] = (p[0] * q[1] - p[1] * q[0]) * scale


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _level(u, v, e, uv, scale, texels_of_uv, last):
    """Mip level of a sample, from the texels in its footprint, the determinant of d(u, v) / d(x, y)."""
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
                    covered += face[row, column] >= 0
            if covered == 0:
                continue
            # In fully covered pixels, every other sample is shaded, in a checkerboard.
            stride = 2 if covered == samples * samples else 1
            red, green, blue, hits, before, level, part, holed = one * 0, one * 0, one * 0, 0, -1, 0, 0, False
            for row in range(pixel_row * samples, (pixel_row + 1) * samples):
                first = pixel * samples + (row - pixel_row * samples) % stride
                for column in range(first, (pixel + 1) * samples, stride):
                    f = face[row, column]
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
                    x0, x1, y0, y1, wx, wy = texels_around(u, v, size[part, level, 0], columns)
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
    face, distance, samples, left, top, edges, faces, joint, normals, vertices, eye, depth, normal, part
):  # fmt: skip
    direction = np.zeros(3)
    for pixel_row in range(face.shape[0] // samples):
        row = pixel_row * samples + samples // 2
        for pixel in range(face.shape[1] // samples):
            column = pixel * samples + samples // 2
            f = face[row, column]
            if f < 0:
                continue
            depth[top + pixel_row, left + pixel] = distance[row, column]
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
