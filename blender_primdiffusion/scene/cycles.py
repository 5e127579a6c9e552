"""Cycles: settings by which a thousand volumes take minutes, a camera, and the limit on overlapping volumes."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .blend_values import stored_text
from .human import MARK, humans, provenance_of, volumes_of
from .shape import betas_of, has_custom_shape

_FOCAL_MM, _SENSOR_MM = 70.0, 36.0
_MARGIN = 1.05
_FLESH_M = 0.08


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
    extent = humans_extent(scene)
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
    scene.camera = new_camera(scene)
    frame_box(scene.camera, extent, yaw)
    return scene.camera


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


def _flat_world(grey: float) -> bpy.types.World:
    world = bpy.data.worlds.new("PrimDiffusion Preview")
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (grey, grey, grey, 1.0)
    return world


def new_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    """A camera in the scene, at the origin until `frame_box` places it."""
    data = bpy.data.cameras.new("Preview Camera")
    data.lens, data.sensor_width = _FOCAL_MM, _SENSOR_MM
    camera = bpy.data.objects.new("Preview Camera", data)
    scene.collection.objects.link(camera)
    return camera


def frame_box(
    camera: bpy.types.Object,
    extent: tuple[NDArray, NDArray],
    yaw: float,
    size: tuple[int, int] = (1, 1),
    distance: float | None = None,
) -> None:
    """Point the camera at the middle of a box, level, from `yaw` radians, as near as a picture of `size` shows all
    corners; or from `distance` metres, which turntables keep constant.
    """
    low, high = extent
    if distance is None:
        distance = framing_distance(camera, extent, yaw, size)
    direction = _camera_direction(yaw)
    camera.location = (low + high) / 2 + direction * distance
    camera.rotation_euler = Vector(-direction).to_track_quat("-Z", "Y").to_euler()
    camera.data.clip_end = max(100.0, 2 * distance)


def framing_distance(
    camera: bpy.types.Object, extent: tuple[NDArray, NDArray], yaw: float, size: tuple[int, int] = (1, 1)
) -> float:
    """Distance in metres from the middle of a box at which a picture of `size` just shows its eight corners."""
    low, high = extent
    right = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (high - low) / 2
    half = np.array(size) / max(size) * (_SENSOR_MM / 2 / camera.data.lens)  # tangents of the half angles of view
    aside = np.maximum(np.abs(corners @ right) / half[0], np.abs(corners[:, 2]) / half[1]) * _MARGIN
    return float((aside + corners @ _camera_direction(yaw)).max())


def _camera_direction(yaw: float) -> NDArray[np.float64]:
    """The horizontal direction from the subject to a camera at `yaw`."""
    return np.array([math.sin(yaw), -math.cos(yaw), 0.0])


CYCLES_LIMIT = 31
"""Volumes that Cycles evaluates at a point."""
_OFFSET = 0.8
"""Offset from the middle, in half sides, of the points of a box that are tried on each axis."""
_CACHED = 64
_counted: dict[tuple[int, str, tuple[float, ...]], int] = {}
"""Results for humans with custom shapes, since panels ask whenever they are drawn."""


def overlap_warning(person: bpy.types.Object) -> str | None:
    """A sentence for the user where Cycles will drop volumes of this human in its current shape, else None."""

    try:
        most = current_overlap(person)
    except ValueError:  # changed by hand
        return None
    if most <= CYCLES_LIMIT:
        return None
    return (
        f"Cycles leaves out parts of {person.name!r}, where {most} volumes overlap and it draws only "
        f"{CYCLES_LIMIT}; render with PrimDiffusion (Exact)"
    )


def overlap_warning_in(scene: bpy.types.Scene, person: bpy.types.Object) -> str | None:
    """`overlap_warning` for a human with volumes where Cycles is the scene's engine: no other engine drops any."""
    return overlap_warning(person) if scene.render.engine == "CYCLES" and volumes_of(person) else None


def current_overlap(person: bpy.types.Object) -> int:
    """The largest number of volumes at a point, at rest.

    The number stored with the human where it has the shape of its file, or where volumes are hidden (when attached to
    the surface or merged) or missing. For other shapes it is counted once, in some 50 ms, from what Blender has
    evaluated. Raises ValueError where the human's provenance was changed by hand.
    """
    stored = provenance_of(person).get("most_overlapping")
    if not isinstance(stored, int):
        raise ValueError(f"the custom property {MARK!r} of {person.name!r} was changed by hand")
    if not has_custom_shape(person):
        return stored
    key = (person.session_uid, stored_text(person, MARK) or "", tuple(betas_of(person)))
    if key not in _counted:
        volumes = [obj for objects in volumes_of(person).values() for obj in objects]
        if not volumes or not all(obj.visible_get() for obj in volumes):  # else Blender would read all files
            return stored
        centre, rotation, half = _boxes(volumes)
        if not half.all():
            return stored
        if len(_counted) == _CACHED:
            _counted.clear()
        _counted[key] = max_overlap(centre, rotation, half)
    return _counted[key]


def max_overlap(centre: NDArray, rotation: NDArray, half: NDArray) -> int:
    """The largest number of boxes (centre [K, 3], axes in columns [K, 3, 3], half sides [K, 3]) over one point.

    A lower bound: 27 points of each box are tried.
    """
    centre, rotation, half = (np.asarray(values, np.float32) for values in (centre, rotation, half))
    lattice = (
        np.stack(np.meshgrid(*[[-_OFFSET, 0.0, _OFFSET]] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    )
    tried, box = _near(centre, np.linalg.norm(half, axis=-1))
    into = rotation[box].transpose(0, 2, 1)
    at = np.matmul(into, (centre[tried] - centre[box])[..., None])[..., 0] / half[box]
    axes = np.matmul(into, rotation[tried]) * half[tried][:, None] / half[box][..., None]
    meets = (np.abs(at) < 1 + _OFFSET * np.abs(axes).sum(-1)).all(-1)
    tried, at, axes = tried[meets], at[meets], axes[meets]
    inside = np.ones((len(at), len(lattice)), bool)
    for axis in range(3):
        inside &= np.abs(axes[:, axis] @ lattice.T + at[:, axis, None]) < 1
    firsts = np.searchsorted(tried, np.arange(len(centre)))  # each box meets itself
    return int(np.add.reduceat(inside, firsts, axis=0, dtype=np.int32).max())


def _near(centre: NDArray, radius: NDArray) -> tuple[NDArray, NDArray]:
    """Pairs of a box and one, or itself, that may contain one of its points; sorted."""
    squared = np.zeros((len(centre), len(centre)), centre.dtype)
    for axis in range(3):
        squared += (centre[:, None, axis] - centre[None, :, axis]) ** 2
    return np.nonzero(squared < (_OFFSET * radius[:, None] + radius[None]) ** 2)


def _boxes(volumes: list[bpy.types.Object]) -> tuple[NDArray, NDArray, NDArray]:
    """Centres [K, 3], axes [K, 3, 3] and half sides [K, 3] at rest, in the armature's space, metres.

    Blender's bounding boxes are what Cycles draws, except for half a voxel before Blender 5.0.
    """
    corners = np.array([[list(corner) for corner in (obj.bound_box[0], obj.bound_box[6])] for obj in volumes])
    matrix = np.array([obj.matrix_basis for obj in volumes])
    scale = np.linalg.norm(matrix[:, :3, :3], axis=1)
    middle, half = corners.mean(1), np.abs(corners[:, 1] - corners[:, 0]) / 2 * scale
    centre = matrix[:, :3, 3] + np.einsum("kij,kj->ki", matrix[:, :3, :3], middle)
    return centre, matrix[:, :3, :3] / scale[:, None], half
