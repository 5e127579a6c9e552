"""Visible surfaces of a mesh and their colours: unlit, two-sided, textured, with an alpha test.

`draw` finds the triangle at each sample by the z-buffer, `shade` its colours. A triangle's edge functions, scaled to
its corners' depths, are linear in the pixel and proportional to its perspective-correct barycentric coordinates, so
colours, normals and texture footprints follow from them.
"""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from primdiffusion.formats.camera_rig import View
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.textures import Textures, gather_textures, texels_around
from primdiffusion.raster.z_buffer import AlphaTest, barycentrics, project, z_buffer

NEAR = 1e-3
"""Metres in front of a camera; nearer surfaces are not drawn."""
COARSE_TEXELS = 8.0
"""Texels under a sample above which the halved texture is read."""
LINEAR_OF_SIXTEENTH = decode_srgb(np.arange(255 * 16 + 1) / (255 * 16)).astype(np.float32)
"""Linear intensity of sixteenths of an sRGB-encoded byte: textures are interpolated as stored, as Cycles does."""


@dataclasses.dataclass(frozen=True, eq=False)
class OrthographicView:
    """Parallel rays along the third row of `world_to_view`; x right, y down, as in an OpenCV camera."""

    world_to_view: Float[np.ndarray, "3 4"]
    """[R | t], metres; the view's origin is the outer corner of pixel (0, 0)."""
    pixel_size: float
    """Side of a pixel, metres."""
    width: int
    height: int

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Direction of the rays."""
        return self.world_to_view[2, :3]


@dataclasses.dataclass(frozen=True, eq=False)
class TriangleSoup:
    """The triangles of all parts, concatenated."""

    vertices: Float64[np.ndarray, "V 3"]
    """Metres."""
    faces: Int32[np.ndarray, "F 3"]
    """Indices into `vertices`."""
    corner_uv: Float32[np.ndarray, "F 3 2"]
    """v up, as in TexturedPart."""
    part: Int32[np.ndarray, "F"]
    """Part of each face."""
    textures: Textures


@dataclasses.dataclass(frozen=True, eq=False)
class Fragments:
    """The surface point seen at each sample: of the whole view, or of a window of it."""

    face: Int32[np.ndarray, "h w"]
    """Face of the soup, -1 for background."""
    depth: Float32[np.ndarray, "h w"]
    """Metres along the optical axis; inf for background."""
    edges: Float64[np.ndarray, "F 3 3"]
    """Weights of the corners of each face that is seen, linear in (column, row, 1) of the samples."""
    points: Float64[np.ndarray, "V 4"]
    """The vertices in the grid of samples (`z_buffer.project`)."""
    soup: TriangleSoup
    samples: int
    """Along a pixel's side."""
    left: int
    top: int
    """First pixel of the window."""
    parallel: bool

    @property
    def barycentric(self) -> Float32[np.ndarray, "h w 3"]:
        """Perspective-correct barycentric coordinates on the face."""
        return barycentrics(self.points, self.soup.faces, self.face, self.parallel, np.float32)


def draw(
    soup: TriangleSoup,
    view: Camera | View | OrthographicView,
    samples: int = 1,
    window: tuple[int, int, int, int] | None = None,
) -> Fragments:
    """The nearest triangle behind each sample that passes the alpha test; of several at one depth the first.

    `samples` x `samples` samples lie in each pixel of `window`: left, top, right and bottom, the last two exclusive.
    """
    left, top, right, bottom = window or (0, 0, view.width, view.height)
    # Sample (column, row) of the fine grid lies at pixel (left, top) + ((column, row) + 1/2) / samples.
    parallel = isinstance(view, OrthographicView)
    if isinstance(view, OrthographicView):
        in_view = soup.vertices @ view.world_to_view[:, :3].T + view.world_to_view[:, 3]
        columns = in_view[:, :2] / view.pixel_size * samples - np.array([left, top]) * samples
        points = np.column_stack([columns, np.ones(len(in_view)), in_view[:, 2]])
        clip = (-np.inf, np.inf)
    else:
        intrinsics, rotation, translation = camera_matrices(view)
        in_view = soup.vertices @ rotation.T + translation
        grid = np.array([[samples, 0, -left * samples], [0, samples, -top * samples], [0, 0, 1.0]]) @ intrinsics
        points, clip = project(in_view, grid, NEAR), (NEAR, np.inf)
    nearest = z_buffer(
        points, soup.faces, (bottom - top) * samples, (right - left) * samples, clip, parallel=parallel,
        alpha_test=AlphaTest(soup.corner_uv, soup.part, soup.textures),
    )  # fmt: skip
    edges = np.empty((len(soup.faces), 3, 3))
    _edge_functions(points, soup.faces, nearest.triangle, parallel, edges)
    return Fragments(nearest.triangle, nearest.depth, edges, points, soup, samples, left, top, parallel)


def camera_matrices(
    view: Camera | View,
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Intrinsics, rotation and translation of a camera."""
    if isinstance(view, View):
        return view.intrinsics, view.rotation, view.translation
    world_to_camera = view.world_to_camera.detach().cpu().double().numpy()
    return view.intrinsics.detach().cpu().double().numpy(), world_to_camera[:, :3], world_to_camera[:, 3]


def shade(
    fragments: Fragments, textures: Textures, height: int, width: int
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
    """Colour (linear, premultiplied) and coverage of each pixel of a view: means over its samples."""
    rgb, coverage = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    soup = fragments.soup
    _shade(
        fragments.face, fragments.samples, fragments.left, fragments.top, fragments.edges, soup.corner_uv, soup.part,
        textures.rgba.view(np.uint32)[:, 0], textures.start, textures.size, textures.last, textures.cut_out,
        LINEAR_OF_SIXTEENTH, rgb, coverage,
    )  # fmt: skip
    return rgb, coverage


def view_along(
    direction: tuple[float, float, float], bounds: Float[np.ndarray, "2 3"], pixel_size: float
) -> OrthographicView:
    """The smallest view along `direction` that contains the box `bounds`, starting in front of it; y is up.

    Raises:
        ValueError: `direction` is zero or `pixel_size` is not positive.
    """
    forward = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(forward))
    if length == 0 or pixel_size <= 0:
        raise ValueError(
            f"the direction is {direction} and the pixel size {pixel_size} m: give a direction and a positive size"
        )
    forward = forward / length
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    corners = np.stack(np.meshgrid(*np.asarray(bounds, np.float64).T, indexing="ij"), -1).reshape(8, 3) @ rotation.T
    low, high = corners.min(0) - pixel_size, corners.max(0) + pixel_size
    width, height = (math.ceil((high[axis] - low[axis]) / pixel_size) for axis in (0, 1))
    return OrthographicView(np.concatenate([rotation, -low[:, None]], axis=1), pixel_size, width, height)


def flatten(mesh: TexturedMesh) -> TriangleSoup:
    """Concatenate the parts of a mesh.

    Raises:
        ValueError: the mesh has no faces, values that are not finite, faces with invalid indices, or empty textures.
    """
    parts = [part for part in mesh.parts if len(part.faces)]
    if not parts:
        raise ValueError(f"the mesh has no triangles in its {len(mesh.parts)} parts: give at least one")
    for part in parts:
        _check(part)
    first = np.cumsum([0] + [len(part.vertices) for part in mesh.parts])
    return TriangleSoup(
        vertices=np.concatenate([np.asarray(part.vertices, np.float64) for part in mesh.parts]),
        faces=np.concatenate([part.faces.astype(np.int32) + np.int32(first[i]) for i, part in enumerate(mesh.parts)]),
        corner_uv=np.concatenate([part.corner_uv.astype(np.float32) for part in mesh.parts]),
        part=np.repeat(np.arange(len(mesh.parts), dtype=np.int32), [len(part.faces) for part in mesh.parts]),
        textures=gather_textures(mesh),
    )


def _check(part: TexturedPart) -> None:
    """Check for values that compiled loops would read out of bounds or drop."""
    for name, values in (("vertices", part.vertices), ("corner_uv", part.corner_uv)):
        if not np.isfinite(values).all():
            raise ValueError(
                f"part {part.name!r} has {int((~np.isfinite(values)).sum())} NaN or infinite values in {name}: "
                "repair or remove the part"
            )
    low, high = int(part.faces.min()), int(part.faces.max())
    if low < 0 or high >= len(part.vertices):
        raise ValueError(
            f"part {part.name!r} has faces with vertices {low} to {high}, but only {len(part.vertices)} vertices: "
            "repair the faces"
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _edge_functions(points, faces, face, parallel, edges):
    """Write the edge functions (linear in column, row, 1) of the visible faces, scaled to barycentric weights."""
    seen = np.zeros(len(faces), np.bool_)
    for f in face.ravel():
        if f >= 0:
            seen[f] = True
    for f in np.flatnonzero(seen):
        for corner in range(3):
            p, q = points[faces[f, (corner + 1) % 3]], points[faces[f, (corner + 2) % 3]]
            scale = 1.0 if parallel else points[faces[f, corner], 3]
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
