"""What Blender must show, computed with numpy alone."""

import bpy
import numpy as np
from synthetic import frames, skinning

from blender_primdiffusion.scene.volume_nodes import volumes_of, write_volumes

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Blender from backend, written out by hand: forward +z becomes -y, up +y becomes +z."""
TOLERANCE_M = 2e-5
"""Of points on posed bodies, whose files hold float32."""


def blended_vertices(human: dict, rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Rest vertices moved by linear blend skinning [V, 3], z up."""
    transforms = np.einsum("vj,jab->vab", human["skin_weights"], skinning(human["joints"], rotations, translation))
    homogeneous = np.concatenate([human["vertices"], np.ones((len(human["vertices"]), 1))], -1)
    return np.einsum("ab,vbc,vc->va", Z_UP, transforms, homogeneous)[:, :3]


def raised(vertices: np.ndarray) -> np.ndarray:
    """The armature's space from the body model's [4, 4], z up: rest vertices [V, 3], y up, stand on the armature's
    origin."""
    matrix = np.eye(4)
    matrix[2, 3] = -np.min(np.asarray(vertices)[:, 1])
    return matrix


def world_from_model(armature: bpy.types.Object, vertices: np.ndarray) -> np.ndarray:
    """The world from the body model's space [4, 4], z up, for an armature on these rest vertices [V, 3], y up."""
    return np.array(armature.matrix_world) @ raised(vertices)


def surface_frames(human: dict, rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Where the paper has the boxes [K, 4, 4], z up: the frames of the posed surface, by definition, scaled."""
    vertices = blended_vertices(human, rotations, translation) @ Z_UP[:3, :3]  # y up again
    position, rotation = frames(vertices, human)
    growth = human.get("growth", np.ones((len(position), 3)))
    found = np.tile(np.eye(4), (len(position), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = rotation * growth[:, None], position
    return Z_UP @ found


def evaluated_matrices(person: bpy.types.Object) -> np.ndarray:
    """World matrices [K, 4, 4] of a human's volumes as Blender draws them; shows them for that."""
    write_volumes(person)
    volumes = volumes_of(person)
    hidden, volumes.hide_viewport = volumes.hide_viewport, False
    bpy.context.view_layer.update()
    instances = bpy.context.evaluated_depsgraph_get().object_instances
    found = [np.array(one.matrix_world) for one in instances if one.is_instance and one.parent.original == volumes]
    volumes.hide_viewport = hidden
    bpy.context.view_layer.update()
    return np.array(found)
