"""Who is under the mouse: volumes cannot be hit by rays, so the skeleton as it is drawn decides."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy

from ...formats.joints import JOINT_NAMES
from ...scene.human import armature_of, humans

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MARGIN = 0.12
"""How far around the joints' rectangle still counts as the person, of its height."""


def person_under(context: bpy.types.Context, event: bpy.types.Event) -> str:
    """Name of the person under the mouse in the 3D view; empty where there is none."""
    import numpy as np
    from bpy_extras.view3d_utils import location_3d_to_region_2d

    region, view = context.region, context.region_data
    if region is None or view is None:
        return ""
    seen = {}
    for person in humans(context.scene):
        try:
            armature = armature_of(person)
        except ValueError:
            continue
        bones = [armature.pose.bones[name] for name in JOINT_NAMES if name in armature.pose.bones]
        spots = [location_3d_to_region_2d(region, view, armature.matrix_world @ bone.head) for bone in bones]
        seen[person.name] = np.array([spot for spot in spots if spot is not None]).reshape(-1, 2)
    return nearest_to((event.mouse_region_x, event.mouse_region_y), seen)


def nearest_to(mouse: tuple[float, float], seen: dict[str, NDArray]) -> str:
    """Of people's joints in the picture [n, 2], pixels, the name of those around the mouse; the closest of several."""
    import numpy as np

    best, name = np.inf, ""
    for person, spots in seen.items():
        if len(spots) == 0:
            continue
        low, high = spots.min(0), spots.max(0)
        margin = _MARGIN * (high - low).max()
        if np.all(mouse >= low - margin) and np.all(mouse <= high + margin):
            apart = float(np.linalg.norm(spots - mouse, axis=-1).min())
            if apart < best:
                best, name = apart, person
    return name
