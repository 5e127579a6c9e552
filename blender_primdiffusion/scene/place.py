"""Where a new human stands: at the 3D cursor, or beside the humans and solid objects that are there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .human import BODY_MARK, PROXY_MARK, humans

GAP_M = 0.2
"""Distance to other humans and to solid objects, metres."""
REACH_M = 6.0
"""Longest way from the cursor to get clear of solid objects, metres."""
_FLESH_M = 0.1
"""Margin around bones, metres."""
_STEP_M = 0.1
"""Height above the soles of what one stands on: floors, rugs, uneven ground, metres."""
_SEE_THROUGH = frozenset({"WIRE", "BOUNDS"})
_SOLID_TYPES = frozenset({"MESH", "CURVE", "SURFACE", "FONT", "META"})
_OF_HUMANS = (BODY_MARK, PROXY_MARK)


def stand_at_cursor(context: bpy.types.Context, person: bpy.types.Object) -> None:
    """Move a new human from the world's origin to the 3D cursor: past the boxes around solid objects there, then along
    the world's x axis past other humans. Evaluates the scene."""
    person.location += context.scene.cursor.location
    context.view_layer.update()
    extent = posed_extent(person)
    people = [posed_extent(other) for other in humans(context.scene) if other != person and other.data.bones]
    solids = list(_solids(context.evaluated_depsgraph_get(), extent))
    away = _nearest(_ways_out(extent, solids), extent, solids)
    moved = extent + away
    solids = [box for box in solids if not _too_close(moved, box)]  # not the hills that it stands on after all
    along_x = [move for box in people for move in _past(moved, box)] + _ways_out(moved, solids)
    away += _nearest([(x, y) for x, y in along_x if y == 0], moved, [*solids, *people])
    person.location.xy += Vector(away[:2])


def _nearest(moves: Iterable[tuple[float, float]], extent: NDArray, boxes: Sequence[NDArray]) -> NDArray[np.float64]:
    """The shortest move [3] in x and y that brings a box [2, 3] clear of others, rather to +x and -y; none where none
    does."""
    order = sorted(set(moves), key=lambda move: (round(float(np.hypot(*move)), 6), move[0] < 0, move[1] > 0))
    for x, y in [(0.0, 0.0), *order]:
        move = np.array([x, y, 0.0])
        if not any(_too_close(extent + move, box) for box in boxes):
            return move
    return np.zeros(3)


def _ways_out(extent: NDArray, solids: Iterable[NDArray]) -> list[tuple[float, float]]:
    """Moves past solid objects, within reach."""
    return [(x, y) for box in solids for x, y in _past(extent, box) if max(abs(x), abs(y)) <= REACH_M]


def _past(own: NDArray, other: NDArray) -> list[tuple[float, float]]:
    """Moves, two along x and two along y, after which a box [2, 3] is GAP_M away from another."""
    above, below = other[1] + GAP_M - own[0], other[0] - GAP_M - own[1]
    return [(above[0], 0.0), (below[0], 0.0), (0.0, above[1]), (0.0, below[1])]


def _too_close(extent: NDArray, other: NDArray) -> bool:
    """Whether a box [2, 3] is nearer than GAP_M to another in x while they overlap in y, or the other way round."""
    apart = np.maximum(other[0] - extent[1], extent[0] - other[1])[:2]
    return bool((apart < 0).all() or ((apart < GAP_M - 1e-6).all() and (apart < 0).any()))


def posed_extent(armature: bpy.types.Object) -> NDArray[np.float64]:
    """Lowest and highest corner [2, 3] in the world of a human's bones as posed, with a margin for flesh."""
    to_world = np.array(armature.matrix_world)
    bones = [(bone.head, bone.tail) for bone in armature.pose.bones if bone.bone.use_deform]
    ends = np.array(bones, np.float64).reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    return np.array([ends.min(0) - _FLESH_M, ends.max(0) + _FLESH_M])


def _solids(depsgraph: bpy.types.Depsgraph, extent: NDArray) -> Iterator[NDArray[np.float64]]:
    """Boxes [2, 3] around the visible solid objects at a human's height, without what the human stands on, and without
    rooms and landscapes, which the human is within."""
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self or not is_solid(obj) or obj.display_type in _SEE_THROUGH:
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        corners = np.array([list(corner) for corner in obj.bound_box]) @ matrix[:3, :3].T + matrix[:3, 3]
        low, high = corners.min(0), corners.max(0)
        around = (low <= extent[0]).all() and (high >= extent[1]).all()
        if high[2] > extent[0, 2] + _STEP_M and low[2] < extent[1, 2] and not around:
            yield np.array([low, high])


def is_solid(obj: bpy.types.Object) -> bool:
    """Whether an object has a surface and is not part of a human."""
    return obj.type in _SOLID_TYPES and not any(mark in obj for mark in _OF_HUMANS)
