"""Cycles as benchmarks and tests render humans with it: a camera around them, a grey world, one sample."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.place import posed_extent
from blender_primdiffusion.scene.volume_nodes import fit_cycles_to_volumes

_FOCAL_MM, _SENSOR_MM = 70.0, 36.0
"""Of the camera."""
_MARGIN = 1.05
"""Around what the camera frames."""


def setup_cycles_preview(
    scene: bpy.types.Scene,
    *,
    size: int = 384,
    samples: int = 1,
    yaw: float = 0.0,
    world: float | None = None,
) -> bpy.types.Object:
    """Make `scene` ready to render its humans as they are posed now, and return the camera, which frames them.

    size: pixels a side. samples: per pixel; more samples only smooth edges, since no light scatters. yaw: angle of the
    camera from the front towards the human's left, radians. world: grey level of the background, None for a transparent
    film. The view transform is Standard, so that the picture has the colours of the volumes. A picture of 384 x 384 at
    one sample took a minute on two idle cores (docs/results/demo.json). Raises ValueError for a scene without humans.
    """
    bpy.context.view_layer.update()
    extent = _humans_extent(scene)
    scene.render.engine = "CYCLES"
    fit_cycles_to_volumes(scene, samples)
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = world is None
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.world = _flat_world(0.0 if world is None else world)
    scene.camera = _new_camera(scene)
    _frame_box(scene.camera, extent, yaw)
    return scene.camera


def _flat_world(grey: float) -> bpy.types.World:
    world = bpy.data.worlds.new("PrimDiffusion Preview")
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (grey, grey, grey, 1.0)
    return world


def _humans_extent(scene: bpy.types.Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner [3] of all humans in a scene, as posed. Raises ValueError when there are none."""
    extents = [posed_extent(person) for person in humans(scene)]
    if not extents:
        raise ValueError(f"there is no human in the scene {scene.name!r}; add one first")
    return np.min([low for low, _ in extents], 0), np.max([high for _, high in extents], 0)


def _new_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    """A camera in the scene, at the origin until `_frame_box` places it."""
    data = bpy.data.cameras.new("Preview Camera")
    data.lens, data.sensor_width = _FOCAL_MM, _SENSOR_MM
    camera = bpy.data.objects.new("Preview Camera", data)
    scene.collection.objects.link(camera)
    return camera


def _frame_box(
    camera: bpy.types.Object, extent: tuple[NDArray, NDArray], yaw: float, size: tuple[int, int] = (1, 1)
) -> None:
    """Point the camera at the middle of a box, level, from `yaw` radians, as near as a picture of `size` shows all
    corners."""
    low, high = extent
    right, direction = np.array([math.cos(yaw), math.sin(yaw), 0.0]), np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (high - low) / 2
    half = np.array(size) / max(size) * (_SENSOR_MM / 2 / camera.data.lens)  # tangents of the half angles of view
    aside = np.maximum(np.abs(corners @ right) / half[0], np.abs(corners[:, 2]) / half[1]) * _MARGIN
    distance = float((aside + corners @ direction).max())
    camera.location = (low + high) / 2 + direction * distance
    camera.rotation_euler = Vector(-direction).to_track_quat("-Z", "Y").to_euler()
    camera.data.clip_end = max(100.0, 2 * distance)
