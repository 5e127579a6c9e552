"""Give a human another shape: bones, body mesh, volumes and proxy move to their new rest places."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from .armature import move_rest_joints
from .convention import frames_to_blender, matrix_to_quaternion, points_to_blender
from .human import BETA_COUNT, BETAS, LARGEST_BETA, armature_of, body_of, own_data, volumes_of
from .proxy import follow_shape, proxy_of
from .shape import generated_betas, shape_model_of
from .shape_model import Rest
from .surface import grow

_ON_THE_FLOOR = 1e-3
"""Metres the soles may be off the floor and still be on it."""


def check_shapeable(collection: bpy.types.Collection) -> None:
    """Raises ValueError, with what to do, for a person whose bones, mesh or volumes cannot follow a shape now."""
    armature, body = armature_of(collection), body_of(collection)
    for thing in (armature, armature.data, body and body.data):
        if thing and thing.library is not None:
            raise ValueError(
                f"the person {collection.name!r} is linked from {thing.library.filepath!r}: reshape them there, or "
                "make them local with Object > Relations > Make Local > All"
            )
    missing = [name for name in JOINT_NAMES if name not in armature.data.bones]
    if missing:
        raise ValueError(
            f"the armature {armature.name!r} has no bone {missing[0]!r}: give it this name again to change the shape"
        )
    for thing in (armature, body):
        if thing is not None and thing.data.is_editmode:
            raise ValueError(f"{thing.name!r} is in Edit Mode: leave it (Tab) to change the shape")


def reshape(collection: bpy.types.Collection, betas: NDArray) -> str:
    """Give a person another shape [10]; returns what could not follow in a sentence, empty when all did.

    Bones, body mesh, volumes and mesh proxy at rest take their new places; pose, animation and files stay as they are,
    and soles that stood on the floor do so again. Raises ValueError or FileNotFoundError before anything is touched;
    makes no undo step, its caller does.
    """
    betas = np.asarray(betas, np.float64)
    if betas.shape != (BETA_COUNT,) or not np.abs(betas).max() <= LARGEST_BETA:
        limit = f"{LARGEST_BETA:g}"
        raise ValueError(f"a shape is {BETA_COUNT} numbers from -{limit} to {limit}, not {betas.tolist()}")
    check_shapeable(collection)
    model, generated = shape_model_of(collection), generated_betas(collection)
    notice = show_rest(collection, model.rest(betas), betas, model.growth(generated, betas))
    follow_shape(collection, proxy_of(collection), betas)
    return notice


def show_rest(collection: bpy.types.Collection, rest: Rest, betas: NDArray, growth: NDArray) -> str:
    """Move bones, body mesh and volumes to where a person at rest has them (see `reshape`); volumes are `growth` [K, 3]
    times as large as in their files."""
    armature, body = armature_of(collection), body_of(collection)
    vertices = points_to_blender(rest.vertices)
    mesh = None if body is None else own_data(body, collection)
    whole = mesh is not None and len(mesh.vertices) == len(vertices) and mesh.shape_keys is None
    lowest = float(_heights(mesh).min()) if whole else None
    move_rest_joints(own_data(armature, collection), points_to_blender(rest.joints))
    armature[BETAS] = betas.tolist()
    position, quaternion = points_to_blender(rest.position), matrix_to_quaternion(frames_to_blender(rest.rotation))
    for k, objects in volumes_of(collection).items():
        for thing in objects:
            thing.location, thing.rotation_quaternion, thing.scale = position[k], quaternion[k], growth[k]
    grow(collection, growth)
    armature.update_tag()
    if lowest is not None:
        _stay_on_the_floor(armature, lowest, float(vertices[:, 2].min()))
        mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
        mesh.update()
    return "" if body is None or whole else f"the mesh {body.name!r} was changed by hand and keeps its shape"


def show_growth(collection: bpy.types.Collection, growth: NDArray) -> None:
    """Make volumes `growth` [K, 3] times as large as in their files, however they are attached."""
    for k, objects in volumes_of(collection).items():
        for thing in objects:
            thing.scale = growth[k]
    grow(collection, growth)


def _heights(mesh: bpy.types.Mesh) -> NDArray[np.float32]:
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat[2::3]


def _stay_on_the_floor(armature: bpy.types.Object, before: float, after: float) -> None:
    """Lift an upright armature whose lowest point at rest, `before` in its space, was on z = 0, so that `after` is."""
    matrix = np.array(armature.matrix_basis)
    upright = np.abs(matrix[2, :2]).max() < 1e-4 * abs(matrix[2, 2])
    if armature.parent is None and upright and abs(matrix[2, 3] + matrix[2, 2] * before) < _ON_THE_FLOOR:
        armature.location.z = -matrix[2, 2] * after
