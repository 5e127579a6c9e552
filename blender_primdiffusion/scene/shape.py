"""The shape of a human, and how its body at rest, joints, primitives, height and weight follow from it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.arrays import all_finite
from ..formats.body_layout import LARGEST_STRETCH
from .blend_values import as_numbers, stored_numbers
from .human import BETA_COUNT, BETAS, LARGEST_BETA, MARK, provenance_of

_TINY = 1e-12
"""Smallest divisor when normalising, as in the backend."""
SHARE = 0.5
"""Boxes grow by the surface's stretch to this power; the backend's `reshaping.SHARE`."""
SAME_BETAS = 1e-5
"""Betas that differ by less are the same shape."""
DENSITY = 985.0
"""Density of a living body with air in the lungs, kg/m^3."""
MOST_CORRECTIONS = 20
_TOLERANCE = np.array([1e-4, 1e-2])
"""Metres, kilograms."""
DEFAULT_BODY_VERTICES = 12196
"""By this number of vertices the body that comes with the extension is recognised."""
_CLEAR = {0: "Stature", 1: "Shoulders", 3: "Waist", 5: "Girth"}
"""Sliders of betas of the default body with one clear effect; the other betas change several measures a little."""


@dataclasses.dataclass(frozen=True, eq=False)
class Rest:
    """A human at rest; metres, y up, facing +z."""

    vertices: NDArray[np.float64]
    """[V, 3]."""
    joints: NDArray[np.float64]
    """[24, 3]."""
    position: NDArray[np.float64]
    """Centres of the primitives [K, 3]."""
    rotation: NDArray[np.float64]
    """Axes T, B, N of the primitives as columns [K, 3, 3]."""


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeModel:
    """A body as a function of its shape, and the primitives on it; metres, y up, facing +z."""

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
    """The triangle of each primitive [K]."""
    barycentric: NDArray[np.float32]
    """The primitive's place on it [K, 3]; rows sum to one."""
    stencil_vertex: NDArray[np.int32]
    """Vertices that span a primitive's tangent plane [K, m], padded with weight 0."""
    stencil_du: NDArray[np.float32]
    """dP/du = sum over m of stencil_du[k, m] * vertices[stencil_vertex[k, m]], metres per cell of the grid."""
    stencil_dv: NDArray[np.float32]
    """Likewise dP/dv; du x dv points out of the body."""
    skin_weights: NDArray[np.float32]
    """Skinning of the vertices [V, 24]; rows sum to one."""
    rest_half_extent: NDArray[np.float32]
    """Half sides of the boxes along T, B, N before their delta scale [K, 3], metres."""
    uv_corner: NDArray[np.float32]
    """Texture coordinates of each triangle corner [F, 3, 2], v up."""
    pose_basis: NDArray[np.float32] | None = None
    """Pose-dependent correctives (SMPL eq. 9) of the vertices `used` [U, 3, 207]; None for a body without."""

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray]) -> ShapeModel:
        """The model of a file's arrays, in the dtypes above."""
        names = [*FIELDS, *(name for name in OPTIONAL_FIELDS if name in arrays)]
        return cls(**{name: arrays[name].astype(np.int32 if name in INTEGERS else np.float32) for name in names})

    def used(self) -> NDArray[np.int32]:
        """The vertices that determine the primitives' frames [U], ascending."""
        return np.unique(np.concatenate([self.stencil_vertex.ravel(), self.faces[self.face].ravel()]))

    def rest(self, betas: NDArray) -> Rest:
        """The human of these betas [10] at rest (SMPL eqs. 8 and 10; paper sec. 3.1)."""
        vertices = self.surface(betas)
        joints = self.joint_template + self.joint_basis @ np.asarray(betas, np.float64)
        return Rest(vertices, joints, *self.frames(vertices))

    def surface(self, betas: NDArray) -> NDArray[np.float64]:
        """Rest vertices [V, 3] at these betas [10]."""
        return self.template + self.shape_basis @ np.asarray(betas, np.float64)

    def frames(self, vertices: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres [K, 3] and axes [K, 3, 3] of the primitives on a body with vertices [V, 3], posed or not.

        In the axes of the vertices; see `tangent_frames`.
        """
        rotation = tangent_frames(*self._planes(vertices))
        return np.einsum("kc,kcx->kx", self.barycentric, vertices[self.faces[self.face]]), rotation

    def rest_sides(self, betas: NDArray) -> NDArray[np.float64]:
        """Lengths along T and widths along B [K, 2] of the primitives' cells at these betas [10] at rest, metres."""
        return _sides(*self._planes(self.surface(betas)))

    def growth(self, before: NDArray, after: NDArray) -> NDArray[np.float64]:
        """Scale factors [K, 3] of boxes along T, B, N when the betas [10] change from `before` to `after`.

        Twin of the backend's `reshaping.box_growth`; ones where the betas are the same.
        """
        if np.allclose(before, after, rtol=0, atol=SAME_BETAS):
            return np.ones((len(self.face), 3))
        return box_growth(self._planes(self.surface(before)), self._planes(self.surface(after)))

    def _planes(self, vertices: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """dP/du and dP/dv [K, 3] of the cells, metres per cell."""
        support = vertices[self.stencil_vertex]
        return np.matmul(self.stencil_du[:, None], support)[:, 0], np.matmul(self.stencil_dv[:, None], support)[:, 0]


def tangent_frames(du: NDArray, dv: NDArray) -> NDArray[np.float64]:
    """Axes [K, 3, 3] of primitives whose cells have these dP/du and dP/dv [K, 3].

    T = normalize(dP/du), N = normalize(T x dP/dv), B = N x T as columns (SPEC 1.8, 2).
    """
    tangent = _unit(du)
    normal = _unit(np.cross(tangent, dv))
    return np.stack([tangent, np.cross(normal, tangent), normal], -1)


def box_growth(before: tuple[NDArray, NDArray], after: tuple[NDArray, NDArray]) -> NDArray[np.float64]:
    """Scale factors [K, 3] of boxes whose cells' dP/du and dP/dv [K, 3] at rest change so; see `ShapeModel.growth`."""
    stretch = _sides(*after) / np.maximum(_sides(*before), _TINY)
    return np.concatenate([stretch**SHARE, np.ones_like(stretch[:, :1])], -1)


def stretch_of(posed: tuple[NDArray, NDArray], rest: tuple[NDArray, NDArray]) -> NDArray[np.float64]:
    """Scale factors [K, 3] of boxes whose cells have these dP/du and dP/dv [K, 3] in a pose and at rest.

    Twin of the backend's `anchors.stretched`.
    """
    growth = (_sides(*posed) / np.maximum(_sides(*rest), _TINY)).clip(1, LARGEST_STRETCH)
    return np.concatenate([growth, np.ones_like(growth[:, :1])], -1)


def _sides(du: NDArray, dv: NDArray) -> NDArray[np.float64]:
    """Lengths of cells along T and widths along B [K, 2], metres."""
    length = np.linalg.norm(du, axis=-1)
    area = np.linalg.norm(np.cross(du, dv), axis=-1)
    return np.stack([length, area / np.maximum(length, _TINY)], -1)


FIELDS: dict[str, tuple[int | str, ...]] = {
    "template": ("V", 3), "shape_basis": ("V", 3, BETA_COUNT),
    "joint_template": (24, 3), "joint_basis": (24, 3, BETA_COUNT),
    "faces": ("F", 3), "face": ("K",), "barycentric": ("K", 3),
    "stencil_vertex": ("K", "m"), "stencil_du": ("K", "m"), "stencil_dv": ("K", "m"),
    "skin_weights": ("V", 24), "rest_half_extent": ("K", 3), "uv_corner": ("F", 3, 2),
}  # fmt: skip
"""Shapes of a ShapeModel's arrays, which files store under the same names."""
OPTIONAL_FIELDS: dict[str, tuple[int | str, ...]] = {"pose_basis": ("U", 3, 207)}
INTEGERS = ("faces", "face", "stencil_vertex")


def faulty_field(model: ShapeModel) -> str | None:
    """The first field that holds impossible values, if any."""
    for name in (*FIELDS, *OPTIONAL_FIELDS):
        values = getattr(model, name)
        if values is not None and not all_finite(values):
            return name
    limits = {"faces": len(model.template), "face": len(model.faces), "stencil_vertex": len(model.template)}
    for name, limit in limits.items():
        values = getattr(model, name)
        if values.min() < 0 or values.max() >= limit:
            return name
    if model.pose_basis is not None and len(model.pose_basis) != len(model.used()):
        return "pose_basis"
    if model.rest_half_extent.min() <= 0:
        return "rest_half_extent"
    least = {"barycentric": -1e-3, "skin_weights": 0.0}
    rows = {name: getattr(model, name) for name in least}
    wrong = (name for name, w in rows.items() if w.min() < least[name] or np.abs(w.sum(-1) - 1).max() > 1e-3)
    return next(wrong, None)


class BodyMeasures(NamedTuple):
    """Measures of a bare body at rest."""

    height: float
    """Metres."""
    weight: float
    """Kilograms: the volume within the skin times DENSITY."""


def measure(model: ShapeModel, betas: NDArray) -> BodyMeasures:
    """Height and weight at these betas [10]."""
    return _measured(model, tuple(np.asarray(betas, np.float64)))


def betas_of_measures(
    model: ShapeModel, betas: NDArray, height: float | None = None, weight: float | None = None
) -> NDArray[np.float64]:
    """The betas [10] nearest to `betas` at which the body has the given height (m) and weight (kg).

    Newton steps of least length, exact to 0.1 mm and 10 g. Raises ValueError where no body within LARGEST_BETA has
    these measures.
    """
    rows = [row for row, value in enumerate((height, weight)) if value is not None]
    target = np.array([value for value in (height, weight) if value is not None])
    moved = np.array(betas, np.float64)
    for _ in range(MOST_CORRECTIONS if rows else 0):
        missing = target - np.array(measure(model, moved))[rows]
        if (np.abs(missing) < _TOLERANCE[rows]).all():
            break
        slope = _slope(model, moved)[rows]
        moved = moved + slope.T @ np.linalg.solve(slope @ slope.T, missing)
        if not np.abs(moved).max() <= LARGEST_BETA:
            break
    else:
        moved = moved if not rows else moved * np.inf
    if rows and not np.abs(moved).max() <= LARGEST_BETA:
        names = (("a height of {:.2f} m", height), ("a weight of {:.0f} kg", weight))
        measures = " with ".join(text.format(value) for text, value in names if value is not None)
        raise ValueError(f"no body of this model has {measures}: ask for something more usual")
    return moved


def slider_names(model: ShapeModel) -> list[str]:
    """A name for each beta [10]: its effect where that is clear, else its number, from 1."""
    clear = _CLEAR if len(model.template) == DEFAULT_BODY_VERTICES else {}
    return [clear.get(index, str(index + 1)) for index in range(BETA_COUNT)]


@functools.lru_cache(maxsize=64)
def _measured(model: ShapeModel, betas: tuple[float, ...]) -> BodyMeasures:
    vertices = model.surface(np.array(betas))
    upright = vertices[:, 1]
    a, b, c = (vertices[model.faces[:, corner]] for corner in range(3))
    volume = float(np.einsum("fx,fx->", a, np.cross(b, c))) / 6  # signed tetrahedra to the origin
    return BodyMeasures(float(upright.max() - upright.min()), abs(volume) * DENSITY)


def _slope(model: ShapeModel, betas: NDArray) -> NDArray[np.float64]:
    """Derivatives of height and weight by each beta [2, 10]."""
    vertices = model.surface(betas)
    top, sole = np.argmax(vertices[:, 1]), np.argmin(vertices[:, 1])
    a, b, c = (vertices[model.faces[:, corner]] for corner in range(3))
    pull = np.zeros_like(vertices)  # of the volume, times 6, by each vertex
    for corner, cross in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
        for axis in range(3):
            pull[:, axis] += np.bincount(model.faces[:, corner], cross[:, axis], len(vertices))
    sign = np.sign(np.einsum("fx,fx->", a, np.cross(b, c)))
    volume = pull.reshape(-1) @ model.shape_basis.reshape(-1, BETA_COUNT) / 6
    return np.stack([model.shape_basis[top, 1] - model.shape_basis[sole, 1], sign * DENSITY * volume])


def _unit(vectors: NDArray) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY)


def betas_of(person: bpy.types.Object) -> NDArray[np.float64]:
    """The human's shape [10] as the engine draws it now. Raises ValueError where it is not a list of ten numbers."""
    if BETAS not in person:
        return generated_betas(person)
    betas = stored_numbers(person, BETAS, BETA_COUNT)
    if betas is None:
        raise ValueError(
            f"the custom property {BETAS!r} on the armature of {person.name!r} is not a list of {BETA_COUNT} numbers: "
            "delete it"
        )
    return np.array(betas)


def generated_betas(person: bpy.types.Object) -> NDArray[np.float64]:
    """The shape [10] that the human was generated with, or got from its last edit.

    Raises ValueError where the human's provenance is damaged.
    """
    betas = as_numbers(provenance_of(person).get("betas"), BETA_COUNT)
    if betas is None:
        raise ValueError(
            f"the custom property {MARK!r} of {person.name!r} was changed by hand and holds no shape: undo that, "
            "or generate the human again"
        )
    return np.array(betas)


def has_custom_shape(person: bpy.types.Object) -> bool:
    """Whether the shape differs from the one in the human's file: the user has set it."""
    try:
        return not np.allclose(betas_of(person), generated_betas(person), atol=SAME_BETAS)
    except ValueError:
        return True
