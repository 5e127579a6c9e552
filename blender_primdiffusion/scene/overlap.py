"""How many volumes cover one point: Cycles evaluates at most 31 of them and silently drops the others."""

from __future__ import annotations

import json

import bpy
import numpy as np
from numpy.typing import NDArray

from .human import MARK, volumes_of
from .shape import betas_of, keeps_own_shape

CYCLES_LIMIT = 31
"""Volumes that Cycles draws at a point."""
_TRIED = 0.8
"""Of half a side: where, beside the middle, points of a box are tried on each axis."""
_MOST_KEPT = 64
_counted: dict[tuple[int, str, tuple[float, ...]], int] = {}
"""Of people in shapes of their own: panels ask whenever they are drawn."""


def overlap_warning(collection: bpy.types.Collection) -> str | None:
    """A sentence for the user when Cycles will drop volumes of this person in their shape of now, else None."""
    from .overlap import overlapping_now

    try:
        most = overlapping_now(collection)
    except (ValueError, KeyError, TypeError):  # changed by hand
        return None
    if most <= CYCLES_LIMIT:
        return None
    return (
        f"up to {most} volumes of {collection.name!r} overlap at a point and Cycles draws only {CYCLES_LIMIT}; "
        "render with PrimDiffusion (Exact)"
    )


def overlap_warning_in(scene: bpy.types.Scene, collection: bpy.types.Collection) -> str | None:
    """The same where Cycles is the scene's engine: it is a matter of Cycles alone, and others need not be told."""
    return overlap_warning(collection) if scene.render.engine == "CYCLES" else None


def overlapping_now(collection: bpy.types.Collection) -> int:
    """The largest number at a point, at rest. Counted once for each shape, in some 50 ms, from what Blender has
    evaluated; the number noted for the shape of the person's file where they have that, and where volumes are hidden,
    as those attached to the surface or merged are, or their files missing.

    Raises ValueError, KeyError or TypeError where the collection's note was changed by hand.
    """
    noted = int(json.loads(collection[MARK])["most_overlapping"])
    if not keeps_own_shape(collection):
        return noted
    key = (collection.session_uid, collection[MARK], tuple(betas_of(collection)))
    if key not in _counted:
        volumes = [thing for objects in volumes_of(collection).values() for thing in objects]
        if not volumes or not all(thing.visible_get() for thing in volumes):  # Blender would read all files now
            return noted
        centre, rotation, half = _boxes(volumes)
        if not half.all():
            return noted
        if len(_counted) == _MOST_KEPT:
            _counted.clear()
        _counted[key] = most_overlapping(centre, rotation, half)
    return _counted[key]


def most_overlapping(centre: NDArray, rotation: NDArray, half: NDArray) -> int:
    """The largest number of boxes (centre [K, 3], axes in columns [K, 3, 3], half sides [K, 3]) over one point; 27
    points of each are tried."""
    centre, rotation, half = (np.asarray(values, np.float32) for values in (centre, rotation, half))
    lattice = np.stack(np.meshgrid(*[[-_TRIED, 0.0, _TRIED]] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    tried, box = _near(centre, np.linalg.norm(half, axis=-1))
    into = rotation[box].transpose(0, 2, 1)
    at = np.matmul(into, (centre[tried] - centre[box])[..., None])[..., 0] / half[box]
    axes = np.matmul(into, rotation[tried]) * half[tried][:, None] / half[box][..., None]
    meets = (np.abs(at) < 1 + _TRIED * np.abs(axes).sum(-1)).all(-1)
    tried, at, axes = tried[meets], at[meets], axes[meets]
    inside = np.ones((len(at), len(lattice)), bool)
    for axis in range(3):
        inside &= np.abs(axes[:, axis] @ lattice.T + at[:, axis, None]) < 1
    firsts = np.searchsorted(tried, np.arange(len(centre)))  # each box meets itself
    return int(np.add.reduceat(inside, firsts, axis=0, dtype=np.int32).max())


def _near(centre: NDArray, radius: NDArray) -> tuple[NDArray, NDArray]:
    """Pairs of a box and another, or itself, that may hold one of its points; sorted."""
    apart = np.zeros((len(centre), len(centre)), centre.dtype)
    for axis in range(3):
        apart += (centre[:, None, axis] - centre[None, :, axis]) ** 2
    return np.nonzero(apart < (_TRIED * radius[:, None] + radius[None]) ** 2)


def _boxes(volumes: list[bpy.types.Object]) -> tuple[NDArray, NDArray, NDArray]:
    """Centres [K, 3], axes [K, 3, 3] and half sides [K, 3] at rest, in the armature's space, metres. Blender's boxes
    are what Cycles draws, but for half a voxel before Blender 5.0."""
    corners = np.array([[list(corner) for corner in (thing.bound_box[0], thing.bound_box[6])] for thing in volumes])
    matrix = np.array([thing.matrix_basis for thing in volumes])
    scale = np.linalg.norm(matrix[:, :3, :3], axis=1)
    middle, half = corners.mean(1), np.abs(corners[:, 1] - corners[:, 0]) / 2 * scale
    centre = matrix[:, :3, 3] + np.einsum("kij,kj->ki", matrix[:, :3, :3], middle)
    return centre, matrix[:, :3, :3] / scale[:, None], half
