"""Cameras of captures as Blender's camera objects, and the other way round."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.camera_rig import View
from ..scene.convention import points_to_backend, points_to_blender

_SENSOR_MM = 36.0
_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
NEAR_M, FAR_M = 1e-3, 1e4


def aim(camera: bpy.types.Object, view: View) -> tuple[float, float]:
    """Make a camera object see what `view` does; returns the pixels' aspect (x, y) that the scene must have.

    Raises ValueError for pixels that are no rectangles.
    """
    k, data = view.intrinsics, camera.data
    if abs(k[0, 1]) > 1e-9 * k[0, 0]:
        raise ValueError(f"a camera has skewed pixels ({k[0, 1]:g}): Blender has rectangular ones only")
    aspect = (max(1.0, k[1, 1] / k[0, 0]), max(1.0, k[0, 0] / k[1, 1]))
    tall = aspect[1] / aspect[0]
    data.type, data.sensor_fit, data.sensor_width = "PERSP", "HORIZONTAL", _SENSOR_MM
    data.lens = k[0, 0] * _SENSOR_MM / view.width
    data.shift_x = (view.width / 2 - k[0, 2]) / view.width
    data.shift_y = (k[1, 2] - view.height / 2) * tall / view.width
    data.clip_start, data.clip_end = NEAR_M, FAR_M
    matrix = np.eye(4)
    matrix[:3, :3] = points_to_blender(_FROM_OPENCV @ view.rotation).T
    matrix[:3, 3] = points_to_blender(view.position)
    camera.matrix_world = Matrix(matrix.tolist())
    return aspect


def view_of(
    camera: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph,
    size: tuple[int, int],
    aspect: tuple[float, float] = (1.0, 1.0),
) -> View:
    """What a camera object of the user's sees in pictures of `size` (width, height), by Blender's own projection.

    Raises ValueError for cameras without perspective.
    """
    evaluated = camera.evaluated_get(depsgraph)
    if evaluated.type != "CAMERA" or evaluated.data.type != "PERSP":
        raise ValueError(f"{camera.name!r} is no perspective camera: choose others, or change its lens type")
    width, height = size
    projection = camera.calc_matrix_camera(depsgraph, x=width, y=height, scale_x=aspect[0], scale_y=aspect[1])
    intrinsics = np.array(
        [
            [projection[0][0] * width / 2, 0, (1 - projection[0][2]) * width / 2],
            [0, projection[1][1] * height / 2, (1 + projection[1][2]) * height / 2],
            [0, 0, 1],
        ]
    )
    axes, position = _frame(evaluated)
    rotation = _FROM_OPENCV @ axes.T
    return View(intrinsics, rotation, -rotation @ position, width, height)


def _frame(camera: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit axes as columns [3, 3] and position [3] in the backend's world; a camera's scale is nothing to its lens."""
    world = np.array(camera.matrix_world, np.float64)
    axes = world[:3, :3] / np.linalg.norm(world[:3, :3], axis=0)
    return points_to_backend(axes.T).T, points_to_backend(world[:3, 3])
