"""Input of the appearance branch: image colours at points of a human, averaged over the views that see them.

The paper (sec. 3.2, SPEC 2) samples the body surface at every texel of its UV square. Cloth and hair are centimetres
off the surface, so different views of one texel show different points. Sampling at the voxels of the boxes avoids this,
and the masks then tell which voxels are outside of the human.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
from collections.abc import Callable

import numba
import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray
from torch import Tensor
from torch.utils.data import get_worker_info

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.capture.reader import Views
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.surface import surface_points, vertex_normals
from primdiffusion.primitives.anchors import default_texels
from primdiffusion.primitives.primitives import GRID, Frames, K, S
from primdiffusion.raster.uv_atlas import UvRaster, rasterise_uv
from primdiffusion.raster.z_buffer import nearest_triangles

SIDE = GRID * S
"""Texels per side: one per column of voxels."""
TOLERANCE = 0.020
"""Depth behind the body surface, metres, up to which a point counts as visible (SPEC 2)."""
COVERED = 128
"""Smallest mask value (of 255) of a pixel whose colour is used."""
HULL_SHARE, HULL_MARGIN = 0.1, 0.06
"""Part of a layer of voxels that the masks must cover for a box to contain it, and how far the box reaches beyond it,
in half extents."""


@dataclasses.dataclass(frozen=True)
class Unprojected(TensorRecord):
    """Image samples at points arranged as an image of SIDE x SIDE with `d` layers."""

    rgb: UInt8[Tensor, "*b d 3 h w"] | Float32[Tensor, "*b d 3 h w"]
    """sRGB-encoded mean over the views, 0 ... 255; 0 if no view sees the point. A texture's are not rounded."""
    seen: UInt8[Tensor, "*b d h w"]
    """255 times the fraction of the views' weight that sees the point."""
    covered: UInt8[Tensor, "*b d h w"]
    """Least mask value at the point, of 255: below 128, some view sees past it. 255 if it is outside all images."""
    extent: Float32[Tensor, "*b k 3"]
    """Delta scales along T, B, N from which the encoder starts; those of the boxes whose voxels these are."""


def unproject_texels(
    views: Views, vertices: Float[Tensor, "V 3"], facing: int, body: BodyModel | None = None
) -> Unprojected:
    """Sample the images at the body surface for every texel of its UV square (paper sec. 3.2, SPEC 2): one layer.

    `views` show one human in one pose (unbatched), `vertices` (metres) are the body in that pose. A view sees a point
    that is at most TOLERANCE behind the body surface in that view; its weight is the cosine of the angle to the normal
    to the power `facing`. Texels outside of every chart are not visible.

    Raises:
        ValueError: there are no views, they are batched, or their cameras differ in size or number; vertices are not
            finite or do not match the body; the body has no UV map.
    """
    body = default_body() if body is None else body
    check(views, vertices, body)
    face, barycentric = _texels(body)
    known = (face >= 0).flatten()
    face, barycentric = face.clamp_min(0).flatten(), barycentric.flatten(0, 1)
    points = surface_points(vertices, body.faces, face, barycentric)
    normals = surface_points(vertex_normals(vertices, body.faces), body.faces, face, barycentric)
    points = torch.where(known[:, None], points, torch.nan)
    return _look_up(views, vertices, body, points[None], normals[None], facing, torch.ones(K, 3))


def unproject_voxels(
    views: Views,
    vertices: Float[Tensor, "V 3"],
    frames: Frames,
    extent: Float32[Tensor, "k 3"],
    facing: int,
    body: BodyModel | None = None,
) -> Unprojected:
    """Sample the images at every voxel of the boxes: S layers, from inside out. `frames` are unbatched and of rest
    size, `extent` are the boxes' delta scales.

    Layer d, row ny * 8 + h, column nx * 8 + w is voxel (d, h, w) of primitive ny * 32 + nx. Views are
    weighted as in `unproject_texels`, by the box's normal; a voxel in front of the body surface is visible too.

    Raises:
        ValueError: as `unproject_texels`, and if the number of frames is not K.
    """
    body = default_body() if body is None else body
    check(views, vertices, body)
    if tuple(frames.position.shape) != (K, 3):
        raise ValueError(f"the boxes' positions have the shape {tuple(frames.position.shape)}: give one human's {K}")
    local = torch.linspace(-1, 1, S, dtype=vertices.dtype, device=vertices.device)
    t, b, n = (frames.rotation * (frames.half_extent * extent)[:, None, :]).unbind(-1)
    columns = local[:, None, None] * b[:, None, None] + local[None, :, None] * t[:, None, None]  # k h w 3
    columns = (columns + frames.position[:, None, None]).unflatten(0, (GRID, GRID)).transpose(1, 2)  # ny h nx w 3
    out = n.unflatten(0, (GRID, GRID))[:, None, :, None]
    points = (columns + local[:, None, None, None, None, None] * out).flatten(-3, -2).flatten(1, 2)
    normals = frames.rotation[..., 2].unflatten(0, (GRID, GRID))
    normals = normals.repeat_interleave(S, 0).repeat_interleave(S, 1).expand(S, -1, -1, -1)
    return _look_up(views, vertices, body, points.flatten(1, 2), normals.flatten(1, 2), facing, extent)


def extents_of_hull(found: Unprojected, least: tuple[float, float, float]) -> Float32[Tensor, "k 3"]:
    """Delta scales with which boxes reach along N as far as the masks' hull, from `least` to those of `found`.

    `found` are the voxels of the largest boxes. Tight clothes get thin boxes, hence small voxels; hair and skirts get
    thick ones, which contain them.
    """
    inside = (found.covered >= COVERED).unflatten(-1, (GRID, S)).unflatten(-3, (GRID, S))  # d ny h nx w
    share = inside[:, :, 1:-1, :, 1:-1].float().mean((2, 4)).flatten(1)  # d k; neighbours share the outer columns
    layer = torch.linspace(-1, 1, S)[:, None]
    outermost = torch.where(share > HULL_SHARE, layer, -1).amax(0)
    extent = torch.tensor(least).repeat(K, 1)
    extent[:, 2] = (found.extent[:, 2] * (outermost + HULL_MARGIN)).clamp(least[2]).minimum(found.extent[:, 2])
    return extent


@functools.lru_cache(maxsize=4)
def _texels(body: BodyModel) -> tuple[Tensor, Tensor]:
    """Face and barycentric coordinates of SIDE x SIDE texels; face -1 outside of the charts."""
    if body is default_body():
        return default_texels()
    if body.uv.numel() == 0:
        raise ValueError("the body has no UV coordinates: load it with a UV map, or look its voxels up")
    raster: UvRaster = rasterise_uv(body.uv[body.uv_faces].double().cpu().numpy(), SIDE, SIDE)
    return torch.from_numpy(raster.face), torch.from_numpy(raster.barycentric).to(body.template.dtype)


def _look_up(
    views: Views,
    vertices: Float[Tensor, "V 3"],
    body: BodyModel,
    points: Float[Tensor, "d n 3"],
    normals: Float[Tensor, "d n 3"],
    facing: int,
    extent: Float32[Tensor, "k 3"],
) -> Unprojected:
    depth = body_depth(views, vertices, body.faces)
    rgb, seen, covered = (
        torch.from_numpy(found).unflatten(0, (len(points), SIDE, SIDE))
        for found in sample(views, depth, points.flatten(0, 1), normals.flatten(0, 1), facing)
    )
    return Unprojected(rgb.movedim(-1, 1).contiguous(), seen, covered, extent.cpu()).to(views.rgba.device)


def check(views: Views, vertices: Tensor, body: BodyModel) -> None:
    """Raise ValueError unless views, cameras and body match: compiled code does no bounds checks."""
    shape, camera = tuple(views.rgba.shape), views.camera
    if len(shape) != 4 or not shape[0] or shape[-1] != 4 or views.rgba.dtype != torch.uint8:
        raise ValueError(f"views are {views.rgba.dtype} {shape}: give one human's, uint8 [v, H, W, 4], v > 0")
    if tuple(camera.world_to_camera.shape) != (shape[0], 3, 4) or tuple(camera.intrinsics.shape) != (shape[0], 3, 3):
        cameras = tuple(camera.world_to_camera.shape)
        raise ValueError(f"there are {shape[0]} pictures, but cameras of shape {cameras}: give one for each picture")
    if (camera.height, camera.width) != shape[1:3]:
        raise ValueError(
            f"the pictures are {shape[2]} x {shape[1]} pixels, but their cameras {camera.width} x {camera.height}: "
            "scale the pictures, or the intrinsics with them"
        )
    if vertices.shape != body.template.shape:
        raise ValueError(
            f"the posed vertices have the shape {tuple(vertices.shape)}, the body {tuple(body.template.shape)}: "
            "give one human's in one pose, of the same body"
        )
    if not torch.isfinite(vertices).all():
        raise ValueError("the posed vertices hold NaN or infinite values; check the pose and the betas they come from")


def body_depth(views: Views, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float32[ndarray, "v H W"]:
    """Depth of the body surface along each view's optical axis, metres; inf outside the silhouette."""
    corners = vertices.detach()[faces].cpu().numpy().astype(np.float64)
    camera = views.camera.to("cpu")
    depth = np.empty(views.rgba.shape[:3], np.float32)

    def draw(first: int, last: int) -> None:
        for view in range(first, last):
            depth[view] = nearest_triangles(corners, camera.map(lambda tensor, view=view: tensor[view])).depth

    _in_parts(len(depth), draw)
    return depth


def sample(
    views: Views,
    depth: Float32[ndarray, "v H W"],
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    facing: int,
) -> tuple[UInt8[ndarray, "n 3"], UInt8[ndarray, "n"], UInt8[ndarray, "n"]]:
    """Colour, visible weight and least mask at points, in the encoding of `Unprojected`; NaN points are not visible.

    `depth` is the body surface's depth in each view; views are weighted by the normal's cosine to the power `facing`.
    """
    rgba = np.ascontiguousarray(views.rgba.cpu().numpy())
    world_to_pixel = (views.camera.intrinsics @ views.camera.world_to_camera).cpu().numpy().astype(np.float32)
    origin = views.camera.position.cpu().numpy().astype(np.float32)
    where, normal = (
        np.ascontiguousarray(tensor.detach().cpu().numpy().astype(np.float32)) for tensor in (points, normals)
    )
    rgb = np.zeros((len(where), 3), np.uint8)
    seen, covered = np.zeros(len(where), np.uint8), np.zeros(len(where), np.uint8)
    _in_parts(len(where), lambda first, last: _sample(
        where[first:last], normal[first:last], rgba, depth, world_to_pixel, origin, facing, TOLERANCE,
        rgb[first:last], seen[first:last], covered[first:last]))  # fmt: skip
    return rgb, seen, covered


def _in_parts(count: int, work: Callable[[int, int], None]) -> None:
    """Run `work(first, last)` over 0 ... count on as many threads as torch uses, or one in a data loader worker."""
    threads = 1 if get_worker_info() is not None else max(torch.get_num_threads(), 1)
    edges = np.linspace(0, count, threads + 1).astype(int).tolist()
    if threads == 1:
        work(0, count)
        return
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, edges[:-1], edges[1:]))


@numba.njit(cache=True, nogil=True)
def _sample(points, normals, rgba, depth, world_to_pixel, origin, facing, tolerance, rgb, seen, covered):
    views, height, width = depth.shape
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if np.isnan(x):
            covered[i] = 255
            continue
        red, green, blue, total, possible = (np.float32(0), np.float32(0), np.float32(0), np.float32(0), np.float32(0))
        least = np.float32(255)
        for view in range(views):
            p = world_to_pixel[view]
            w = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if w <= np.float32(1e-3):
                continue
            u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / w
            v = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / w
            if not (u >= np.float32(0) and v >= np.float32(0) and u < width and v < height):
                continue
            dx, dy, dz = origin[view, 0] - x, origin[view, 1] - y, origin[view, 2] - z
            cosine = normals[i, 0] * dx + normals[i, 1] * dy + normals[i, 2] * dz
            cosine /= np.sqrt(dx * dx + dy * dy + dz * dz)
            cosine = max(cosine, np.float32(0.02))
            weight = np.float32(1)
            for _ in range(facing):
                weight *= cosine
            possible += weight
            column, row = int(u), int(v)
            fu, fv = u - np.float32(0.5), v - np.float32(0.5)
            left, top = int(np.floor(fu)), int(np.floor(fv))
            su, sv = fu - left, fv - top
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            left, top = max(left, 0), max(top, 0)
            a, b = rgba[view, top, left], rgba[view, top, right]
            c, d = rgba[view, bottom, left], rgba[view, bottom, right]
            wa, wb = (1 - su) * (1 - sv), su * (1 - sv)
            wc, wd = (1 - su) * sv, su * sv
            alpha = wa * a[3] + wb * b[3] + wc * c[3] + wd * d[3]
            least = min(least, alpha)
            if w > depth[view, row, column] + tolerance or alpha < COVERED:
                continue
            weight *= alpha / np.float32(255)
            total += weight
            red += weight * (wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0])
            green += weight * (wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1])
            blue += weight * (wa * a[2] + wb * b[2] + wc * c[2] + wd * d[2])
        covered[i] = np.uint8(least + np.float32(0.5))
        if total > np.float32(0):
            rgb[i, 0] = np.uint8(red / total + np.float32(0.5))
            rgb[i, 1] = np.uint8(green / total + np.float32(0.5))
            rgb[i, 2] = np.uint8(blue / total + np.float32(0.5))
            seen[i] = np.uint8(max(np.float32(255) * min(total / possible, np.float32(1)), np.float32(1)))
