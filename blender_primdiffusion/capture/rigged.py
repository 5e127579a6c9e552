"""Armatures of imported people: which one, at rest, where its bones are, and what hangs on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend
from .scan_files import ScanError, ScanFile
from .skeleton import Skeleton


def find_armature(things: Sequence[bpy.types.Object], scan_file: ScanFile) -> bpy.types.Object | None:
    """The armature that moves meshes; None where none does. Raises ScanError where several do."""
    used = {armature for thing in things if thing.type == "MESH" for armature in [moved_by(thing)] if armature}
    if len(used) > 1:
        names = ", ".join(sorted(armature.name for armature in used))
        raise ScanError(
            f"{scan_file.path} holds {len(used)} skeletons ({names}): save each person in a file of its own"
        )
    return next(iter(used), None)


def moved_by(mesh: bpy.types.Object) -> bpy.types.Object | None:
    """The armature that a mesh follows, by a modifier or as a child of it or of one of its bones."""
    for modifier in mesh.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None:
            return modifier.object
    above = mesh
    while above is not None:
        if above.parent is not None and above.parent.type == "ARMATURE":
            return above.parent if above.parent_type == "BONE" else None
        above = above.parent
    return None


def split_meshes(
    things: Sequence[bpy.types.Object], scan_file: ScanFile
) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """Meshes with faces that follow the armature, and those that do not. Raises ScanError where no mesh has a face."""
    meshes = [thing for thing in things if thing.type == "MESH" and len(thing.data.polygons)]
    if not meshes:
        raise ScanError(f"{scan_file.path} holds no surface: export the person's mesh, not only its skeleton or points")
    moving = [mesh for mesh in meshes if moved_by(mesh) is not None]
    return moving, [mesh for mesh in meshes if mesh not in moving]


def set_at_rest(armature: bpy.types.Object, meshes: Sequence[bpy.types.Object]) -> None:
    """No animation, no constraints, no pose; meshes blend matrices linearly, as SMPL does."""
    armature.animation_data_clear()
    armature.data.pose_position = "POSE"
    for bone in armature.pose.bones:
        for constraint in list(bone.constraints):
            bone.constraints.remove(constraint)
        bone.matrix_basis.identity()
        bone.rotation_mode = "QUATERNION"
        bone.location, bone.scale, bone.rotation_quaternion = (0, 0, 0), (1, 1, 1), (1, 0, 0, 0)
        bone.bone.use_inherit_rotation, bone.bone.inherit_scale, bone.bone.use_local_location = True, "FULL", True
    for mesh in meshes:
        mesh.animation_data_clear()
        if mesh.data.shape_keys is not None:
            mesh.data.shape_keys.animation_data_clear()
        for modifier in mesh.modifiers:
            if modifier.type == "ARMATURE":
                modifier.use_deform_preserve_volume = modifier.use_bone_envelopes = False
                modifier.use_vertex_groups = True
    bpy.context.view_layer.update()


def free_bones(armature: bpy.types.Object, names: Sequence[str]) -> None:
    """Let bones move off their parents' ends, where the rig glues them on."""
    glued = [name for name in names if armature.data.bones[name].use_connect]
    if not glued:
        return
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for name in glued:
        armature.data.edit_bones[name].use_connect = False
    bpy.ops.object.mode_set(mode="OBJECT")


def bone_heads(armature: bpy.types.Object, bones: Mapping[str, str]) -> dict[str, NDArray[np.float64]]:
    """Heads of bones at rest in the world, Blender's axes, by the keys of `bones` (key -> bone's name)."""
    world = np.array(armature.matrix_world)
    return {
        key: world[:3, :3] @ np.array(armature.data.bones[name].head_local) + world[:3, 3]
        for key, name in bones.items()
    }


def to_backend(places: Mapping[str, NDArray]) -> dict[str, NDArray[np.float64]]:
    """The same places, y up."""
    return {key: points_to_backend(place) for key, place in places.items()}


def skeleton_of(
    armature: bpy.types.Object, joints: Mapping[str, str], at_rest: NDArray, body_joints: NDArray
) -> Skeleton:
    """The armature at rest in the world, whose bones `joints` (SMPL's name -> the bone's) are SMPL's."""
    joint_of = {bone: JOINT_NAMES.index(joint) for joint, bone in joints.items()}
    bones = _parents_first(armature)
    names = [bone.name for bone in bones]
    world = np.array(armature.matrix_world)
    turn = BLENDER_FROM_BACKEND.T @ world[:3, :3] / uniform_scale(armature)
    rest = np.array([np.array(bone.matrix_local) for bone in bones])
    return Skeleton(
        names=names,
        parents=[names.index(bone.parent.name) if bone.parent is not None else -1 for bone in bones],
        heads=points_to_backend(rest[:, :3, 3] @ world[:3, :3].T + world[:3, 3]),
        axes=turn @ rest[:, :3, :3],
        joint=np.array([joint_of.get(name, -1) for name in names]),
        at_rest=at_rest,
        body_joints=body_joints,
    )


def uniform_scale(armature: bpy.types.Object) -> float:
    """World metres a unit of the armature."""
    return float(abs(np.linalg.det(np.array(armature.matrix_world)[:3, :3])) ** (1 / 3))


def add_root(
    context: bpy.types.Context, things: Sequence[bpy.types.Object], name: str, placing: NDArray
) -> bpy.types.Object:
    """An empty above all that has no parent yet, which moves everything by `placing` [4, 4] in the world."""
    root = bpy.data.objects.new(f"{name} root", None)
    context.scene.collection.objects.link(root)
    for thing in things:
        if thing.parent is None:
            thing.parent = root
    root.matrix_world = Matrix(placing.tolist())
    context.view_layer.update()
    return root


def affine(linear: NDArray, shift: NDArray) -> NDArray[np.float64]:
    """The matrix [4, 4] of x -> linear x + shift."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


def _parents_first(armature: bpy.types.Object) -> list[bpy.types.Bone]:
    ordered = [bone for bone in armature.data.bones if bone.parent is None]
    for bone in ordered:  # grows while it is walked through
        ordered.extend(bone.children)
    return ordered
