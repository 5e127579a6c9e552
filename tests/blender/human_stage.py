"""A human in the scene with files on the disk, and whether it is whole."""

import bpy
import numpy as np
import synthetic
from human_files import person_file
from oracle import evaluated_matrices

from blender_primdiffusion.engine.picture import posed_humans
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.volume_nodes import are_written

COUNT = 6


def build_posed(source, name="Anna"):
    """A human in the scene in a pose, with its armature active; from the folder of its files."""
    person = build_human(bpy.context, source / "person.human.safetensors", name)
    rotations = synthetic.axis_angle(np.random.default_rng(3).normal(0, 0.5, (24, 3)))
    pose_from_joint_rotations(person, rotations)
    bpy.context.view_layer.objects.active = person
    bpy.context.view_layer.update()
    return person


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
    """Files, volumes and the engine's idea of a person; and their volumes' places, where these are given."""
    assert len(places(person)) == COUNT
    assert are_written(person)
    assert person_file(person).is_file()
    files = [one.file.resolve() for one in posed_humans(bpy.context.evaluated_depsgraph_get())]
    assert person_file(person).resolve() in files
    if where is not None:
        np.testing.assert_allclose(places(person), where, atol=1e-6)
    return True
