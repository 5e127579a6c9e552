"""How a body at rest, its joints and the primitives on it follow its shape; the backend's `body` and `anchors` are the
twins."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .shape_names import BETAS

_TINY = 1e-12
"""What the backend divides by at least when it normalises."""

SHARE = 0.5
"""Exponent of the surface's stretch by which boxes grow; the backend's `reshaping.SHARE`."""
SAME_BETAS = 1e-5
"""Betas that differ by less are the same body."""


@dataclasses.dataclass(frozen=True, eq=False)
class Rest:
    """A person at rest; metres, y up, facing +z."""

    vertices: NDArray[np.float64]
    """[V, 3]."""
    joints: NDArray[np.float64]
    """[24, 3]."""
    position: NDArray[np.float64]
    """Centres of the primitives [K, 3]."""
    rotation: NDArray[np.float64]
    """Their axes T, B, N as columns [K, 3, 3]."""


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeModel:
    """A body before it has a shape, and where the primitives sit on it; metres, y up, facing +z."""

    template: NDArray[np.float32]
    """The mean body at rest [V, 3]."""
    shape_basis: NDArray[np.float32]
    """What a unit of each shape coefficient adds [V, 3, 10]."""
    joint_template: NDArray[np.float32]
    """The mean body's joints [24, 3]."""
    joint_basis: NDArray[np.float32]
    """What a unit of each shape coefficient adds to them [24, 3, 10]."""
    faces: NDArray[np.int32]
    """Triangles [F, 3], counter-clockwise seen from outside."""
    face: NDArray[np.int32]
    """The triangle that each primitive sits on [K]."""
    barycentric: NDArray[np.float32]
    """Where on it [K, 3]; rows sum to one."""
    stencil_vertex: NDArray[np.int32]
    """Vertices that span a primitive's tangent plane [K, m], padded with weight 0."""
    stencil_du: NDArray[np.float32]
    """dP/du = sum over m of stencil_du[k, m] * vertices[stencil_vertex[k, m]], metres per cell of the grid."""
    stencil_dv: NDArray[np.float32]
    """Likewise dP/dv; du x dv points out of the body."""

    def rest(self, betas: NDArray) -> Rest:
        """The person of these betas [10] at rest (SMPL eqs. 8 and 10; paper sec. 3.1)."""
        vertices = self.surface(betas)
        joints = self.joint_template + self.joint_basis @ np.asarray(betas, np.float64)
        return Rest(vertices, joints, *self.frames(vertices))

    def surface(self, betas: NDArray) -> NDArray[np.float64]:
        """Vertices [V, 3] of the person of these betas [10] at rest."""
        return self.template + self.shape_basis @ np.asarray(betas, np.float64)

    def frames(self, vertices: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres [K, 3] and axes [K, 3, 3] of the primitives on the body as its vertices [V, 3] lie, posed or not.

        T = normalize(dP/du), N = normalize(T x dP/dv), B = N x T (SPEC 1.8, 2), in whatever axes the vertices are.
        """
        du, dv = self._planes(vertices)
        tangent = _unit(du)
        normal = _unit(np.cross(tangent, dv))
        rotation = np.stack([tangent, np.cross(normal, tangent), normal], -1)
        return np.einsum("kc,kcx->kx", self.barycentric, vertices[self.faces[self.face]]), rotation

    def growth(self, before: NDArray, after: NDArray) -> NDArray[np.float64]:
        """Factors [K, 3] on boxes along T, B, N when the person of these betas [10] gets others: see the backend's
        `reshaping.box_growth`. Ones where the betas are the same."""
        if np.allclose(before, after, rtol=0, atol=SAME_BETAS):
            return np.ones((len(self.face), 3))
        stretch = self._sides(after) / np.maximum(self._sides(before), _TINY)
        return np.concatenate([stretch**SHARE, np.ones_like(stretch[:, :1])], -1)

    def _sides(self, betas: NDArray) -> NDArray[np.float64]:
        """How long cells are along T, and how wide along B, at rest [K, 2], metres."""
        du, dv = self._planes(self.surface(betas))
        length = np.linalg.norm(du, axis=-1)
        area = np.linalg.norm(np.cross(du, dv), axis=-1)
        return np.stack([length, area / np.maximum(length, _TINY)], -1)

    def _planes(self, vertices: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """dP/du and dP/dv [K, 3] of the cells, metres per cell."""
        support = vertices[self.stencil_vertex]
        return np.matmul(self.stencil_du[:, None], support)[:, 0], np.matmul(self.stencil_dv[:, None], support)[:, 0]


FIELDS: dict[str, tuple[int | str, ...]] = {
    "template": ("V", 3), "shape_basis": ("V", 3, BETAS), "joint_template": (24, 3), "joint_basis": (24, 3, BETAS),
    "faces": ("F", 3), "face": ("K",), "barycentric": ("K", 3),
    "stencil_vertex": ("K", "m"), "stencil_du": ("K", "m"), "stencil_dv": ("K", "m"),
}  # fmt: skip
"""Shapes of the arrays of a ShapeModel, as files hold them under the same names."""
INTEGERS = ("faces", "face", "stencil_vertex")


def faulty_field(model: ShapeModel) -> str | None:
    """The first field that holds impossible values, None when all is well."""
    for name in FIELDS:
        if not np.isfinite(getattr(model, name)).all():
            return name
    limits = {"faces": len(model.template), "face": len(model.faces), "stencil_vertex": len(model.template)}
    for name, limit in limits.items():
        values = getattr(model, name)
        if values.min() < 0 or values.max() >= limit:
            return name
    weights = model.barycentric
    return "barycentric" if weights.min() < -1e-3 or np.abs(weights.sum(-1) - 1).max() > 1e-3 else None


def _unit(vectors: NDArray) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY)
