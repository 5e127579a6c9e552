"""Give a human another shape: bones, body mesh, volumes and proxy move to their new rest places."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.rotation import matrix_to_quaternion
from .armature import move_rest_joints
from .build import floor_below
from .convention import frames_to_blender, points_to_blender
from .human import BETA_COUNT, BETAS, LARGEST_BETA, ORIGIN, armature_of, body_of, own_data, volumes_of
from .proxy import follow_shape, proxy_of
from .rest_human import shape_model_of
from .shape import Rest, generated_betas
from .surface import scale_surface

_FLOOR_TOLERANCE = 1e-3
"""Metres the soles may be off the floor and still count as on it."""


def check_shapeable(collection: bpy.types.Collection) -> None:
    """Raises ValueError for a human whose bones, mesh or volumes cannot follow a shape now."""
    armature, body = armature_of(collection), body_of(collection)
    for obj in (armature, armature.data, body and body.data):
        if obj and obj.library is not None:
            raise ValueError(
                f"the human {collection.name!r} is linked from {obj.library.filepath!r}: reshape it there, or "
                "make it local with Object > Relations > Make Local > All"
            )
    missing = [name for name in JOINT_NAMES if name not in armature.data.bones]
    if missing:
        raise ValueError(
            f"the armature {armature.name!r} has no bone {missing[0]!r}: give it this name again to change the shape"
        )
    for obj in (armature, body):
        if obj is not None and obj.data.is_editmode:
            raise ValueError(f"{obj.name!r} is in Edit Mode: leave it (Tab) to change the shape")


def reshape(collection: bpy.types.Collection, betas: NDArray) -> str:
    """Give a human another shape [10]; returns what could not follow in a sentence, empty when everything did.

    Bones, body mesh, volumes and mesh proxy move to their new rest places, with the soles where they were; pose,
    animation and files stay. Raises ValueError or FileNotFoundError before anything is touched. Makes no undo step.
    """
    betas = np.asarray(betas, np.float64)
    if betas.shape != (BETA_COUNT,) or not np.abs(betas).max() <= LARGEST_BETA:
        limit = f"{LARGEST_BETA:g}"
        raise ValueError(f"a shape is {BETA_COUNT} numbers from -{limit} to {limit}, not {betas.tolist()}")
    check_shapeable(collection)
    model, generated = shape_model_of(collection), generated_betas(collection)
    notice = apply_rest(collection, model.rest(betas), betas, model.growth(generated, betas))
    follow_shape(collection, proxy_of(collection), betas)
    return notice


def apply_rest(collection: bpy.types.Collection, rest: Rest, betas: NDArray, growth: NDArray) -> str:
    """Move bones, body mesh and volumes to `rest` (see `reshape`), volumes scaled by `growth` [K, 3]; returns a warning
    as `reshape` does."""
    armature, body = armature_of(collection), body_of(collection)
    bones = own_data(armature, collection)
    vertices, on_floor = points_to_blender(rest.vertices), ORIGIN in bones
    origin = floor_below(vertices) if on_floor else np.zeros(3)
    vertices += origin
    mesh = None if body is None else own_data(body, collection)
    unchanged = mesh is not None and len(mesh.vertices) == len(vertices) and mesh.shape_keys is None
    lowest = float(_heights(mesh).min()) if unchanged else None
    move_rest_joints(bones, points_to_blender(rest.joints) + origin)
    if on_floor:
        bones[ORIGIN] = origin.tolist()
        bones.update_tag()
    armature[BETAS] = betas.tolist()
    position = points_to_blender(rest.position) + origin
    quaternion = matrix_to_quaternion(frames_to_blender(rest.rotation))
    for k, objects in volumes_of(collection).items():
        for obj in objects if k < len(growth) else ():  # the number is the file name's
            obj.location, obj.rotation_quaternion, obj.scale = position[k], quaternion[k], growth[k]
    scale_surface(collection, growth)
    armature.update_tag()
    if lowest is not None:
        if not on_floor:
            _keep_on_floor(armature, lowest, float(vertices[:, 2].min()))
        mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
        mesh.update()
    return "" if body is None or unchanged else f"the mesh {body.name!r} was changed by hand and keeps its shape"


def apply_growth(collection: bpy.types.Collection, growth: NDArray) -> None:
    """Scale volumes by `growth` [K, 3], however they are attached."""
    for k, objects in volumes_of(collection).items():
        for obj in objects if k < len(growth) else ():
            obj.scale = growth[k]
    scale_surface(collection, growth)


def _heights(mesh: bpy.types.Mesh) -> NDArray[np.float32]:
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat[2::3]


def _keep_on_floor(armature: bpy.types.Object, before: float, after: float) -> None:
    """For humans of earlier versions: lift an upright armature, whose lowest rest point, at height `before` in its
    space, was on z = 0, so that a point at `after` is."""
    matrix = np.array(armature.matrix_basis)
    upright = np.abs(matrix[2, :2]).max() < 1e-4 * abs(matrix[2, 2])
    if armature.parent is None and upright and abs(matrix[2, 3] + matrix[2, 2] * before) < _FLOOR_TOLERANCE:
        armature.location.z = -matrix[2, 2] * after
