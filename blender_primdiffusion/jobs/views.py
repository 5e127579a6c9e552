"""Turning a 3D view to a new human that no view shows."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector


def bring_into_view(obj: bpy.types.Object, least: float) -> None:
    """Have the first 3D view frame a selected object, unless a view shows all of it on more than the share `least` of
    its height, or looks through a camera."""
    if bpy.app.background:
        return
    bpy.context.view_layer.update()
    views = [
        (window, area, area.spaces.active.region_3d)
        for window in bpy.context.window_manager.windows
        for area in window.screen.areas
        if area.type == "VIEW_3D" and area.spaces.active.local_view is None
    ]
    if not views or any(around.view_perspective == "CAMERA" for *_, around in views):
        return
    if not any(share_of_height(around.perspective_matrix, obj) > least for *_, around in views):
        window, area, _ = views[0]
        region = next(region for region in area.regions if region.type == "WINDOW")
        with bpy.context.temp_override(window=window, area=area, region=region):
            bpy.ops.view3d.view_selected()


def share_of_height(perspective: Matrix, obj: bpy.types.Object) -> float:
    """The share of a view's height that an object's bounding box takes; 0 where the view does not show all of it."""
    clip = [perspective @ (obj.matrix_world @ Vector(corner)).to_4d() for corner in obj.bound_box]
    if min(corner.w for corner in clip) <= 0:
        return 0.0
    seen = np.array([(corner.x / corner.w, corner.y / corner.w) for corner in clip])
    return 0.0 if np.abs(seen).max() > 1 else float(np.ptp(seen[:, 1])) / 2
