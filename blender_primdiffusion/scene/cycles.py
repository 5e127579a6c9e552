"""Cycles: settings by which a thousand volumes take minutes, and a camera."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .human import humans
from .place import posed_extent

_FOCAL_MM, _SENSOR_MM = 70.0, 36.0
_MARGIN = 1.05


def fit_cycles_to_volumes(scene: bpy.types.Scene, samples: int) -> None:
    """Set Cycles up so that a human takes minutes, not hours: other objects lose indirect light."""
    cycles = scene.cycles
    cycles.samples = samples
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.max_bounces = 0
    cycles.volume_bounces = 0
    cycles.transparent_max_bounces = 1024  # every box in a row costs two
    cycles.volume_step_rate = 1.0
    cycles.volume_biased = True  # unbiased tracking takes seconds per volume object, an hour a frame


def humans_extent(scene: bpy.types.Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner [3] of all humans in a scene, as posed. Raises ValueError when there are none."""
    extents = [posed_extent(person) for person in humans(scene)]
    if not extents:
        raise ValueError(f"there is no human in the scene {scene.name!r}; add one first")
    return np.min([low for low, _ in extents], 0), np.max([high for _, high in extents], 0)


def new_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    """A camera in the scene, at the origin until `frame_box` places it."""
    data = bpy.data.cameras.new("Preview Camera")
    data.lens, data.sensor_width = _FOCAL_MM, _SENSOR_MM
    camera = bpy.data.objects.new("Preview Camera", data)
    scene.collection.objects.link(camera)
    return camera


def frame_box(
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
