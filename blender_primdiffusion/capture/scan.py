"""Scans in the scene, posed by SMPL's joint rotations whatever their rig."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..files.regular_files import FileError, as_file_error
from ..formats.joints import JOINT_NAMES
from ..formats.poses.rigs import NAME_BONES, UNMATCHED, BoneMap, facing, map_bones, rig_from_smpl
from ..formats.poses.rotation import matrix_to_quaternion, to_axis_angle
from ..scene.convention import points_to_blender
from .bind import bind_static
from .body import Body, ShapeFit, fit_joints
from .registration import stand_up
from .rigged import (
    RigSkeleton,
    SkinnedSurface,
    add_root,
    affine,
    bone_heads,
    find_armature,
    free_bones,
    is_evenly_scaled,
    mesh_points,
    set_at_rest,
    skeleton_of,
    skinned_surface,
    split_meshes,
    to_backend,
    uniform_scale,
)
from .scan_files import ScanFile, import_file, own_betas
from .stage import AddedData
from .surfaces import complete_colours

_POOR_FIT_M = 0.05
_EXACT_M = 0.001
_T_REST_DEG = 10.0
_ROUNDS = 2
"""Rounds of fitting the shape and turning the limbs to that shape's rest."""
_OWN_NAMES = {name: name for name in JOINT_NAMES}


class Scan:
    """A scan in the scene. Its data-blocks stay in the file until `remove`."""

    def __init__(
        self,
        name: str,
        objects: Sequence[bpy.types.Object],
        armature: bpy.types.Object,
        skeleton: RigSkeleton,
        betas: NDArray,
        body: str,
        notes: Sequence[str],
        added: AddedData,
    ) -> None:
        self.name = name
        self.objects = list(objects)
        """Its meshes."""
        self.armature = armature
        self.skeleton = skeleton
        self.betas: NDArray[np.float64] = np.asarray(betas, np.float64)
        """Shape of the fitted body [10]."""
        self.body = body
        """Name of that body."""
        self.notes = list(notes)
        """What was found and done on loading, a sentence each."""
        self._added = added
        self._surface: SkinnedSurface = skinned_surface(self.objects, skeleton.names)

    def pose(self, rotations: NDArray, translation: NDArray) -> NDArray[np.float64]:
        """Take a pose: joint rotations [24, 3, 3] about the rest axes, y up, and a translation [3] in metres.

        Returns the joints [24, 3] in the world, y up, metres: the heads of the rig's own bones.
        """
        transforms = self.skeleton.transforms(rotations, translation)
        turns, moves = self.skeleton.bases(transforms)
        size = uniform_scale(self.armature)
        for name, quaternion, move in zip(self.skeleton.names, matrix_to_quaternion(turns), moves, strict=True):
            bone = self.armature.pose.bones[name]
            bone.rotation_mode = "QUATERNION"
            bone.rotation_quaternion = quaternion
            bone.location = move / size
        bpy.context.view_layer.update()
        return self.skeleton.joints(transforms)

    def bounds(self, rotations: NDArray, translations: NDArray) -> NDArray[np.float64]:
        """The outermost points [n, 3] of the surface over poses [F, 24, 3, 3] and [F, 3], y up, metres."""
        poses = zip(rotations, translations, strict=True)
        return self._surface.outermost(self.skeleton.transforms(*pose) for pose in poses)

    def joint_of_group(self, name: str) -> int | None:
        """The SMPL joint that moves the vertex group of this name: the bone's, or its nearest parent's."""
        if name not in self.skeleton.names:
            return None
        bone = self.skeleton.names.index(name)
        while bone >= 0:
            if self.skeleton.joint[bone] >= 0:
                return int(self.skeleton.joint[bone])
            bone = self.skeleton.parents[bone]
        return None

    def remove(self) -> None:
        """Remove everything that loading has added to the file."""
        self._added.remove()


def load_scan(context: bpy.types.Context, scan_file: ScanFile, body: Body) -> Scan:
    """Import a person into the context's scene: upright, facing forward, in metres, ready to be posed.

    A skinned person keeps its rig; `body` is fitted to its joints. A person without a rig needs SMPL parameters of
    `body` beside it and gets a rig. Raises FileError, and then leaves nothing in the file.
    """
    added = AddedData()
    try:
        with added:
            objects = import_file(scan_file.path)
            armature = find_armature(objects, scan_file)
            if armature is None:
                return _load_static(context, scan_file, body, objects, added)
            return _load_rigged(context, scan_file, body, objects, armature, added)
    except BaseException:
        added.remove()
        raise


def _load_static(context, scan_file: ScanFile, body: Body, objects, added: AddedData) -> Scan:
    """A scan without a rig: bound to the body in the pose of its parameters, and brought back to rest."""
    moving, still = split_meshes(objects, scan_file)
    meshes = [*moving, *still]
    bound = bind_static(context, scan_file, body, meshes)
    _discard(objects, meshes)
    notes = [*bound.notes, *complete_colours(meshes, scan_file.path)]
    skeleton = skeleton_of(bound.armature, _OWN_NAMES, _no_turns(), body.rest(bound.betas)[1])
    return Scan(scan_file.name, meshes, bound.armature, skeleton, bound.betas, body.name, notes, added)


def _load_rigged(context, scan_file: ScanFile, body: Body, objects, armature, added: AddedData) -> Scan:
    meshes, loose = split_meshes(objects, scan_file)
    if not is_evenly_scaled(armature):
        raise FileError(scan_file.path, "has a skeleton that is scaled unevenly", "apply its scale and export it again")
    set_at_rest(armature, meshes)
    with as_file_error(scan_file.path, UNMATCHED, NAME_BONES):
        bones = map_bones([bone.name for bone in armature.data.bones])
    with as_file_error(scan_file.path, "has no rest pose of a human", "export it again"):
        axes = facing(bone_heads(armature, bones.joints))
    free_bones(armature, list(bones.joints.values()))
    standing = stand_up(axes, mesh_points(meshes), str(scan_file.path))
    root = add_root(context, objects, scan_file.name, affine(standing.rotation * standing.scale, np.zeros(3)))
    skeleton, betas, fit_notes = _fit_rig(context, root, armature, bones, scan_file, body)
    notes = [*standing.notes, *fit_notes]
    if bones.rig != "SMPL":
        notes.append(f"bones as {bones.rig} names them")
    if loose:
        notes.append(f"left out, as no bone moves it: {', '.join(mesh.name for mesh in loose)}")
    _discard(objects, [*meshes, armature])
    notes += complete_colours(meshes, scan_file.path)
    return Scan(scan_file.name, meshes, armature, skeleton, betas, body.name, notes, added)


def _fit_rig(context, root, armature, bones: BoneMap, scan_file: ScanFile, body: Body):
    """The rig as a skeleton, moved onto the fitted body at rest; the betas of that body; notes."""
    heads, tips = to_backend(bone_heads(armature, bones.joints)), to_backend(bone_heads(armature, bones.tips))
    known = own_betas(scan_file.path)
    if known is not None and known[1] == body.name:
        joints = body.rest(np.array(known[0]))[1]
        if all(np.abs(heads[name] - joints[JOINT_NAMES.index(name)]).max() < _EXACT_M for name in heads):
            skeleton = skeleton_of(armature, bones.joints, _no_turns(), joints)
            return skeleton, np.array(known[0]), ["shape as stated in its file"]
    rest_joints = body.rest(np.zeros(0))[1]
    for _ in range(_ROUNDS):
        at_rest = rig_from_smpl(heads, tips, rest_joints)
        if bones.rig == "SMPL" and _largest_turn(at_rest) < _T_REST_DEG:
            at_rest = _no_turns()
        rig = skeleton_of(armature, bones.joints, at_rest, rest_joints)
        in_t = rig.joints(rig.transforms(_no_turns(), np.zeros(3)))
        fit = fit_joints(body, {name: in_t[JOINT_NAMES.index(name)] for name in heads})
        rest_joints = body.rest(fit.betas)[1]
    moved = affine(np.eye(3) * fit.scale, points_to_blender(fit.shift)) @ np.array(root.matrix_world)
    root.matrix_world = Matrix(moved.tolist())
    context.view_layer.update()
    return skeleton_of(armature, bones.joints, at_rest, rest_joints), fit.betas, _fit_notes(fit, at_rest)


def _fit_notes(fit: ShapeFit, at_rest: NDArray) -> list[str]:
    notes = [f"shape fitted to its joints, {fit.residual * 1000:.0f} mm off on average"]
    if fit.residual > _POOR_FIT_M:
        notes.append("no body fits well: masks and pictures are exact, the parameters only approximate")
    if abs(fit.scale - 1) > 0.005:
        notes.append(f"scaled by {fit.scale:.2f} to the size of a body")
    if _largest_turn(at_rest) > _T_REST_DEG:
        notes.append(
            f"its rest pose is not a T pose (limbs up to {_largest_turn(at_rest):.0f} degrees off): taken into account"
        )
    return notes


def _largest_turn(rotations: NDArray) -> float:
    return float(np.degrees(np.linalg.norm(to_axis_angle(rotations), axis=-1).max()))


def _no_turns() -> NDArray[np.float64]:
    return np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))


def _discard(objects: Sequence[bpy.types.Object], keep: Sequence[bpy.types.Object]) -> None:
    """Remove imported objects that are not part of the human: cameras, lights, stray meshes; parents stay."""
    parents = set()
    for obj in keep:
        above = obj.parent
        while above is not None:
            parents.add(above)
            above = above.parent
    for obj in objects:
        if obj not in keep and obj not in parents:
            bpy.data.objects.remove(obj)
