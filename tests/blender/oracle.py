"""What Blender must show, computed with numpy alone."""

from __future__ import annotations

import bpy
import numpy as np
from synthetic import skinning

from blender_primdiffusion.scene.human import parts_of

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Blender from backend, written out by hand: forward +z becomes -y, up +y becomes +z."""
TOLERANCE_M = 2e-5
"""Of points on posed bodies, whose files hold float32."""


def blended_frames(human: dict, rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Rest frames moved by linear blend skinning [K, 4, 4], z up: (sum_j w_j G_j) [R diag(growth) | x]."""
    frames = np.tile(np.eye(4), (len(human["position"]), 1, 1))
    growth = human.get("growth", np.ones((len(frames), 3)))
    frames[:, :3, :3], frames[:, :3, 3] = human["rotation"] * growth[:, None], human["position"]
    transforms = skinning(human["joints"], rotations, translation)
    return Z_UP @ np.einsum("kj,jab->kab", human["primitive_weights"], transforms) @ frames


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


def evaluated_matrices(collection: bpy.types.Object) -> np.ndarray:
    """World matrices [K, 4, 4] of a person's volumes, in the order of their names."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    volumes = sorted((o for o in parts_of(collection) if o.type == "VOLUME"), key=lambda o: o.name)
    return np.array([np.array(o.evaluated_get(depsgraph).matrix_world) for o in volumes])
