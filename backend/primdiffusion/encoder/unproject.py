"""The appearance branch's input: what pictures show at points of a person, averaged over the views that see them.

Paper sec. 3.2 looks up the body's surface, texel by texel of its UV square. Cloth and hair stand centimetres off it, so
that several views of one texel show several things; looking up the voxels of the boxes themselves does without this,
and the masks then say which voxels are outside of the person.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
from collections.abc import Callable, Sequence

import numba
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor
from torch.utils.data import get_worker_info

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.capture.dataset import Views
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.surface import surface_points, vertex_normals
from primdiffusion.geometry.uv_atlas import UvRaster, rasterise_uv
from primdiffusion.primitives.anchors import default_texels
from primdiffusion.primitives.primitives import GRID, Frames, K, S
from primdiffusion.render.triangles import nearest_triangles

SIDE = GRID * S
"""Texels a side: one for every column of voxels."""
TOLERANCE = 0.020
"""Metres behind the body's surface within which a point counts as seen (SPEC 2)."""
COVERED = 128
"""Of 255: pixels that the person covers less say nothing of their colour."""


@dataclasses.dataclass(frozen=True)
class Unprojected(TensorRecord):
    """What the pictures show at points that form a picture of SIDE x SIDE, in `d` layers."""

    rgb: UInt8[Tensor, "*b d 3 h w"]
    """sRGB-encoded mean of the views; 0 where none sees the point."""
    seen: UInt8[Tensor, "*b d h w"]
    """255 times the share of the views' weight that sees the point."""
    covered: UInt8[Tensor, "*b d h w"]
    """The least of the masks at the point, of 255: below 128 some view sees past it. 255 where no picture shows it."""


def unproject_texels(
    views: Views, vertices: Float[Tensor, "V 3"], facing: int, body: BodyModel | None = None
) -> Unprojected:
    """The pictures at the body's surface under every texel of its UV square (paper sec. 3.2, SPEC 2): one layer.

    `views` are one person's in one pose (unbatched), `vertices` (metres) the body in it. A view counts where the point
    lies no more than TOLERANCE behind the body's surface as that view sees it, by the cosine of its angle to the normal
    to the power `facing`. Texels outside of every chart are seen by nobody.

    Raises:
        ValueError: there are no views, they are batched or their cameras are of other sizes or numbers; vertices are
            not finite or not the body's; the body has no UV map.
    """
    body = default_body() if body is None else body
    _check(views, vertices, body)
    face, barycentric = _texels(body)
    known = (face >= 0).flatten()
    face, barycentric = face.clamp_min(0).flatten(), barycentric.flatten(0, 1)
    points = surface_points(vertices, body.faces, face, barycentric)
    normals = surface_points(vertex_normals(vertices, body.faces), body.faces, face, barycentric)
    points = torch.where(known[:, None], points, torch.nan)
    return _look_up(views, vertices, body, points[None], normals[None], facing)


def unproject_voxels(
    views: Views, vertices: Float[Tensor, "V 3"], frames: Frames, facing: int, body: BodyModel | None = None
) -> Unprojected:
    """The pictures at every voxel of the boxes in `frames` (unbatched, at their rest size): S layers, from inside out.

    Layer d, row ny * 8 + h, column nx * 8 + w is voxel (d, h, w) of primitive ny * 32 + nx. Views as in
    `unproject_texels`, by the angle to the box's normal; a voxel in front of the body's surface is seen too.

    Raises:
        ValueError: as `unproject_texels`, and for another number of frames than a person has boxes.
    """
    body = default_body() if body is None else body
    _check(views, vertices, body)
    if tuple(frames.position.shape) != (K, 3):
        raise ValueError(f"the boxes' positions have the shape {tuple(frames.position.shape)}: give one person's {K}")
    local = torch.linspace(-1, 1, S, dtype=vertices.dtype, device=vertices.device)
    t, b, n = (frames.rotation * frames.half_extent[:, None, :]).unbind(-1)
    columns = local[:, None, None] * b[:, None, None] + local[None, :, None] * t[:, None, None]  # k h w 3
    columns = (columns + frames.position[:, None, None]).unflatten(0, (GRID, GRID)).transpose(1, 2)  # ny h nx w 3
    out = n.unflatten(0, (GRID, GRID))[:, None, :, None]
    points = (columns + local[:, None, None, None, None, None] * out).flatten(-3, -2).flatten(1, 2)
    normals = frames.rotation[..., 2].unflatten(0, (GRID, GRID))
    normals = normals.repeat_interleave(S, 0).repeat_interleave(S, 1).expand(S, -1, -1, -1)
    return _look_up(views, vertices, body, points.flatten(1, 2), normals.flatten(1, 2), facing)


@functools.lru_cache(maxsize=4)
def _texels(body: BodyModel) -> tuple[Tensor, Tensor]:
    """Face and barycentric coordinates of SIDE x SIDE texels, -1 outside of the charts."""
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
) -> Unprojected:
    rgba = np.ascontiguousarray(views.rgba.cpu().numpy())
    depth = _body_depth(views, vertices, body)
    world_to_pixel = (views.camera.intrinsics @ views.camera.world_to_camera).cpu().numpy().astype(np.float32)
    origin = views.camera.position.cpu().numpy().astype(np.float32)
    arrays = [
        np.ascontiguousarray(tensor.detach().flatten(0, 1).cpu().numpy().astype(np.float32))
        for tensor in (points, normals)
    ]
    count = len(arrays[0])
    rgb = np.zeros((count, 3), np.uint8)
    seen, covered = np.zeros(count, np.uint8), np.zeros(count, np.uint8)
    _in_parts(count, lambda first, last: _sample(
        arrays[0][first:last], arrays[1][first:last], rgba, depth, world_to_pixel, origin, facing, TOLERANCE,
        rgb[first:last], seen[first:last], covered[first:last]))  # fmt: skip
    layers, shape = len(points), (len(points), SIDE, SIDE)
    picture = torch.from_numpy(rgb).reshape(layers, SIDE, SIDE, 3).movedim(-1, 1).contiguous()
    found = Unprojected(picture, torch.from_numpy(seen).reshape(shape), torch.from_numpy(covered).reshape(shape))
    return found.to(views.rgba.device)


def _check(views: Views, vertices: Tensor, body: BodyModel) -> None:
    """Compiled code reads where these tell it to, so they must agree."""
    shape, camera = tuple(views.rgba.shape), views.camera
    if len(shape) != 4 or not shape[0] or shape[-1] != 4 or views.rgba.dtype != torch.uint8:
        raise ValueError(f"views are {views.rgba.dtype} {shape}: give one person's, uint8 [v, H, W, 4], v > 0")
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
            "give one person's in one pose, of the same body"
        )
    if not torch.isfinite(vertices).all():
        raise ValueError("the posed vertices hold NaN or infinite values; check the pose and the betas they come from")


def _body_depth(views: Views, vertices: Float[Tensor, "V 3"], body: BodyModel) -> Float32[ndarray, "v H W"]:
    """Metres along each view's axis to the body's surface; inf beside it."""
    corners = vertices.detach()[body.faces].cpu().numpy().astype(np.float64)
    camera = views.camera.to("cpu")
    depth = np.empty(views.rgba.shape[:3], np.float32)

    def draw(first: int, last: int) -> None:
        for view in range(first, last):
            depth[view] = nearest_triangles(corners, camera.map(lambda tensor, view=view: tensor[view])).depth

    _in_parts(len(depth), draw)
    return depth


def _in_parts(count: int, work: Callable[[int, int], None]) -> None:
    """`work(first, last)` over all of 0 ... count, on torch's threads; a loader's worker has one."""
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


def stacked(found: Sequence[Unprojected]) -> Unprojected:
    """A batch of several people's."""
    return Unprojected(
        *(torch.stack([getattr(one, field.name) for one in found]) for field in dataclasses.fields(Unprojected))
    )
