"""Where a posed human's boxes are, computed in Blender: the twin of the backend's `place_skinned`. numpy only."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES, PARENTS
from ..scene.human_file import HumanPayload, read_sizes, session_body
from ..scene.shape import SAME_BETAS, ShapeModel, box_growth, stretch_of, tangent_frames
from .picture import PosedHuman
from .view import PinholeView

JOINTS = len(JOINT_NAMES)
SMALLEST_SCALE = 1e-6
"""The backend's `human.SMALLEST_SCALE`."""
EDGE_PX = 8.0
"""Around what shows boxes: pictures with fewer pixels are drawn smoothly."""
SHAPES_CACHED = 32
"""On one body; 1.2 MB each."""


@dataclasses.dataclass(frozen=True, eq=False)
class Boxes:
    """The boxes of a posed human; metres, the backend's axes (y up)."""

    position: NDArray[np.float64]
    """Centres [K, 3]."""
    rotation: NDArray[np.float64]
    """Local to world [K, 3, 3]; columns T, B, N."""
    half_extent: NDArray[np.float64]
    """Half sides along T, B, N with the delta scale [K, 3]."""
    density_scale: float = 1.0
    """Factor on the payload's density: a larger object is thinner, so that its opacity does not depend on size."""


class BoxRig:
    """Places the boxes of a body without its surface.

    A box's centre, dP/du and dP/dv are weighted sums of vertices, and a skinned vertex is a weighted sum of the joints'
    transforms of its rest position. So each of the three is sum_j M_j h_j for fixed vectors h_j [4] of the rest body:
    one matrix product places all boxes.
    """

    def __init__(self, model: ShapeModel) -> None:
        self._model, used = model, model.used()
        self._template, self._basis = model.template[used].astype(np.float64), model.shape_basis[used]
        corners = (model.faces[model.face], model.barycentric)
        sums = (corners, (model.stencil_vertex, model.stencil_du), (model.stencil_vertex, model.stencil_dv))
        skin = model.skin_weights[used]
        self._sums = [_terms(np.searchsorted(used, vertex), weight, skin) for vertex, weight in sums]
        self._at_rest = functools.lru_cache(SHAPES_CACHED)(self._rest)
        self._growth = functools.lru_cache(SHAPES_CACHED)(self._grown)

    def place(self, human: PosedHuman, payload: HumanPayload) -> Boxes:
        """The boxes of `human`, whose file holds `payload`.

        Raises ValueError for a payload on another body, and for an object or joint scaled to zero.
        """
        own = payload.betas.astype(np.float64)
        betas = own if human.betas is None else np.array(human.betas, np.float64)
        extent = self._model.rest_half_extent if payload.rest_half_extent is None else payload.rest_half_extent
        if len(extent) != len(payload.delta_scale) or len(extent) != len(self._model.face):
            raise ValueError(f"the body's file does not fit {human.file.name!r}: generate the human again")
        flat = np.abs(np.linalg.det(human.joints[:, :, :3])) < SMALLEST_SCALE**3
        if flat.any():
            name = JOINT_NAMES[int(flat.argmax())]
            raise ValueError(f"the bone of joint {name!r} is scaled to zero: give it a nonzero scale")
        linear = human.object_to_world[:, :3]
        determinant = float(np.linalg.det(linear))
        scale = float(np.cbrt(abs(determinant)))
        if not scale > SMALLEST_SCALE:
            raise ValueError(f"the object's mean scale is {scale:.3g}: give it a nonzero scale along every axis")
        centre, du, dv = self._blend(self._posed(betas, human.joints), linear @ human.joints)
        stretch = 1.0
        if payload.rest_half_extent is None:  # the released code's boxes, on other bodies, do not follow the skin
            stretch = stretch_of((du / scale, dv / scale), self._at_rest(tuple(betas))[1])
        rotation = tangent_frames(du, dv)
        rotation[..., 2] *= np.sign(determinant)  # mirrored frames, not frames on a mirrored body
        return Boxes(
            position=centre + human.object_to_world[:, 3],
            rotation=rotation,
            half_extent=extent * payload.delta_scale * self._growth(tuple(own), tuple(betas)) * stretch * scale,
            density_scale=1 / scale,
        )

    def _grown(self, before: tuple[float, ...], after: tuple[float, ...]) -> NDArray[np.float64]:
        if np.allclose(before, after, rtol=0, atol=SAME_BETAS):
            return np.ones((1, 3))
        return box_growth(self._at_rest(before)[1], self._at_rest(after)[1])

    def _rest(self, betas: tuple[float, ...]) -> tuple[NDArray[np.float32], tuple[NDArray, NDArray]]:
        """The vectors h_j of the rest body [3 K, 24 x 4], and its dP/du and dP/dv [K, 3]."""
        vectors = self._vectors(self._template + self._basis @ np.array(betas))
        _, du, dv = self._blend(vectors, np.broadcast_to(np.eye(3, 4), (JOINTS, 3, 4)))
        return vectors, (du, dv)

    def _posed(self, betas: NDArray, joints: NDArray) -> NDArray[np.float32]:
        """The vectors h_j, with the pose-dependent correctives of SMPL eq. 9 where the body has them."""
        if self._model.pose_basis is None:
            return self._at_rest(tuple(betas))[0]
        world, _ = polar(joints[:, :, :3])
        relative = np.swapaxes(world[list(PARENTS[1:])], -1, -2) @ world[1:]
        offsets = self._model.pose_basis @ (relative - np.eye(3)).ravel()
        return self._vectors(self._template + self._basis @ betas + offsets)

    def _vectors(self, vertices: NDArray) -> NDArray[np.float32]:
        count = len(self._model.face) * JOINTS
        points = np.concatenate([vertices, np.ones((len(vertices), 1))], 1)
        found = [
            np.bincount(pair, weight * points[vertex, axis], count)
            for pair, vertex, weight in self._sums
            for axis in range(4)
        ]
        vectors = np.array(found, np.float32).reshape(3, 4, -1, JOINTS).transpose(0, 2, 3, 1)
        return vectors.reshape(-1, JOINTS * 4)

    def _blend(self, vectors: NDArray[np.float32], matrices: NDArray) -> NDArray[np.float64]:
        """Centres, dP/du and dP/dv [3, K, 3]."""
        blended = vectors @ matrices.transpose(0, 2, 1).reshape(JOINTS * 4, 3).astype(np.float32)
        return blended.astype(np.float64).reshape(3, -1, 3)


def boxes_of(human: PosedHuman) -> Boxes:
    """The boxes of a human in the scene.

    Raises FileNotFoundError or ValueError for a file of the human or its body that is missing or damaged, and as
    `BoxRig.place`.
    """
    return _rig(session_body(human.file)).place(human, read_sizes(human.file))


_rig = functools.lru_cache(maxsize=4)(BoxRig)


def seen_part(humans: Iterable[Boxes], view: PinholeView) -> tuple[float, float, float, float]:
    """Left, bottom, right and top of the part of a view that may show these boxes, as fractions of it."""
    size = np.array([view.width, view.height])
    focal, middle = np.diag(view.intrinsics)[:2], view.intrinsics[:2, 2]
    low, high = size.astype(np.float64), np.zeros(2)
    for boxes in humans:
        centre = boxes.position @ view.world_to_camera[:, :3].T + view.world_to_camera[:, 3]
        radius = np.linalg.norm(boxes.half_extent, axis=1)[:, None]
        near, far = centre[:, 2:] - radius, centre[:, 2:] + radius
        if (near <= 0).any():
            return 0.0, 0.0, 1.0, 1.0
        first, last = centre[:, :2] - radius, centre[:, :2] + radius
        low = np.minimum(low, (first / np.where(first < 0, near, far) * focal + middle).min(0) - EDGE_PX)
        high = np.maximum(high, (last / np.where(last > 0, near, far) * focal + middle).max(0) + EDGE_PX)
    (left, top), (right, below) = np.clip(low / size, 0, 1), np.clip(high / size, 0, 1)
    return float(left), float(1 - below), float(max(left, right)), float(max(1 - top, 1 - below))


def polar(matrix: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Q and P [..., 3, 3] of matrix = Q P: Q the nearest orthogonal matrix, P symmetric with det P = |det matrix|."""
    left, scales, right = np.linalg.svd(matrix)
    return left @ right, np.swapaxes(right, -1, -2) @ (scales[..., None] * right)


def _terms(vertex: NDArray, weight: NDArray, skin: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """The nonzero terms of sum_m weight[k, m] * skin[vertex[k, m], j]: k * 24 + j, the vertex, and the product."""
    k, m = np.nonzero(weight)
    term, joint = np.nonzero(skin[vertex[k, m]])
    k, m = k[term], m[term]
    vertices = vertex[k, m]
    return k * JOINTS + joint, vertices, weight[k, m].astype(np.float64) * skin[vertices, joint]
