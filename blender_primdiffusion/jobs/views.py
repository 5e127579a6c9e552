"""3D views: how much of a human they show beside the panels that cover them, and turning one to humans."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray

SHOWN_SHARE = 0.9
"""Of the rectangle around a human: a view that shows less of it does not show the human."""
_MARGIN = 0.08
"""Of the uncovered part of a view, on each side of the humans that it is turned to."""
_FLESH_M = 0.1
"""Around the bones that an armature's box holds."""
_COVERING = frozenset({"UI", "TOOLS", "HEADER", "TOOL_HEADER", "ASSET_SHELF", "ASSET_SHELF_HEADER"})
"""Regions that Blender draws above a 3D view."""
_FAR_M = 1e3
"""From a parallel view's middle to what counts as its eye."""


@dataclasses.dataclass(frozen=True)
class View:
    """A region of a 3D view, and what of it no panel covers: low and high [2], from -1 to 1 across the region."""

    window: bpy.types.Window
    area: bpy.types.Area
    region: bpy.types.Region
    around: bpy.types.RegionView3D
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def eye(self) -> Vector:
        """In the world; of a parallel view, far behind."""
        to_world = self.around.view_matrix.inverted()
        distance = 0.0 if self.around.is_perspective else _FAR_M
        return to_world.translation + distance * to_world.col[2].to_3d()

    def shows(self, obj: bpy.types.Object, least: float) -> bool:
        """Whether an object takes more than the share `least` of the height, and is nearly all uncovered."""
        perspective = self.around.perspective_matrix
        uncovered = share_between(perspective, obj, self.low, self.high) >= SHOWN_SHARE
        return uncovered and share_of_height(perspective, obj) > least

    def frame(self, objects: Iterable[bpy.types.Object]) -> None:
        """Move the view, without turning it, so that its uncovered part holds these objects."""
        around, rotation = self.around, np.array(self.around.view_rotation.to_matrix())
        points = np.concatenate([_corners(obj) for obj in objects]) @ rotation
        low, high = self.low + _MARGIN * (self.high - self.low), self.high - _MARGIN * (self.high - self.low)
        centre, distance = fitted(np.array(around.window_matrix), points, low, high, around.view_distance)
        around.view_location, around.view_distance = rotation @ centre, distance
        self.area.tag_redraw()


def views() -> Iterator[View]:
    """All 3D views in the windows but local ones, which do not show new objects."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and area.spaces.active.local_view is None:
                region = next(region for region in area.regions if region.type == "WINDOW")
                yield View(window, area, region, area.spaces.active.region_3d, *_uncovered(area, region))


def eye() -> Vector | None:
    """That of the first 3D view; None without one."""
    return None if bpy.app.background else next((view.eye for view in views()), None)


def bring_into_view(obj: bpy.types.Object, least: float, others: Iterable[bpy.types.Object] = ()) -> None:
    """Move the first 3D view to an object, and to those of `others` that it shows, unless a view shows the object on
    more than the share `least` of its height, or looks through a camera."""
    if bpy.app.background:
        return
    bpy.context.view_layer.update()
    found = list(views())
    cameras = any(view.around.view_perspective == "CAMERA" for view in found)
    if found and not cameras and not any(view.shows(obj, least) for view in found):
        first = found[0]
        first.frame([obj, *(other for other in others if first.shows(other, 0.0))])


def share_of_height(perspective: Matrix, obj: bpy.types.Object) -> float:
    """The share of a view's height that an object's bounding box takes; 0 where its middle is not in the view."""
    box = _rectangle(perspective, obj)
    return 0.0 if box is None or (abs(box.sum(0)) >= 2).any() else float(box[1, 1] - box[0, 1]) / 2


def share_between(perspective: Matrix, obj: bpy.types.Object, low: NDArray, high: NDArray) -> float:
    """The share of the rectangle around an object's bounding box that lies between `low` and `high` [2], which go from
    -1 to 1 across the view; 0 where the box reaches behind the eye."""
    box = _rectangle(perspective, obj)
    if box is None:
        return 0.0
    within = np.clip(box, low, high)
    return float(np.prod(within[1] - within[0]) / max(np.prod(box[1] - box[0]), 1e-12))


def fitted(
    window: NDArray, points: NDArray, low: NDArray, high: NDArray, distance: float
) -> tuple[NDArray[np.float64], float]:
    """The centre [3] and distance of the view with this projection [4, 4] (at `distance`, which scales parallel views)
    whose part between `low` and `high` [2] holds `points` [N, 3], as large as possible.

    Points and centre in axes that are parallel to the view's: x to the right, y up, z towards the eye.
    """
    near, (x, y) = points[:, 2].max(), np.diag(window)[:2]
    middle = (points.min(0) + points.max(0)) / 2
    if window[3, 3] != 0:
        sizes = np.ptp(points, axis=0)[:2] * [x, y] / (high - low)
        scale = float(sizes.max())
        offset = (low + high) / 2 * scale / [x, y]
        return np.array([*(middle[:2] - offset), middle[2]]), distance * scale
    # the eye sees a point at the edge e where focal (point - eye) = e (eye_z - point_z): lines in eye and eye_z
    focal = np.array([x, y])
    most = (points[:, :2] + high / focal * points[:, 2:]).max(0)
    least = (points[:, :2] + low / focal * points[:, 2:]).min(0)
    depth = max(float(((most - least) * focal / (high - low)).max()), near + _FLESH_M)
    across = (most - high / focal * depth + least - low / focal * depth) / 2
    return np.array([*across, middle[2]]), depth - middle[2]


def _rectangle(perspective: Matrix, obj: bpy.types.Object) -> NDArray[np.float64] | None:
    """Lowest and highest [2, 2] of an object's bounding box, from -1 to 1 across a view; None around the eye."""
    clip = [perspective @ (obj.matrix_world @ Vector(corner)).to_4d() for corner in obj.bound_box]
    if min(corner.w for corner in clip) <= 0:
        return None
    seen = np.array([(corner.x / corner.w, corner.y / corner.w) for corner in clip])
    return np.array([seen.min(0), seen.max(0)])


def _corners(obj: bpy.types.Object) -> NDArray[np.float64]:
    """Corners of its bounding box in the world and the flesh around it [8, 3]."""
    corners = np.array([obj.matrix_world @ Vector(corner) for corner in obj.bound_box])
    return corners + np.sign(corners - corners.mean(0)) * _FLESH_M


def _uncovered(area: bpy.types.Area, region: bpy.types.Region) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    size = np.array([region.width, region.height], np.float64)
    low, high = np.zeros(2), size.copy()
    for other in area.regions:
        if other.type not in _COVERING or min(other.width, other.height) <= 1:
            continue
        start = np.array([other.x - region.x, other.y - region.y])
        end = start + np.array([other.width, other.height])
        if (end <= 0).any() or (start >= size).any():
            continue
        if other.alignment == "LEFT":
            low[0] = max(low[0], end[0])
        elif other.alignment == "RIGHT":
            high[0] = min(high[0], start[0])
        elif other.alignment == "BOTTOM":
            low[1] = max(low[1], end[1])
        elif other.alignment == "TOP":
            high[1] = min(high[1], start[1])
    if (high - low < size / 4).any():  # too little is left to use
        low, high = np.zeros(2), size
    return 2 * low / size - 1, 2 * high / size - 1
