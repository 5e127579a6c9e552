"""Rigs of imported humans: their armatures at rest, any rig as a chain of bones posed by SMPL's joint rotations, and
the surface that follows it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..files.regular_files import FileError
from ..formats.camera_rig import bounding_sphere
from ..formats.joints import JOINT_NAMES, PARENTS
from ..formats.poses.skeleton import chain
from ..scene.convention import BLENDER_FROM_BACKEND, points_to_backend
from .scan_files import ScanFile

_EVEN = 0.02
"""Largest difference of scales, and of right angles, of an armature that counts as evenly scaled."""


@dataclasses.dataclass(frozen=True, eq=False)
class RigSkeleton:
    """A rig at rest in the world; metres, y up, facing +z."""

    names: list[str]
    """Names of the bones, parents first [N]."""
    parents: list[int]
    """Parent of each bone, -1 for a root."""
    heads: NDArray[np.float64]
    """[N, 3]."""
    axes: NDArray[np.float64]
    """World from the bone's own axes, rotations [N, 3, 3]."""
    joint: NDArray[np.int64]
    """The SMPL joint that each bone is [N]; -1 for fingers, twists and the like, which stay with their parents."""
    at_rest: NDArray[np.float64]
    """How each part is turned from SMPL's rest to the rig's [24, 3, 3] (`formats.poses.rigs`)."""
    body_joints: NDArray[np.float64]
    """The fitted body's joints at SMPL's rest [24, 3]: the whole turns about its pelvis."""

    def transforms(self, rotations: NDArray, translation: NDArray) -> NDArray[np.float64]:
        """What each bone does to points of the rig's rest [N, 4, 4] in a pose of SMPL's joints.

        A bone that is joint j turns by G_j A_j^T: back from the rig's rest to SMPL's, then as SMPL's joint in the
        world. Its head goes where its parent takes it; bones without a posed parent go where the body's pelvis does.
        """
        world = chain(np.asarray(rotations, np.float64))
        moves = world @ np.swapaxes(self.at_rest, -1, -2)
        out = np.tile(np.eye(4), (len(self.names), 1, 1))
        pelvis = self.body_joints[0]
        for bone, parent in enumerate(self.parents):
            joint = self.joint[bone]
            if parent >= 0:
                out[bone] = out[parent]
            if joint < 0:
                continue
            out[bone, :3, :3] = moves[joint]
            if self.is_top(bone):
                head = pelvis + world[0] @ (self.heads[bone] - pelvis) + translation
            else:
                head = out[parent, :3, :3] @ self.heads[bone] + out[parent, :3, 3]
            out[bone, :3, 3] = head - moves[joint] @ self.heads[bone]
        return out

    def is_top(self, bone: int) -> bool:
        """Whether a bone is a joint and none above it is."""
        if self.joint[bone] < 0:
            return False
        above = self.parents[bone]
        while above >= 0:
            if self.joint[above] >= 0:
                return False
            above = self.parents[above]
        return True

    def joints(self, transforms: NDArray) -> NDArray[np.float64]:
        """The 24 joints [24, 3]: the bones' heads, and for joints that the rig lacks the body's, off their parents."""
        bone_of = {int(joint): bone for bone, joint in enumerate(self.joint) if joint >= 0}
        places = np.zeros((len(JOINT_NAMES), 3))
        carrier = list(range(len(JOINT_NAMES)))
        for joint, parent in enumerate(PARENTS):
            bone = bone_of.get(joint)
            if bone is not None:
                places[joint] = transforms[bone, :3, :3] @ self.heads[bone] + transforms[bone, :3, 3]
                continue
            carrier[joint] = carrier[parent]
            turn = transforms[bone_of[carrier[joint]], :3, :3] @ self.at_rest[carrier[joint]]
            places[joint] = places[parent] + turn @ (self.body_joints[joint] - self.body_joints[parent])
        return places

    def bases(self, transforms: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Turns [N, 3, 3] of the pose bones in their own axes, and displacements [N, 3] of the tops, metres."""
        identity = np.eye(4)
        above = np.array([transforms[p] if p >= 0 else identity for p in self.parents])
        inverse = np.swapaxes(above[:, :3, :3], -1, -2)
        own = np.swapaxes(self.axes, -1, -2)
        turns = own @ inverse @ transforms[:, :3, :3] @ self.axes
        here = (transforms[:, :3, :3] @ self.heads[..., None])[..., 0] + transforms[:, :3, 3]
        carried = (above[:, :3, :3] @ self.heads[..., None])[..., 0] + above[:, :3, 3]
        moves = (own @ inverse @ (here - carried)[..., None])[..., 0]
        tops = np.array([self.is_top(bone) for bone in range(len(self.names))])
        return turns, np.where(tops[:, None], moves, 0.0)


def find_armature(objects: Sequence[bpy.types.Object], scan_file: ScanFile) -> bpy.types.Object | None:
    """The armature that moves meshes; None where none does. Raises FileError where several do."""
    used = {armature for obj in objects if obj.type == "MESH" for armature in [moved_by(obj)] if armature}
    if len(used) > 1:
        names = ", ".join(sorted(armature.name for armature in used))
        raise FileError(scan_file.path, f"holds {len(used)} skeletons ({names})", "save each person in its own file")
    return next(iter(used), None)


def moved_by(mesh: bpy.types.Object) -> bpy.types.Object | None:
    """The armature that a mesh follows, by a modifier or as a child of one of its bones."""
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
    objects: Sequence[bpy.types.Object], scan_file: ScanFile
) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """Meshes with faces that follow the armature, and those that do not. Raises FileError where no mesh has a face."""
    meshes = [obj for obj in objects if obj.type == "MESH" and len(obj.data.polygons)]
    if not meshes:
        raise FileError(scan_file.path, "holds no surface", "export the person's mesh, not only its skeleton or points")
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
    """Disconnect bones from the ends of their parents."""
    connected = [name for name in names if armature.data.bones[name].use_connect]
    if not connected:
        return
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for name in connected:
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
) -> RigSkeleton:
    """The armature at rest in the world, whose bones `joints` (SMPL's name -> the bone's) are SMPL's."""
    joint_of = {bone: JOINT_NAMES.index(joint) for joint, bone in joints.items()}
    bones = _parents_first(armature)
    names = [bone.name for bone in bones]
    world = np.array(armature.matrix_world)
    turn = BLENDER_FROM_BACKEND.T @ world[:3, :3] / uniform_scale(armature)
    rest = np.array([np.array(bone.matrix_local) for bone in bones])
    return RigSkeleton(
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


def is_evenly_scaled(armature: bpy.types.Object) -> bool:
    """Whether turns of the armature's bones are turns in the world; a mirrored armature's are."""
    linear = np.array(armature.matrix_world)[:3, :3] / uniform_scale(armature)
    return bool(np.abs(linear.T @ linear - np.eye(3)).max() < _EVEN)


def add_root(
    context: bpy.types.Context, objects: Sequence[bpy.types.Object], name: str, placing: NDArray
) -> bpy.types.Object:
    """An empty as parent of all objects without one, which moves everything by `placing` [4, 4] in the world."""
    root = bpy.data.objects.new(f"{name} root", None)
    context.scene.collection.objects.link(root)
    for obj in objects:
        if obj.parent is None:
            obj.parent = root
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
    for bone in ordered:  # grows while it is iterated
        ordered.extend(bone.children)
    return ordered


@dataclasses.dataclass(frozen=True, eq=False)
class SkinnedSurface:
    """All points of a surface at the rig's rest, and the bones that move each.

    The backend uses the same points, so that both programs place cameras alike.
    """

    points: NDArray[np.float64]
    """[n, 3], y up, metres."""
    bones: NDArray[np.int32]
    """[n, K]."""
    weights: NDArray[np.float32]
    """[n, K]; rows sum to 1."""

    def posed(self, transforms: NDArray) -> NDArray[np.float64]:
        """The points [n, 3] moved by bones [N, 4, 4]."""
        moved = np.zeros_like(self.points)
        for bone, weight in zip(self.bones.T, self.weights.T, strict=True):
            chosen = transforms[bone, :3]
            moved += weight[:, None] * (np.einsum("nij,nj->ni", chosen[..., :3], self.points) + chosen[..., 3])
        return moved

    def outermost(self, poses: Iterable[NDArray]) -> NDArray[np.float64]:
        """Points in all poses (transforms [N, 4, 4]) that have the same box and bounding sphere as all of them."""
        poses = list(poses)
        extremes = []
        for transforms in poses:
            posed = self.posed(transforms)
            extremes += [posed[posed.argmin(0)], posed[posed.argmax(0)]]
        centre, _ = bounding_sphere(np.concatenate(extremes))
        for transforms in poses:
            posed = self.posed(transforms)
            extremes.append(posed[[np.linalg.norm(posed - centre, axis=1).argmax()]])
        return np.concatenate(extremes)


def mesh_points(meshes: Sequence[bpy.types.Object]) -> NDArray[np.float64]:
    """Vertices [V, 3] of meshes in the world, Blender's axes, without modifiers."""
    clouds = []
    for mesh in meshes:
        local = np.empty(3 * len(mesh.data.vertices), np.float32)
        mesh.data.vertices.foreach_get("co", local)
        world = np.array(mesh.matrix_world)
        clouds.append(local.reshape(-1, 3).astype(np.float64) @ world[:3, :3].T + world[:3, 3])
    return np.concatenate(clouds)


def skinned_surface(meshes: Sequence[bpy.types.Object], bones: Sequence[str]) -> SkinnedSurface:
    """The surface of meshes that follow `bones`."""
    found = [_influences(mesh, bones) for mesh in meshes]
    most = max(index.shape[1] for index, _ in found)
    return SkinnedSurface(
        points_to_backend(mesh_points(meshes)),
        np.concatenate([_widened(index, most) for index, _ in found]),
        np.concatenate([_widened(weight, most) for _, weight in found]),
    )


def _widened(values: NDArray, columns: int) -> NDArray:
    return np.pad(values, ((0, 0), (0, columns - values.shape[1])))


def _influences(mesh: bpy.types.Object, bones: Sequence[str]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Bone indices and weights [V, K] of each vertex; the root's where no bone moves it."""
    number = {name: place for place, name in enumerate(bones)}
    if mesh.parent_type == "BONE" and mesh.parent_bone in number:
        alone = np.full((len(mesh.data.vertices), 1), number[mesh.parent_bone], np.int32)
        return alone, np.ones(alone.shape, np.float32)
    bone_of = {group.index: number[group.name] for group in mesh.vertex_groups if group.name in number}
    rows = [
        [(bone_of[e.group], e.weight) for e in vertex.groups if e.group in bone_of and e.weight > 0] or [(0, 1.0)]
        for vertex in mesh.data.vertices
    ]
    index = np.zeros((len(rows), max(len(row) for row in rows)), np.int32)
    weight = np.zeros(index.shape, np.float32)
    for vertex, row in enumerate(rows):
        index[vertex, : len(row)], weight[vertex, : len(row)] = zip(*row, strict=True)
    return index, weight / weight.sum(1, keepdims=True)
