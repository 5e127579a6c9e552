"""Points and tangent planes on triangle meshes, as linear functions of the vertices."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

DEGENERATE_UV_AREA = 1e-12
"""Twice the area, in units of the whole UV square, below which a UV triangle has no usable gradient."""


def surface_points(
    vertices: Float[Tensor, "*b v c"],
    faces: Int[Tensor, "f 3"],
    face: Int[Tensor, "k"],
    barycentric: Float[Tensor, "k 3"],
) -> Float[Tensor, "*b k c"]:
    """Interpolate vertex positions (or other vertex attributes) at barycentric coordinates on faces; differentiable."""
    corners = vertices.index_select(-2, faces[face].flatten()).unflatten(-2, (-1, 3))
    return (corners * barycentric[..., None]).sum(-2)


def face_cross(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "*b f 3"]:
    """Face normals by the right-hand rule, scaled to twice the face area."""
    a, b, c = vertices[..., faces, :].unbind(-2)
    return torch.linalg.cross(b - a, c - a)


def vertex_normals(vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "*b v 3"]:
    """Area-weighted unit normals; the zero vector at a vertex that no face uses."""
    cross = face_cross(vertices, faces)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total = total.index_add(-2, faces[:, corner], cross)
    return torch.nn.functional.normalize(total, dim=-1)


def uv_gradient(
    uv: Float[Tensor, "t 2"], uv_faces: Int[Tensor, "f 3"]
) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
    """Weights of each face's three corners whose sums are dP/du and dP/dv of the face, metres per unit of UV.

    P is linear over a face, so with D = (u1-u0)(v2-v0) - (u2-u0)(v1-v0),
    dP/du = [(v1-v2) P0 + (v2-v0) P1 + (v0-v1) P2] / D and dP/dv = [(u2-u1) P0 + (u0-u2) P1 + (u1-u0) P2] / D.
    dv is signed so that du x dv points along the face normal: on mirrored charts (D < 0) it is negated. A face without
    area in UV space gets its edges, du = P1 - P0 and dv = P2 - P0: the correct plane, with an arbitrary direction.
    """
    (u0, v0), (u1, v1), (u2, v2) = (corner.unbind(-1) for corner in uv[uv_faces].unbind(-2))
    determinant = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    usable = (determinant.abs() > DEGENERATE_UV_AREA)[:, None]
    divisor = torch.where(usable, determinant[:, None], torch.ones_like(determinant)[:, None])
    du = torch.stack([v1 - v2, v2 - v0, v0 - v1], -1) / divisor
    dv = torch.stack([u2 - u1, u0 - u2, u1 - u0], -1) / divisor.abs()
    return (
        torch.where(usable, du, du.new_tensor([-1.0, 1.0, 0.0])),
        torch.where(usable, dv, dv.new_tensor([-1.0, 0.0, 1.0])),
    )


def signed_volume(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, ""]:
    """Volume enclosed by the faces, m^3, as signed tetrahedra to the centroid; negative if normals point inward."""
    a, b, c = (vertices - vertices.mean(0))[faces].unbind(-2)
    return (a * torch.linalg.cross(b, c)).sum() / 6
