"""Where a new person stands: beside those who are there, not inside them."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from .human import armature_of, humans

GAP_M = 0.2
"""Between the hands of two people in the T pose."""
_FLESH_M = 0.1
"""Around bones."""


def stand_beside_others(context: bpy.types.Context, collection: bpy.types.Collection) -> None:
    """Move a person who has just been built along the world's x axis, as little as is needed to stand free.

    Looks at where the bones of the scene's people are as posed; nobody else moves. Evaluates the scene where somebody
    else is in it. Raises ValueError as `armature_of` does.
    """
    armature = armature_of(collection)
    others = [
        thing
        for person in humans(context.scene)
        if person != collection
        for thing in person.objects
        if thing.type == "ARMATURE" and thing.data.bones
    ]
    if others:
        context.view_layer.update()
        armature.location.x += _shift(_ground(armature), [_ground(other) for other in others])


def _shift(own: NDArray[np.float64], others: list[NDArray[np.float64]]) -> float:
    """The smallest move in x, metres, after which the rectangle `own` is GAP_M or more from all others; right first."""
    places = [0.0]
    for other in others:
        places += [other[1, 0] + GAP_M - own[0, 0], other[0, 0] - GAP_M - own[1, 0]]
    free = [x for x in places if not any(_meet(own + np.array([x, 0.0]), other) for other in others)]
    return min(free, key=lambda x: (round(abs(x), 6), x < 0))  # beyond the outermost there is always room


def _meet(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether two rectangles are nearer than GAP_M in x while they overlap in y."""
    gap = np.array([GAP_M - 1e-6, 0.0])
    return bool(((one[0] < other[1] + gap) & (other[0] < one[1] + gap)).all())


def _ground(armature: bpy.types.Object) -> NDArray[np.float64]:
    """Lowest and highest x and y in the world [2, 2] of the bones as posed, with flesh around them."""
    to_world = np.array(armature.matrix_world)
    bones = [(bone.head, bone.tail) for bone in armature.pose.bones]
    ends = np.array(bones, np.float64).reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    return np.array([ends.min(0)[:2] - _FLESH_M, ends.max(0)[:2] + _FLESH_M])
