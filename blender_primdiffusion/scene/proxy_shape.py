"""Mesh proxies on other bodies: each vertex goes where the body's surface next to it goes, so clothes stay as far off
the skin. The betas that a proxy shows are kept with it, and only the difference is added: what was sculpted stays.
"""

from __future__ import annotations

import functools
import hashlib

import bpy
import numpy as np
from mathutils.kdtree import KDTree
from numpy.typing import NDArray

from .convention import points_to_blender
from .exported_proxy import show_betas, shown_betas
from .shape import own_data, shape_model_of
from .shape_model import SAME_BETAS, ShapeModel

NEIGHBOURS = 12
"""Vertices of the body that one of the proxy follows."""
REACH = 0.02
"""Metres farther than the nearest at which another one's say has fallen to a third: seams of folds are not followed."""
_KEPT = 4


class _Bound:
    """A mesh as it was met first, known by its faces: which vertices of the body it follows is not found twice."""

    def __init__(self, mesh: bpy.types.Mesh, shown: NDArray) -> None:
        corners = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", corners)
        self.digest = hashlib.sha256(corners.tobytes()).hexdigest()
        self.vertices, self.shown = _vertices(mesh), shown

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Bound) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def follow_shape(collection: bpy.types.Collection, proxy: bpy.types.Object | None, betas: NDArray) -> None:
    """Move a person's proxy, if there is one, to the body of these betas [10]; at rest, no pose is touched.

    Some tenths of a second for a mesh that was not met before, a few milliseconds afterwards. One that has shape keys,
    is in Edit Mode or linked from another file stays as it is, and is said to be outdated. Raises as `shape_model_of`.
    """
    shown = None if proxy is None else shown_betas(proxy)
    if proxy is None or shown is None or not _is_free(proxy):
        return
    change = np.asarray(betas, np.float64) - shown
    if np.abs(change).max() <= SAME_BETAS:
        return
    model, mesh = shape_model_of(collection), own_data(proxy, collection)
    moved = _vertices(mesh) + _basis(_Bound(mesh, shown), model) @ change
    mesh.vertices.foreach_set("co", moved.astype(np.float32).ravel())
    mesh.update()
    show_betas(proxy, betas)


def _is_free(proxy: bpy.types.Object) -> bool:
    mesh = proxy.data
    return mesh.shape_keys is None and mesh.library is None and proxy.library is None and not mesh.is_editmode


@functools.lru_cache(maxsize=_KEPT)
def _basis(bound: _Bound, model: ShapeModel) -> NDArray[np.float64]:
    """What a unit of each shape coefficient adds to the mesh's vertices [V, 3, 10], z up."""
    body = points_to_blender(model.surface(bound.shown))
    tree = KDTree(len(body))
    for index, point in enumerate(body):
        tree.insert(point, index)
    tree.balance()
    found = [tree.find_n(point, NEIGHBOURS) for point in bound.vertices]
    index = np.array([[one[1] for one in near] for near in found])
    distance = np.array([[one[2] for one in near] for near in found])
    weight = np.exp(-(((distance - distance[:, :1]) / REACH) ** 2))
    weight /= weight.sum(1, keepdims=True)
    basis = points_to_blender(np.moveaxis(model.shape_basis, -1, 0)).transpose(1, 2, 0)
    return np.einsum("vn,vnxb->vxb", weight, basis[index])


def _vertices(mesh: bpy.types.Mesh) -> NDArray[np.float64]:
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3).astype(np.float64)
