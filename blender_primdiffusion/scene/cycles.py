"""Cycles: settings by which a thousand volumes take minutes, a camera, and the limit on overlapping volumes."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .human import MARK, humans, provenance_of
from .representation import representation_of

_FOCAL_MM, _SENSOR_MM = 70.0, 36.0
_MARGIN = 1.05
_FLESH_M = 0.08


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


def posed_extent(person: bpy.types.Object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner [3] in the world of a human's bones as posed, with a margin for flesh."""
    bpy.context.view_layer.update()
    bones = [bone for bone in person.pose.bones if bone.bone.use_deform]
    ends = [person.matrix_world @ end for bone in bones for end in (bone.head, bone.tail)]
    points = np.array(ends, np.float64)
    return points.min(0) - _FLESH_M, points.max(0) + _FLESH_M


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


CYCLES_LIMIT = 31
"""Volumes that Cycles evaluates at a point."""


def overlap_warning(person: bpy.types.Object) -> str | None:
    """A sentence for the user where Cycles will drop volumes of this human, as it was made; else None."""
    try:
        most = overlap_of(person)
    except ValueError:  # changed by hand
        return None
    if most <= CYCLES_LIMIT:
        return None
    return (
        f"Cycles leaves out parts of {person.name!r}, where {most} volumes overlap and it draws only "
        f"{CYCLES_LIMIT}; render with the PrimDiffusion engine"
    )


def overlap_warning_in(scene: bpy.types.Scene, person: bpy.types.Object) -> str | None:
    """`overlap_warning` for a human shown by volumes where Cycles is the scene's engine: no other engine drops any."""
    by_volumes = scene.render.engine == "CYCLES" and representation_of(person) == "VOLUMES"
    return overlap_warning(person) if by_volumes else None


def overlap_of(person: bpy.types.Object) -> int:
    """The largest number of volumes at a point, at rest, as counted when the human was made.

    Raises ValueError where the human's provenance was changed by hand.
    """
    stored = provenance_of(person).get("most_overlapping")
    if not isinstance(stored, int):
        raise ValueError(f"the custom property {MARK!r} of {person.name!r} was changed by hand")
    return stored
