"""Compares volumes in Blender to the backend: to its linear blend skinning, and to its frames on the posed surface."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import torch
from mathutils import Matrix
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.human_file import load_human
from primdiffusion.primitives.anchors import anchor_skin_weights, attach, default_anchors

from blender_primdiffusion.scene.armature import model_origin, rest_rotations
from blender_primdiffusion.scene.convention import BLENDER_FROM_BACKEND


def errors(
    collection: bpy.types.Collection, armature: bpy.types.Object, file: Path, numbers: range
) -> dict[str, float | None]:
    """Largest differences over the frames `numbers`: positions in mm, axes in degrees."""
    human = load_human(file)
    body, anchors = default_body().to(dtype=torch.float64), default_anchors().to(dtype=torch.float64)
    shaped = body.shape(human.betas.double())
    rest = attach(anchors, shaped.vertices, body.faces).position
    weights = anchor_skin_weights(anchors, body)
    worst = {"lbs_error_mm_max": 0.0, "surface_error_mm_max": 0.0, "surface_error_deg_max": 0.0}
    bases = rest_rotations(armature)
    for mode in ("ARMATURE", "SURFACE"):
        bpy.ops.primdiffusion.set_attachment(mode=mode)
        for number in numbers:
            bpy.context.scene.frame_set(number)
            posed = shaped.pose(_pose(armature, bases))
            world = np.array(armature.matrix_world @ Matrix.Translation(model_origin(armature.data)))
            if mode == "ARMATURE":
                blended = torch.einsum("kj,jab->kab", weights, posed.skinning)
                expected = (blended[:, :3, :3] @ rest[:, :, None])[:, :, 0] + blended[:, :3, 3]
                found = _volumes(collection)
                worst["lbs_error_mm_max"] = max(
                    worst["lbs_error_mm_max"], _distance_mm(found[:, :3, 3], expected.numpy(), world)
                )
                continue
            frames = attach(anchors, posed.vertices, body.faces)
            found = _instances(armature)
            worst["surface_error_mm_max"] = max(
                worst["surface_error_mm_max"], _distance_mm(found[:, :3, 3], frames.position.numpy(), world)
            )
            axes = world[:3, :3] @ BLENDER_FROM_BACKEND @ frames.rotation.numpy()
            own = found[:, :3, :3] / np.linalg.norm(found[:, :3, :3], axis=1, keepdims=True)
            cosine = np.clip((np.einsum("kij,kij->k", axes, own) - 1) / 2, -1, 1)
            worst["surface_error_deg_max"] = max(
                worst["surface_error_deg_max"], float(np.degrees(np.arccos(cosine)).max())
            )
    bpy.ops.primdiffusion.set_attachment(mode="ARMATURE")
    return worst


def _pose(armature: bpy.types.Object, bases: np.ndarray) -> BodyPose:
    """SMPL's pose from the bones' pose: R = O B O^-1, rotated to y up."""
    turn = BLENDER_FROM_BACKEND
    rotations = []
    for name, basis in zip(JOINT_NAMES, bases, strict=True):
        local = np.array(armature.pose.bones[name].matrix_basis)[:3, :3]
        rotations.append(turn.T @ basis @ local @ basis.T @ turn)
    shift = turn.T @ (bases[0] @ np.array(armature.pose.bones[JOINT_NAMES[0]].matrix_basis)[:3, 3])
    return BodyPose(torch.from_numpy(np.array(rotations)), torch.from_numpy(shift))


def _volumes(collection: bpy.types.Collection) -> np.ndarray:
    graph = bpy.context.evaluated_depsgraph_get()
    objs = sorted((obj for obj in collection.all_objects if obj.type == "VOLUME"), key=lambda obj: obj.name)
    return np.array([np.array(obj.evaluated_get(graph).matrix_world) for obj in objs])


def _instances(armature: bpy.types.Object) -> np.ndarray:
    """World matrices of the volumes' instances on the surface, sorted by name."""
    graph = bpy.context.evaluated_depsgraph_get()
    found: dict[str, np.ndarray] = {}
    for instance in graph.object_instances:
        if instance.is_instance and instance.object.type == "VOLUME":
            found[instance.object.name] = np.array(Matrix(instance.matrix_world))
    return np.array([found[name] for name in sorted(found)])


def _distance_mm(found: np.ndarray, expected: np.ndarray, world: np.ndarray) -> float:
    """Largest distance in mm between world points and backend points given in the body model's space."""
    upright = expected @ BLENDER_FROM_BACKEND.T @ world[:3, :3].T + world[:3, 3]
    return 1e3 * float(np.linalg.norm(found - upright, axis=-1).max())
