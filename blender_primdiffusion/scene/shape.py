"""The shape of people in the scene: their betas, and what follows from them.

`armature[BETAS]` is the truth, which the engine draws. Bones, body mesh and volumes of a person at rest follow when the
shape is set here; a shape that is animated or changed by hand in the custom property moves them not.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from . import shape_file
from .armature import move_rest_joints
from .body_mesh import body_of
from .convention import frames_to_blender, points_to_blender
from .human import BETAS, MARK, armature_of, folders_of, volume_path
from .quaternion import matrix_to_quaternion
from .shape_model import SAME_BETAS, Rest, ShapeModel
from .shape_names import BETAS as COUNT
from .shape_names import LARGEST_BETA

PRIMITIVE = re.compile(r"prim_(\d{4,})_[0-9a-f]{12}\.vdb")
"""Names of the files of volumes."""
_ON_THE_FLOOR = 1e-3
"""Metres the soles may be off the floor and still be on it."""


def betas_of(collection: bpy.types.Collection) -> NDArray[np.float64]:
    """The person's shape [10] as the engine draws it now. Raises ValueError where it is no list of ten numbers."""
    armature = armature_of(collection)
    given = armature[BETAS] if BETAS in armature else generated_betas(collection)
    try:
        betas = np.array(list(given), np.float64)
    except (TypeError, ValueError):
        betas = np.empty(0)
    if betas.shape != (COUNT,) or not np.isfinite(betas).all():
        raise ValueError(
            f"the custom property {BETAS!r} on the armature of {collection.name!r} is no list of {COUNT} numbers: "
            "delete it"
        )
    return betas


def generated_betas(collection: bpy.types.Collection) -> NDArray[np.float64]:
    """The shape [10] that the person was generated with, or got from their last edit. Raises ValueError where the
    collection's note of that is damaged."""
    try:
        betas = np.array(json.loads(collection[MARK])["betas"], np.float64)
    except (ValueError, KeyError, TypeError):
        betas = np.empty(0)
    if betas.shape != (COUNT,):
        raise ValueError(
            f"the custom property {MARK!r} of {collection.name!r} was changed by hand and tells no shape: undo that, "
            "or generate the person again"
        )
    return betas


def keeps_own_shape(collection: bpy.types.Collection) -> bool:
    """The shape is not the one of the person's file: somebody has chosen it."""
    try:
        return not np.allclose(betas_of(collection), generated_betas(collection), atol=SAME_BETAS)
    except ValueError:
        return True


def shape_model_of(collection: bpy.types.Collection) -> ShapeModel:
    """How the person's body follows its shape. Raises ValueError or FileNotFoundError with what to do."""
    if shape_file.BODY_FILE not in collection:
        raise ValueError(
            f"the person {collection.name!r} was made by an earlier version and keeps their shape: generate the person "
            "again, or vary them, to reshape"
        )
    name = str(collection[shape_file.BODY_FILE])
    places = [place / name for near in folders_of(collection) for place in (near.parent, near)]
    return shape_file.read(next((place for place in places if place.is_file()), places[0]))


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
    from .exported_proxy import proxy_of
    from .proxy_shape import follow_shape

    betas = np.asarray(betas, np.float64)
    if betas.shape != (COUNT,) or not np.abs(betas).max() <= LARGEST_BETA:
        raise ValueError(f"a shape is {COUNT} numbers from -{LARGEST_BETA:g} to {LARGEST_BETA:g}, not {betas.tolist()}")
    check_shapeable(collection)
    model, generated = shape_model_of(collection), generated_betas(collection)
    notice = show_rest(collection, model.rest(betas), betas, model.growth(generated, betas))
    follow_shape(collection, proxy_of(collection), betas)
    return notice


def show_rest(collection: bpy.types.Collection, rest: Rest, betas: NDArray, growth: NDArray) -> str:
    """Move bones, body mesh and volumes to where a person at rest has them (see `reshape`); volumes are `growth` [K, 3]
    times as large as in their files."""
    from .surface import grow

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
    from .surface import grow

    for k, objects in volumes_of(collection).items():
        for thing in objects:
            thing.scale = growth[k]
    grow(collection, growth)


def volumes_of(collection: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """A person's volume objects by primitive, which the name of the file tells whatever the object is called now."""
    found = defaultdict(list)
    for thing in collection.all_objects:
        if thing.type == "VOLUME" and (match := PRIMITIVE.fullmatch(volume_path(thing.data).name)):
            found[int(match[1])].append(thing)
    return dict(found)


def own_data(thing: bpy.types.Object, collection: bpy.types.Collection):
    """An object's data, copied first where another person's objects show it too (duplicates share data)."""
    if thing.data.users > 1:
        users = bpy.data.user_map(subset=[thing.data])[thing.data]
        if any(isinstance(user, bpy.types.Object) and user not in set(collection.all_objects) for user in users):
            thing.data = thing.data.copy()
    return thing.data


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
