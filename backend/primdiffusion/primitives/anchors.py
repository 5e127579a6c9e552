"""Anchors: the points of the 32 x 32 UV grid on the body surface, and their frames on a posed body.

Paper sec. 3.1: primitive k is attached to the surface point under UV grid point k; its frame follows the surface's
tangent plane there. An anchor expresses both as weighted sums of mesh vertices, so `attach` is one gather for any pose.
"""

from __future__ import annotations

import dataclasses
import functools
from importlib import resources
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.formats import body_layout
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.geometry.surface import signed_volume, surface_points, uv_gradient
from primdiffusion.primitives.primitives import GRID, Frames, K, S
from primdiffusion.raster.uv_atlas import closest_in_uv, rasterise_uv

CHARTS = body_layout.CHARTS
"""Regions of the body; `Anchors.chart` holds indices into this tuple."""
JOINT_REGION = (
    "torso", "left_leg", "right_leg", "torso", "left_leg", "right_leg", "torso", "left_foot", "right_foot",
    "torso", "left_foot", "right_foot", "head", "torso", "torso", "head", "left_arm",
    "right_arm", "left_arm", "right_arm", "left_hand", "right_hand", "left_hand", "right_hand",
)  # fmt: skip
"""Region of each of SMPL's 24 joints, in their order."""
RELEASED_NEIGHBOURS = 23
RELEASED_DISTANCE_LIMITS = (0.005, 0.050)
"""Metres; SPEC 2."""


@dataclasses.dataclass(frozen=True)
class Anchors(TensorRecord):
    """Places of the primitives on a mesh, independent of pose (paper sec. 3.1)."""

    face: Int[Tensor, "k"]
    barycentric: Float[Tensor, "k 3"]
    rest_half_extent: Float[Tensor, "k 3"]
    """Metres along T, B, N, before multiplication by delta_scale."""
    stencil_vertex: Int[Tensor, "k m"]
    """Vertices that determine a cell's tangent plane, padded with weight 0."""
    stencil_du: Float[Tensor, "k m"]
    """dP/du = sum over m of stencil_du[k, m] * vertices[stencil_vertex[k, m]], metres per cell of the grid."""
    stencil_dv: Float[Tensor, "k m"]
    """The same for dP/dv; signed so that du x dv points out of the body."""
    chart: Int[Tensor, "k"]
    """Index into CHARTS."""


def attach(anchors: Anchors, vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Frames:
    """Frames on a posed mesh: T = normalize(dP/du), N = normalize(dP/du x dP/dv), B = N x T (SPEC 1.8, 2).

    `faces` are those of the body. Differentiable in `vertices`. Raises ValueError if vertices are NaN or infinite.
    """
    if not torch.isfinite(vertices).all():
        raise ValueError("the posed vertices hold NaN or infinite values: check the pose and the betas")
    du, dv = tangent_plane(anchors, vertices)
    tangent = torch.nn.functional.normalize(du, dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(tangent, dv), dim=-1)
    bitangent = torch.linalg.cross(normal, tangent)
    position = surface_points(vertices, faces, anchors.face, anchors.barycentric)
    half_extent = anchors.rest_half_extent.expand(*position.shape)
    return Frames(position, torch.stack([tangent, bitangent, normal], -1), half_extent)


def stretch(frames: Frames, anchors: Anchors, posed: Float[Tensor, "*b v 3"], rest: Float[Tensor, "*b v 3"]) -> Frames:
    """Frames whose boxes grow in their plane where the posed skin is stretched compared with `rest`.

    The paper computes sizes once; then boxes come apart where a pose stretches the skin, at the groin of a raised leg.
    """
    tiny = torch.finfo(posed.dtype).tiny
    growth = cell_sides(anchors, posed) / cell_sides(anchors, rest).clamp_min(tiny)
    growth = torch.cat([growth.clamp(1, body_layout.LARGEST_STRETCH), torch.ones_like(growth[..., :1])], -1)
    return dataclasses.replace(frames, half_extent=frames.half_extent * growth)


def cell_sides(anchors: Anchors, vertices: Float[Tensor, "*b v 3"]) -> Float[Tensor, "*b k 2"]:
    """Side lengths of the UV grid's cells along T and B = N x T, metres."""
    du, dv = tangent_plane(anchors, vertices)
    length = du.norm(dim=-1)
    area = torch.linalg.cross(du, dv).norm(dim=-1)
    return torch.stack([length, area / length.clamp_min(torch.finfo(length.dtype).tiny)], -1)


def tangent_plane(
    anchors: Anchors, vertices: Float[Tensor, "*b v 3"]
) -> tuple[Float[Tensor, "*b k 3"], Float[Tensor, "*b k 3"]]:
    """dP/du and dP/dv of every cell, metres per cell."""
    # index_select and a batched product: indexing with [..., index, :] is thirty times slower on the CPU.
    support = vertices.index_select(-2, anchors.stencil_vertex.flatten()).unflatten(-2, anchors.stencil_vertex.shape)
    du, dv = (torch.stack([anchors.stencil_du, anchors.stencil_dv], -2) @ support).unbind(-2)
    return du, dv


def anchor_skin_weights(anchors: Anchors, body: BodyModel) -> Float[Tensor, "k j"]:
    """Skinning weights interpolated at the anchors; rows sum to 1."""
    return surface_points(body.skin_weights, body.faces, anchors.face, anchors.barycentric)


@functools.lru_cache(maxsize=1)
def default_anchors() -> Anchors:
    """The anchors of the default body, from the layout in body/data/layout.npz (made by scripts/bake_layout)."""
    layout = _layout()
    body = default_body()
    # float64, because the weights of a tangent plane must cancel: otherwise frames would depend on the body's position.
    return footprint_anchors(
        body.template.double(),
        body.faces,
        layout["cell_face"],
        layout["cell_barycentric"],
        layout["cell_chart"],
        layout["texel_face"],
        layout["texel_barycentric"],
    ).to(dtype=torch.float32)


@functools.lru_cache(maxsize=1)
def default_texels() -> tuple[Int[Tensor, "h w"], Float[Tensor, "h w 3"]]:
    """Face and barycentric coordinates of every texel of the default body's layout, 8 x 8 texels per primitive."""
    layout = _layout()
    return layout["texel_face"], layout["texel_barycentric"].float()


def _layout() -> dict[str, Tensor]:
    with resources.as_file(resources.files("primdiffusion.body") / "data/layout.npz") as path:
        return {name: torch.from_numpy(values) for name, values in body_layout.read_layout(path).items()}


def footprint_anchors(
    template: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    cell_face: Int[Tensor, "k"],
    cell_barycentric: Float[Tensor, "k 3"],
    chart: Int[Tensor, "k"],
    texel_face: Int[Tensor, "h w"],
    texel_barycentric: Float[Tensor, "h w 3"],
) -> Anchors:
    """Anchors whose tangent planes are averaged over the cell instead of taken from the face under its centre.

    dP/du of a cell is the mean of its last column of texels minus the mean of its first, scaled to the cell's width;
    dP/dv likewise along rows. A single face of a 4 cm cell may be part of a nostril, so its plane is unreliable.
    """
    found = body_layout.stencils(faces.numpy(), texel_face.numpy(), texel_barycentric.numpy())
    vertex, du, dv = map(torch.from_numpy, found)
    anchors = Anchors(
        face=cell_face,
        barycentric=cell_barycentric,
        rest_half_extent=torch.zeros(len(cell_face), 3, dtype=template.dtype),
        stencil_vertex=vertex,
        stencil_du=du,
        stencil_dv=dv,
        chart=chart,
    )
    return dataclasses.replace(anchors, rest_half_extent=paper_half_extent(anchors, template))


def paper_half_extent(anchors: Anchors, template: Float[Tensor, "v 3"]) -> Float[Tensor, "k 3"]:
    """Half extents per axis, metres: in-plane from the UV gradient (paper sec. 3.1), along the normal by region."""
    du, dv = (edge.cpu().numpy() for edge in tangent_plane(anchors, template))
    return torch.from_numpy(body_layout.half_extents(du, dv, anchors.chart.cpu().numpy())).to(template)


def released_half_extent(position: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """Isotropic half extents of the released code: 2/3 of the mean distance to the 23 nearest, clipped to 5-50 mm."""
    # The faster mode of cdist uses matrix products, whose rounding puts coincident points a millimetre apart.
    every = torch.cdist(position, position, compute_mode="donot_use_mm_for_euclid_dist")
    distance = every.sort(-1).values[:, 1 : RELEASED_NEIGHBOURS + 1].mean(-1)
    return (distance.clamp(*RELEASED_DISTANCE_LIMITS) * (2 / 3))[:, None].expand(-1, 3).contiguous()


def build_anchors(body: BodyModel, rule: Literal["paper", "released"] = "paper") -> Anchors:
    """Anchors for any body with UV coordinates; grid points are texels 4, 12, 20, ... of a 256 x 256 raster (SPEC 2).

    "paper": a grid point outside every chart maps to the closest chart point; sizes follow the UV gradient per axis.
    "released": such points all map to the body's last face, at the barycentric coordinates of the nearest texel that a
    chart covers (SPEC 1.2), and sizes are isotropic; required by released checkpoints. Tangent planes are those of the
    face under the grid point.

    Raises:
        ValueError: the body has no UV map, its template is not finite, or the rule is unknown.
    """
    if rule not in ("paper", "released"):
        raise ValueError(f"unknown anchor rule {rule!r}: choose 'paper' or 'released'")
    if body.uv.numel() == 0:
        raise ValueError("the body has no UV coordinates: load it with a UV map (vt and ft arrays, or an OBJ file)")
    if not torch.isfinite(body.template).all():
        raise ValueError("the body's template holds NaN or infinite values: load the body file again")
    corner_uv = body.uv[body.uv_faces].double().cpu().numpy()
    raster = rasterise_uv(corner_uv, GRID * S, GRID * S)
    points = raster.every(S, S // 2)
    face, barycentric = points.face.reshape(K).copy(), points.barycentric.reshape(K, 3).copy()
    outside = np.flatnonzero(face < 0)
    if rule == "released" and raster.covered.any():
        face[outside] = len(body.faces) - 1
        barycentric[outside] = raster.filled().every(S, S // 2).barycentric.reshape(K, 3)[outside]
    elif len(outside):
        row, column = np.divmod(outside, GRID)
        points = (np.stack([column, row], -1) * S + S // 2 + 0.5) / (GRID * S)
        face[outside], barycentric[outside] = closest_in_uv(corner_uv, body.uv_faces.cpu().numpy(), points)
    return _face_anchors(body, torch.from_numpy(face), torch.from_numpy(barycentric), rule)


def grid_points_outside(body: BodyModel) -> int:
    """Number of the K grid points that lie outside of every UV chart."""
    corner_uv = body.uv[body.uv_faces].double().cpu().numpy()
    return int((~rasterise_uv(corner_uv, GRID * S, GRID * S).every(S, S // 2).covered).sum())


def _face_anchors(body: BodyModel, face: Tensor, barycentric: Tensor, rule: str) -> Anchors:
    """Anchors with the tangent planes of the faces under the grid points."""
    device, dtype = body.template.device, body.template.dtype
    face, barycentric = face.to(device), barycentric.to(device, dtype)
    du, dv = uv_gradient(body.uv.double(), body.uv_faces)
    outward = 1.0 if signed_volume(body.template, body.faces) >= 0 else -1.0
    anchors = Anchors(
        face=face,
        barycentric=barycentric,
        rest_half_extent=torch.zeros_like(barycentric),
        stencil_vertex=body.faces[face],
        stencil_du=(du[face] / GRID).to(dtype),
        stencil_dv=(dv[face] / GRID * outward).to(dtype),
        chart=region_charts(body)[body.faces[face][:, 0]],
    )
    if rule == "released":
        position = surface_points(body.template, body.faces, face, barycentric)
        return dataclasses.replace(anchors, rest_half_extent=released_half_extent(position))
    return dataclasses.replace(anchors, rest_half_extent=paper_half_extent(anchors, body.template))


def region_charts(body: BodyModel) -> Int[Tensor, "v"]:
    """The region of each vertex, as an index into CHARTS, from the joint with the largest skinning weight."""
    return torch.tensor([CHARTS.index(region) for region in JOINT_REGION], device=body.template.device)[
        body.skin_weights.argmax(-1)
    ]
