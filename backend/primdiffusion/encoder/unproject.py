"""The appearance branch's input: what pictures show at points of a person, averaged over the views that see them.

Paper sec. 3.2 looks up the body's surface, texel by texel of its UV square. Cloth and hair stand centimetres off it, so
that several views of one texel show several things; looking up the voxels of the boxes themselves does without this,
and the masks then say which voxels are outside of the person.
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
"""Texels a side: one for every column of voxels."""


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
    """The pictures at every voxel of the boxes in `frames` (unbatched, at their rest size): S layers, from inside out.

    Layer d, row ny * 8 + h, column nx * 8 + w is voxel (d, h, w) of primitive ny * 32 + nx. Views as in
    `unproject_texels`, by the angle to the box's normal; a voxel in front of the body's surface is seen too.

    Raises:
        ValueError: as `unproject_texels`, and for another number of frames than a person has boxes.
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
    depth = body_depth(views, vertices, body.faces)
    rgb, seen, covered = (
        torch.from_numpy(found).unflatten(0, (len(points), SIDE, SIDE))
        for found in sample(views, depth, points.flatten(0, 1), normals.flatten(0, 1), facing)
    )
    return Unprojected(rgb.movedim(-1, 1).contiguous(), seen, covered).to(views.rgba.device)
