"""Input of the appearance branch: image colours at points of a human, averaged over the views that see them.

The paper (sec. 3.2) samples the body surface at every texel of its UV square. Cloth and hair are centimetres off the
surface, so different views of one texel show different points. Sampling at the voxels of the boxes avoids this, and
the masks then tell which voxels are outside of the human.
"""

from __future__ import annotations

import dataclasses
import functools

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.capture.dataset import Views
from primdiffusion.encoder.sampling import body_depth, check, sample
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.surface import surface_points, vertex_normals
from primdiffusion.geometry.uv_atlas import UvRaster, rasterise_uv
from primdiffusion.primitives.anchors import default_texels
from primdiffusion.primitives.primitives import GRID, Frames, K, S

SIDE = GRID * S
"""Texels per side: one per column of voxels."""


@dataclasses.dataclass(frozen=True)
class Unprojected(TensorRecord):
    """Image samples at points arranged as an image of SIDE x SIDE with `d` layers."""

    rgb: UInt8[Tensor, "*b d 3 h w"]
    """sRGB-encoded mean over the views; 0 if no view sees the point."""
    seen: UInt8[Tensor, "*b d h w"]
    """255 times the fraction of the views' weight that sees the point."""
    covered: UInt8[Tensor, "*b d h w"]
    """Least mask value at the point, of 255: below 128, some view sees past it. 255 if it is outside all images."""


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
    return _look_up(views, vertices, body, points[None], normals[None], facing)


def unproject_voxels(
    views: Views, vertices: Float[Tensor, "V 3"], frames: Frames, facing: int, body: BodyModel | None = None
) -> Unprojected:
    """Sample the images at every voxel of the boxes in `frames` (unbatched, at rest size): S layers, from inside out.

    Layer d, row ny * 8 + h, column nx * 8 + w is voxel (d, h, w) of primitive ny * 32 + nx. Views are
    weighted as in `unproject_texels`, by the box's normal; a voxel in front of the body surface is visible too.

    Raises:
        ValueError: as `unproject_texels`, and if the number of frames is not K.
    """
    body = default_body() if body is None else body
    check(views, vertices, body)
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
) -> Unprojected:
    depth = body_depth(views, vertices, body.faces)
    rgb, seen, covered = (
        torch.from_numpy(found).unflatten(0, (len(points), SIDE, SIDE))
        for found in sample(views, depth, points.flatten(0, 1), normals.flatten(0, 1), facing)
    )
    return Unprojected(rgb.movedim(-1, 1).contiguous(), seen, covered).to(views.rgba.device)
