"""A human in the scene with files on the disk, and whether it is whole."""

from __future__ import annotations

import bpy
import numpy as np
import synthetic
from blender_primdiffusion.scene.pending import write_all_pending
from human_files import person_file
from mathutils import Matrix, Vector
from oracle import evaluated_matrices

from blender_primdiffusion.engine.picture import posed_humans
from blender_primdiffusion.scene.armature import move_rest_joints, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import ORIGIN, body_of, parts_of

COUNT = 6


def build_posed(source, name="Anna"):
    """A human in the scene in a pose, with its armature active; from the folder of its files."""
    person = build_human(bpy.context, source / "person.human.safetensors", name)
    rotations = synthetic.axis_angle(np.random.default_rng(3).normal(0, 0.5, (24, 3)))
    pose_from_joint_rotations(person, rotations)
    bpy.context.view_layer.objects.active = person
    bpy.context.view_layer.update()
    return person


def make_earlier(person) -> None:
    """Make a new human as earlier versions did: the armature's origin is the body model's, above the floor."""
    armature, body = person, body_of(person)
    origin = np.array(armature.data[ORIGIN])
    heads = [np.array(armature.data.bones[name].head_local) - origin for name in synthetic.NAMES]
    move_rest_joints(armature.data, np.array(heads))
    del armature.data[ORIGIN]
    body.data.transform(Matrix.Translation(-origin))
    for obj in parts_of(person):
        if obj.type == "VOLUME":
            obj.location -= Vector(origin)
    armature.location += Vector(origin)
    bpy.context.view_layer.update()


def strong_pose(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [24, 3, 3] far from rest, and a translation [3]."""
    rng = np.random.default_rng(seed)
    return synthetic.axis_angle(rng.normal(0, 0.7, (24, 3))), rng.normal(0, 0.5, 3)


def named(name="Anna"):
    return bpy.data.objects[name]


def places(person) -> np.ndarray:
    bpy.context.view_layer.update()
    return evaluated_matrices(person)


def whole(person, where=None) -> bool:
    """Files, grids and the engine's idea of a person; and their volumes' places, where these are given."""
    volumes = {obj.data for obj in parts_of(person) if obj.type == "VOLUME"}
    assert len([obj for obj in parts_of(person) if obj.type == "VOLUME"]) == COUNT
    write_all_pending()
    assert all(volume.grids.load() for volume in volumes)
    assert person_file(person).is_file()
    files = [one.file.resolve() for one in posed_humans(bpy.context.evaluated_depsgraph_get())]
    assert person_file(person).resolve() in files
    if where is not None:
        np.testing.assert_allclose(places(person), where, atol=1e-6)
    return True
