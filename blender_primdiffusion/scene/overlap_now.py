"""How many volumes of a person overlap, in the shape that they have now."""

from __future__ import annotations

import json

import bpy
import numpy as np
from numpy.typing import NDArray

from .human import MARK
from .overlap import most_overlapping
from .shape import betas_of, keeps_own_shape, volumes_of

_MOST_KEPT = 64
_counted: dict[tuple[int, str, tuple[float, ...]], int] = {}
"""Of people in shapes of their own: panels ask whenever they are drawn."""


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


def _boxes(volumes: list[bpy.types.Object]) -> tuple[NDArray, NDArray, NDArray]:
    """Centres [K, 3], axes [K, 3, 3] and half sides [K, 3] at rest, in the armature's space, metres. Blender's boxes
    are what Cycles draws, but for half a voxel before Blender 5.0."""
    corners = np.array([[list(corner) for corner in (thing.bound_box[0], thing.bound_box[6])] for thing in volumes])
    matrix = np.array([thing.matrix_basis for thing in volumes])
    scale = np.linalg.norm(matrix[:, :3, :3], axis=1)
    middle, half = corners.mean(1), np.abs(corners[:, 1] - corners[:, 0]) / 2 * scale
    centre = matrix[:, :3, 3] + np.einsum("kij,kj->ki", matrix[:, :3, :3], middle)
    return centre, matrix[:, :3, :3] / scale[:, None], half
