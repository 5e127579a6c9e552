"""Pictures of textured meshes on the CPU: a z-buffer, an alpha test, textures; no light.

Two steps, as in deferred shading: `draw` finds for each pixel the nearest triangle that passes the alpha test, `shade`
looks up its colour. `rasterise` does both and averages sub-pixels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from jaxtyping import Float32, Int32

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import decode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.raster.orthographic import OrthographicView
from primdiffusion.raster.triangle_soup import ALPHA_TEST, TriangleSoup, flatten, gather_textures

NEAR = 1e-3
"""Triangles with a corner closer to a camera's plane than this (metres) are left out, not clipped."""

LINEAR_OF_BYTE = decode_srgb(np.arange(256, dtype=np.float64) / 255).astype(np.float32)
"""Linear intensity of an sRGB-encoded byte."""


@dataclasses.dataclass(frozen=True, eq=False)
class Fragments:
    """What is seen through each pixel's centre."""

    face: Int32[np.ndarray, "H W"]
    """Number of the face in the soup, -1 where there is none."""
    barycentric: Float32[np.ndarray, "H W 3"]
    """Where on the face, in space (perspective-correct)."""
    depth: Float32[np.ndarray, "H W"]
    """Metres along the axis of the view; inf where there is nothing."""


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
    """The mesh seen from `view`, unlit, from both sides of its faces.

    `supersample` squared samples a pixel are averaged in linear light, which is the remedy for aliasing of edges
    and fine textures; the time grows with it. The same input gives the same bits. Not differentiable.

    Raises:
        UnusableMesh: see `flatten`.
        ValueError: `supersample` is less than 1.
    """
    return rasterise_colourings([mesh], view, supersample)[0]


def rasterise_colourings(
    meshes: Sequence[TexturedMesh], view: Camera | OrthographicView, supersample: int = 1
) -> list[RasterImage]:
    """As `rasterise`, of meshes that differ only in the colours of their textures: triangles are drawn once.

    Raises:
        UnusableMesh: see `flatten`.
        ValueError: `supersample` is less than 1.
    """
    if supersample < 1:
        raise ValueError(f"supersample is {supersample}; it must be 1 or more.")
    soup = flatten(meshes[0])
    fragments = draw(soup, _finer(view, supersample))
    pictures = []
    for mesh in meshes:
        own = soup if mesh is meshes[0] else dataclasses.replace(soup, texels=gather_textures(mesh))
        pictures.append(_picture(own, fragments, view, supersample))
    return pictures


def _picture(
    soup: TriangleSoup, fragments: Fragments, view: Camera | OrthographicView, supersample: int
) -> RasterImage:
    rgb = shade(soup, fragments)
    distance = fragments.depth * _ray_lengths(view, supersample)
    part = np.where(fragments.face >= 0, soup.part[fragments.face], -1).astype(np.int32)
    if supersample == 1:
        return RasterImage(rgb, (fragments.face >= 0).astype(np.float32), distance, part)
    nearest = _blocks(distance, supersample).argmin(-1)[..., None]
    return RasterImage(
        rgb=np.stack([_blocks(rgb[..., channel], supersample).mean(-1) for channel in range(3)], -1),
        alpha=_blocks((fragments.face >= 0).astype(np.float32), supersample).mean(-1),
        depth=np.take_along_axis(_blocks(distance, supersample), nearest, -1)[..., 0],
        part=np.take_along_axis(_blocks(part, supersample), nearest, -1)[..., 0],
    )


def draw(soup: TriangleSoup, view: Camera | OrthographicView) -> Fragments:
    """The nearest triangle behind each pixel centre; where two are equally near, the one of lower number."""
    if isinstance(view, OrthographicView):
        in_view = soup.vertices @ view.world_to_view[:, :3].T + view.world_to_view[:, 3]
        pixels, depth = in_view[:, :2] / view.pixel_size, in_view[:, 2]
        inverse_depth = np.ones_like(depth)
        perspective = False
    else:
        world_to_camera = view.world_to_camera.detach().cpu().double().numpy()
        intrinsics = view.intrinsics.detach().cpu().double().numpy()
        in_camera = soup.vertices @ world_to_camera[:, :3].T + world_to_camera[:, 3]
        depth = in_camera[:, 2]
        inverse_depth = 1 / np.maximum(depth, NEAR)
        pixels = (in_camera @ intrinsics.T)[:, :2] * inverse_depth[:, None]
        perspective = True
    face = np.full((view.height, view.width), -1, np.int32)
    barycentric = np.zeros((view.height, view.width, 3), np.float32)
    buffer = np.full((view.height, view.width), np.inf, np.float32)
    texels = soup.texels
    _draw(
        np.ascontiguousarray(pixels), np.ascontiguousarray(depth), inverse_depth, perspective, soup.faces,
        soup.corner_uv, soup.part, texels.rgba, texels.start, texels.size, texels.cut_out, face, barycentric, buffer,
    )  # fmt: skip
    return Fragments(face, barycentric, buffer)


def shade(soup: TriangleSoup, fragments: Fragments) -> Float32[np.ndarray, "H W 3"]:
    """Linear colour of every fragment, bilinear between texels that pass the alpha test; black where there is none."""
    rgb = np.zeros((*fragments.face.shape, 3), np.float32)
    texels = soup.texels
    _shade(
        fragments.face, fragments.barycentric, soup.corner_uv, soup.part, texels.rgba, texels.start, texels.size,
        LINEAR_OF_BYTE, rgb,
    )  # fmt: skip
    return rgb


def _finer(view: Camera | OrthographicView, factor: int) -> Camera | OrthographicView:
    """The same picture with `factor` times as many pixels a side."""
    larger: dict[str, Any] = {"width": view.width * factor, "height": view.height * factor}
    if isinstance(view, OrthographicView):
        return dataclasses.replace(view, pixel_size=view.pixel_size / factor, **larger)
    intrinsics = view.intrinsics.clone()
    intrinsics[:2] *= factor
    return dataclasses.replace(view, intrinsics=intrinsics, **larger)


def _ray_lengths(view: Camera | OrthographicView, supersample: int) -> Float32[np.ndarray, "H W"] | np.float32:
    """How much longer the way along the ray is than along the axis of the view."""
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


@numba.njit(cache=True, nogil=True)
def texel_at(u, v, rows, columns):
    """Row-major number of the texel under (u, v), which wrap around; v up."""
    row = min(int((1.0 - (v - np.floor(v))) * rows), rows - 1)
    column = min(int((u - np.floor(u)) * columns), columns - 1)
    return row * columns + column


@numba.njit(cache=True, nogil=True)
def _draw(
    pixels, depth, inverse_depth, perspective, faces, corner_uv, face_part, rgba, start, size, cut_out,
    face, bary, buffer,
):  # fmt: skip
    height, width = face.shape
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if perspective and min(depth[i], depth[j], depth[k]) < NEAR:
            continue
        xi, yi, xj, yj, xk, yk = pixels[i, 0], pixels[i, 1], pixels[j, 0], pixels[j, 1], pixels[k, 0], pixels[k, 1]
        area = (xj - xi) * (yk - yi) - (xk - xi) * (yj - yi)
        if area == 0.0:
            continue
        left = int(np.ceil(max(min(xi, xj, xk) - 0.5, 0.0)))
        right = int(np.floor(min(max(xi, xj, xk) - 0.5, width - 1.0)))
        top = int(np.ceil(max(min(yi, yj, yk) - 0.5, 0.0)))
        bottom = int(np.floor(min(max(yi, yj, yk) - 0.5, height - 1.0)))
        part = face_part[f]
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                a = ((xj - x) * (yk - y) - (xk - x) * (yj - y)) / area
                b = ((xk - x) * (yi - y) - (xi - x) * (yk - y)) / area
                c = 1.0 - a - b
                if a < 0.0 or b < 0.0 or c < 0.0:
                    continue
                if perspective:
                    a, b, c = a * inverse_depth[i], b * inverse_depth[j], c * inverse_depth[k]
                    z = 1.0 / (a + b + c)
                    a, b, c = a * z, b * z, c * z
                else:
                    z = a * depth[i] + b * depth[j] + c * depth[k]
                if not np.float32(z) < buffer[row, column]:
                    continue
                if cut_out[part]:
                    u = a * corner_uv[f, 0, 0] + b * corner_uv[f, 1, 0] + c * corner_uv[f, 2, 0]
                    v = a * corner_uv[f, 0, 1] + b * corner_uv[f, 1, 1] + c * corner_uv[f, 2, 1]
                    if rgba[start[part] + texel_at(u, v, size[part, 0], size[part, 1]), 3] < ALPHA_TEST:
                        continue
                buffer[row, column] = z
                face[row, column] = f
                bary[row, column, 0], bary[row, column, 1], bary[row, column, 2] = a, b, c


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
