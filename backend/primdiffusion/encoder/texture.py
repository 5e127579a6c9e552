"""The released code's input of the appearance branch: a texture of the body, averaged over the views (SPEC 2).

Unlike `unproject`, a view sees a point within 20 mm of the body surface on both sides of it, in a depth image that is
interpolated, and pixels outside of the mask are black and count. Values are not rounded.
"""

from __future__ import annotations

import dataclasses
import functools

import numba
import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.capture.reader import Views
from primdiffusion.encoder.unproject import SIDE, TOLERANCE, Unprojected, body_depth, check
from primdiffusion.geometry.image import to_bytes
from primdiffusion.geometry.surface import surface_points
from primdiffusion.primitives.anchors import default_texels
from primdiffusion.primitives.primitives import K
from primdiffusion.raster.uv_atlas import UvRaster, rasterise_uv

TEXTURE_SIDE = 512
"""Texels per side before resizing to `SIDE`."""
BESIDE = -0.001
"""Depth of pixels beside the body, metres: -1 in the released code's millimetres."""


def erode(views: Views) -> Views:
    """Set pixels to black, and their mask to 0, where the mask is 0 at the pixel or one of its eight neighbours."""
    rgba = views.rgba
    outside = (rgba[..., 3] == 0).float()
    # Pixels beyond the image's border count as inside.
    keep = functional.max_pool2d(outside.flatten(0, -3)[:, None], 3, stride=1, padding=1) == 0
    return dataclasses.replace(views, rgba=rgba * keep.reshape(*outside.shape, 1))


def unproject_texture(views: Views, vertices: Float[Tensor, "V 3"], body: BodyModel | None = None) -> Unprojected:
    """Average the views at 512 x 512 points of the body surface, and resize the texture to 256 x 256; `rgb` is float32.

    `views` show one human in one pose (unbatched), `vertices` (metres) are the body in that pose. All views that see a
    point have the same weight. Texels outside of every chart have the surface point of the nearest covered texel; those
    that no view sees are black.

    Raises:
        ValueError: as `unproject_texels`.
    """
    body = default_body() if body is None else body
    check(views, vertices, body)
    face, barycentric = _texture_points(body)
    points = surface_points(vertices, body.faces, face.flatten(), barycentric.flatten(0, 1))
    rgb, share = sample_both_sides(views, body_depth(views, vertices, body.faces), points)
    picture = torch.cat([rgb.T, share[None]]).unflatten(-1, (TEXTURE_SIDE, TEXTURE_SIDE))
    picture = functional.interpolate(picture[None], size=(SIDE, SIDE), mode="bilinear", align_corners=True)
    seen = to_bytes(picture[:, 3])
    return Unprojected(picture[:, :3], seen, torch.full_like(seen, 255), torch.ones(K, 3)).to(views.rgba.device)


@functools.lru_cache(maxsize=4)
def _texture_points(body: BodyModel) -> tuple[Int[Tensor, "h w"], Float[Tensor, "h w 3"]]:
    """Face and barycentric coordinates of TEXTURE_SIDE x TEXTURE_SIDE texels, none empty.

    The default body's layout has a quarter as many; each counts four times.
    """
    if body is default_body():
        each = TEXTURE_SIDE // SIDE
        face, barycentric = (part.numpy().repeat(each, 0).repeat(each, 1) for part in default_texels())
        raster = UvRaster(face, barycentric)
    elif body.uv.numel() == 0:
        raise ValueError("the body has no UV coordinates: load it with a UV map")
    else:
        raster = rasterise_uv(body.uv[body.uv_faces].double().cpu().numpy(), TEXTURE_SIDE, TEXTURE_SIDE)
    raster = raster.filled()
    return torch.from_numpy(raster.face), torch.from_numpy(raster.barycentric).to(body.template.dtype)


def sample_both_sides(
    views: Views, depth: Float32[np.ndarray, "v H W"], points: Float[Tensor, "n 3"]
) -> tuple[Float32[Tensor, "n 3"], Float32[Tensor, "n"]]:
    """Mean colour (0 ... 255) at points over the views that see them, and the fraction of views that do.

    `depth` is the body surface's depth in each view, inf beside it. Colour and depth are bilinear.
    """
    rgba = np.ascontiguousarray(views.rgba.cpu().numpy())
    world_to_pixel = (views.camera.intrinsics.double() @ views.camera.world_to_camera.double()).cpu().numpy()
    where = np.ascontiguousarray(points.detach().cpu().double().numpy())
    rgb, share = np.zeros((len(where), 3), np.float32), np.zeros(len(where), np.float32)
    _sample(where, rgba, np.where(np.isfinite(depth), depth, np.float32(BESIDE)), world_to_pixel, TOLERANCE, rgb, share)
    return torch.from_numpy(rgb), torch.from_numpy(share)


@numba.njit(cache=True, nogil=True)
def _sample(points, rgba, depth, world_to_pixel, tolerance, rgb, share):
    views, height, width = depth.shape
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        red, green, blue, total = 0.0, 0.0, 0.0, 0
        for view in range(views):
            p = world_to_pixel[view]
            w = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if w <= 1e-3:
                continue
            u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / w
            v = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / w
            if not (u >= 0 and v >= 0 and u < width and v < height):
                continue
            fu, fv = u - 0.5, v - 0.5
            left, top = int(np.floor(fu)), int(np.floor(fv))
            su, sv = fu - left, fv - top
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            left, top = max(left, 0), max(top, 0)
            wa, wb, wc, wd = (1 - su) * (1 - sv), su * (1 - sv), (1 - su) * sv, su * sv
            surface = (
                wa * depth[view, top, left] + wb * depth[view, top, right]
                + wc * depth[view, bottom, left] + wd * depth[view, bottom, right]
            )  # fmt: skip
            if abs(w - surface) > tolerance:
                continue
            a, b = rgba[view, top, left], rgba[view, top, right]
            c, d = rgba[view, bottom, left], rgba[view, bottom, right]
            red += wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0]
            green += wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1]
            blue += wa * a[2] + wb * b[2] + wc * c[2] + wd * d[2]
            total += 1
        if total:
            rgb[i, 0], rgb[i, 1], rgb[i, 2] = red / total, green / total, blue / total
            share[i] = total / views
