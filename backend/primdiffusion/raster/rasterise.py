"""Images of textured meshes, unlit, with an alpha test, from cameras and orthographic views.

Deferred shading: `draw` finds the triangle seen at each pixel, `shade` looks up its colour, and `rasterise` does both
and averages sub-pixels.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.textures import ALPHA_TEST, LINEAR_OF_BYTE, Textures, gather_textures
from primdiffusion.raster.z_buffer import AlphaTest, barycentrics, project, z_buffer

NEAR = 1e-3
"""Metres in front of a camera; nearer surfaces are not drawn."""


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
    texels: Textures


@dataclasses.dataclass(frozen=True, eq=False)
class Fragments:
    """The surface point seen at each pixel centre."""

    face: Int32[np.ndarray, "H W"]
    """Face of the soup, -1 for background."""
    barycentric: Float32[np.ndarray, "H W 3"]
    """Perspective-correct barycentric coordinates on the face."""
    depth: Float32[np.ndarray, "H W"]
    """Metres along the optical axis; inf for background."""


@dataclasses.dataclass(frozen=True, eq=False)
class RasterImage:
    """A rasterised mesh on black."""

    rgb: Float32[np.ndarray, "H W 3"]
    """Linear, premultiplied by `alpha`."""
    alpha: Float32[np.ndarray, "H W"]
    """Share of the pixel's samples that hit the mesh; 0 or 1 without supersampling."""
    depth: Float32[np.ndarray, "H W"]
    """Metres along the pixel's ray to the nearest sample; inf where alpha is 0."""
    part: Int32[np.ndarray, "H W"]
    """Part of the nearest sample; -1 where alpha is 0."""


def rasterise(mesh: TexturedMesh, view: Camera | OrthographicView, supersample: int = 1) -> RasterImage:
    """Render the mesh from `view`, unlit and two-sided.

    `supersample` x `supersample` samples per pixel are averaged in linear light, which antialiases edges and textures.
    Deterministic. Not differentiable.

    Raises:
        ValueError: see `flatten`; `supersample` is less than 1.
    """
    ((picture,),) = rasterise_colourings([mesh], [view], supersample)
    return picture


def rasterise_colourings(
    meshes: Sequence[TexturedMesh], views: Sequence[Camera | OrthographicView], supersample: int = 1
) -> Iterator[list[RasterImage]]:
    """As `rasterise`, for each view: the images of meshes that differ only in the colours of their textures.

    Triangles are drawn once for a view, and textures gathered once.

    Raises:
        ValueError: see `flatten`; `supersample` is less than 1.
    """
    if supersample < 1:
        raise ValueError(f"supersample is {supersample}: give 1 or more")
    soup = flatten(meshes[0])
    coloured = [soup, *(dataclasses.replace(soup, texels=gather_textures(mesh)) for mesh in meshes[1:])]
    for view in views:
        fragments = draw(soup, _finer(view, supersample))
        first = _picture(soup, fragments, view, supersample)
        yield [first, *(dataclasses.replace(first, rgb=_colour(own, fragments, supersample)) for own in coloured[1:])]


def _picture(
    soup: TriangleSoup, fragments: Fragments, view: Camera | OrthographicView, supersample: int
) -> RasterImage:
    distance = fragments.depth * _ray_lengths(view, supersample)
    part = np.where(fragments.face >= 0, soup.part[fragments.face], -1).astype(np.int32)
    nearest = _blocks(distance, supersample).argmin(-1)[..., None]
    return RasterImage(
        rgb=_colour(soup, fragments, supersample),
        alpha=_blocks((fragments.face >= 0).astype(np.float32), supersample).mean(-1),
        depth=np.take_along_axis(_blocks(distance, supersample), nearest, -1)[..., 0],
        part=np.take_along_axis(_blocks(part, supersample), nearest, -1)[..., 0],
    )


def _colour(soup: TriangleSoup, fragments: Fragments, supersample: int) -> Float32[np.ndarray, "H W 3"]:
    """Means over the samples of a pixel."""
    rgb = shade(soup, fragments)
    if supersample == 1:
        return rgb
    samples = [
        rgb[row::supersample, column::supersample] for row in range(supersample) for column in range(supersample)
    ]
    return functools.reduce(np.add, samples) / np.float32(len(samples))


def draw(soup: TriangleSoup, view: Camera | OrthographicView) -> Fragments:
    """The nearest triangle behind each pixel centre that passes the alpha test; of several at one depth the first."""
    parallel = isinstance(view, OrthographicView)
    if parallel:
        in_view = soup.vertices @ view.world_to_view[:, :3].T + view.world_to_view[:, 3]
        ones = np.ones(len(in_view))
        points = np.column_stack([in_view[:, :2] / view.pixel_size, ones, in_view[:, 2]])
        clip = (-np.inf, np.inf)
    else:
        world_to_camera = view.world_to_camera.detach().cpu().double().numpy()
        in_camera = soup.vertices @ world_to_camera[:, :3].T + world_to_camera[:, 3]
        points = project(in_camera, view.intrinsics.detach().cpu().double().numpy(), NEAR)
        clip = (NEAR, np.inf)
    alpha_test = AlphaTest(soup.corner_uv, soup.part, soup.texels)
    nearest = z_buffer(points, soup.faces, view.height, view.width, clip, parallel=parallel, alpha_test=alpha_test)
    barycentric = barycentrics(points, soup.faces, nearest.triangle, parallel, np.float32)
    return Fragments(nearest.triangle, barycentric, nearest.depth)


def shade(soup: TriangleSoup, fragments: Fragments) -> Float32[np.ndarray, "H W 3"]:
    """Linear colour of every fragment, bilinear between texels that pass the alpha test; black for background."""
    rgb = np.zeros((*fragments.face.shape, 3), np.float32)
    texels = soup.texels
    _shade(
        fragments.face, fragments.barycentric, soup.corner_uv, soup.part, texels.rgba, texels.start, texels.size,
        LINEAR_OF_BYTE, rgb,
    )  # fmt: skip
    return rgb


def _finer(view: Camera | OrthographicView, factor: int) -> Camera | OrthographicView:
    """The same view with `factor` times as many pixels along each side."""
    larger: dict[str, Any] = {"width": view.width * factor, "height": view.height * factor}
    if isinstance(view, OrthographicView):
        return dataclasses.replace(view, pixel_size=view.pixel_size / factor, **larger)
    intrinsics = view.intrinsics.clone()
    intrinsics[:2] *= factor
    return dataclasses.replace(view, intrinsics=intrinsics, **larger)


def _ray_lengths(view: Camera | OrthographicView, supersample: int) -> Float32[np.ndarray, "H W"] | np.float32:
    """Distance along the ray per metre along the optical axis."""
    if isinstance(view, OrthographicView):
        return np.float32(1)
    finer = _finer(view, supersample)
    assert isinstance(finer, Camera)
    k = finer.intrinsics.detach().cpu().double().numpy()
    y = (np.arange(finer.height)[:, None] + 0.5 - k[1, 2]) / k[1, 1]
    x = (np.arange(finer.width)[None, :] + 0.5 - k[0, 2] - k[0, 1] * y) / k[0, 0]
    return np.sqrt(1 + x * x + y * y).astype(np.float32)


def _blocks(picture: np.ndarray, side: int) -> np.ndarray:
    """[H * side, W * side] -> [H, W, side * side]."""
    height, width = picture.shape[0] // side, picture.shape[1] // side
    return picture.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, side * side)


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
        texels=gather_textures(mesh),
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


@numba.njit(cache=True, nogil=True)
def _shade(face, bary, corner_uv, face_part, rgba, start, size, linear_of_byte, rgb):
    for row in range(face.shape[0]):
        for column in range(face.shape[1]):
            f = face[row, column]
            if f < 0:
                continue
            u, v = 0.0, 0.0
            for corner in range(3):
                u += bary[row, column, corner] * corner_uv[f, corner, 0]
                v += bary[row, column, corner] * corner_uv[f, corner, 1]
            part = face_part[f]
            rows, columns = size[part, 0], size[part, 1]
            x, y = (u - np.floor(u)) * columns - 0.5, (1.0 - (v - np.floor(v))) * rows - 0.5
            x0, y0 = int(np.floor(x)), int(np.floor(y))
            total = 0.0
            for dy in range(2):
                for dx in range(2):
                    texel = start[part] + ((y0 + dy) % rows) * columns + (x0 + dx) % columns
                    weight = (1.0 - abs(x - x0 - dx)) * (1.0 - abs(y - y0 - dy))
                    if rgba[texel, 3] >= ALPHA_TEST:
                        total += weight
                        for channel in range(3):
                            rgb[row, column, channel] += weight * linear_of_byte[rgba[texel, channel]]
            if total > 0.0:
                for channel in range(3):
                    rgb[row, column, channel] /= total
