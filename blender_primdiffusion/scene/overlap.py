"""How many volumes cover one point: Cycles evaluates at most 31 of them and silently drops the others."""

from __future__ import annotations

import json

import bpy
import numpy as np
from numpy.typing import NDArray

from .human import MARK, volumes_of
from .shape import betas_of, has_custom_shape

CYCLES_LIMIT = 31
"""Volumes that Cycles evaluates at a point."""
_OFFSET = 0.8
"""Offset from the middle, in half sides, of the points of a box that are tried on each axis."""
_CACHED = 64
_counted: dict[tuple[int, str, tuple[float, ...]], int] = {}
"""Results for humans with custom shapes, since panels ask whenever they are drawn."""


def overlap_warning(collection: bpy.types.Collection) -> str | None:
    """A sentence for the user where Cycles will drop volumes of this human in its current shape, else None."""

    try:
        most = current_overlap(collection)
    except (ValueError, KeyError, TypeError):  # changed by hand
        return None
    if most <= CYCLES_LIMIT:
        return None
    return (
        f"up to {most} volumes of {collection.name!r} overlap at a point and Cycles draws only {CYCLES_LIMIT}; "
        "render with PrimDiffusion (Exact)"
    )


def overlap_warning_in(scene: bpy.types.Scene, collection: bpy.types.Collection) -> str | None:
    """`overlap_warning` where Cycles is the scene's engine: no other engine drops volumes."""
    return overlap_warning(collection) if scene.render.engine == "CYCLES" else None


def current_overlap(collection: bpy.types.Collection) -> int:
    """The largest number of volumes at a point, at rest.

    The number stored with the human where it has the shape of its file, or where volumes are hidden (when attached to
    the surface or merged) or missing. For other shapes it is counted once, in some 50 ms, from what Blender has
    evaluated. Raises ValueError, KeyError or TypeError where the collection's provenance was changed by hand.
    """
    stored = int(json.loads(collection[MARK])["most_overlapping"])
    if not has_custom_shape(collection):
        return stored
    key = (collection.session_uid, collection[MARK], tuple(betas_of(collection)))
    if key not in _counted:
        volumes = [obj for objects in volumes_of(collection).values() for obj in objects]
        if not volumes or not all(obj.visible_get() for obj in volumes):  # else Blender would read all files
            return stored
        centre, rotation, half = _boxes(volumes)
        if not half.all():
            return stored
        if len(_counted) == _CACHED:
            _counted.clear()
        _counted[key] = max_overlap(centre, rotation, half)
    return _counted[key]


def max_overlap(centre: NDArray, rotation: NDArray, half: NDArray) -> int:
    """The largest number of boxes (centre [K, 3], axes in columns [K, 3, 3], half sides [K, 3]) over one point.

    A lower bound: 27 points of each box are tried.
    """
    centre, rotation, half = (np.asarray(values, np.float32) for values in (centre, rotation, half))
    lattice = (
        np.stack(np.meshgrid(*[[-_OFFSET, 0.0, _OFFSET]] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    )
    tried, box = _near(centre, np.linalg.norm(half, axis=-1))
    into = rotation[box].transpose(0, 2, 1)
    at = np.matmul(into, (centre[tried] - centre[box])[..., None])[..., 0] / half[box]
    axes = np.matmul(into, rotation[tried]) * half[tried][:, None] / half[box][..., None]
    meets = (np.abs(at) < 1 + _OFFSET * np.abs(axes).sum(-1)).all(-1)
    tried, at, axes = tried[meets], at[meets], axes[meets]
    inside = np.ones((len(at), len(lattice)), bool)
    for axis in range(3):
        inside &= np.abs(axes[:, axis] @ lattice.T + at[:, axis, None]) < 1
    firsts = np.searchsorted(tried, np.arange(len(centre)))  # each box meets itself
    return int(np.add.reduceat(inside, firsts, axis=0, dtype=np.int32).max())


def _near(centre: NDArray, radius: NDArray) -> tuple[NDArray, NDArray]:
    """Pairs of a box and one, or itself, that may contain one of its points; sorted."""
    squared = np.zeros((len(centre), len(centre)), centre.dtype)
    for axis in range(3):
        squared += (centre[:, None, axis] - centre[None, :, axis]) ** 2
    return np.nonzero(squared < (_OFFSET * radius[:, None] + radius[None]) ** 2)


def _boxes(volumes: list[bpy.types.Object]) -> tuple[NDArray, NDArray, NDArray]:
    """Centres [K, 3], axes [K, 3, 3] and half sides [K, 3] at rest, in the armature's space, metres.

    Blender's bounding boxes are what Cycles draws, except for half a voxel before Blender 5.0.
    """
    corners = np.array([[list(corner) for corner in (obj.bound_box[0], obj.bound_box[6])] for obj in volumes])
    matrix = np.array([obj.matrix_basis for obj in volumes])
    scale = np.linalg.norm(matrix[:, :3, :3], axis=1)
    middle, half = corners.mean(1), np.abs(corners[:, 1] - corners[:, 0]) / 2 * scale
    centre = matrix[:, :3, 3] + np.einsum("kij,kj->ki", matrix[:, :3, :3], middle)
    return centre, matrix[:, :3, :3] / scale[:, None], half
