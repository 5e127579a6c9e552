"""Volume objects that follow the armature: each frame is blended by linear blend skinning, exactly."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from .folders import stored_path
from .quaternion import matrix_to_quaternion
from .relationship_lines import hide_relationship_lines


def attach_volumes(
    name: str,
    armature: bpy.types.Object,
    collection: bpy.types.Collection,
    files: Sequence[Path],
    position: NDArray,
    rotation: NDArray,
    weights: NDArray,
    material: bpy.types.Material,
) -> list[bpy.types.Object]:
    """A Volume object for each file, in `collection`, at rest where position [K, 3] and rotation [K, 3, 3] (z up) say.

    Parented to the armature, with an Armature constraint of one target per non-zero weight [K, 24] and preserve volume
    off: the evaluated matrix is A (sum_j w_j G_j) [rotation | position], with the armature object's matrix A and SMPL's
    skinning transforms G_j. It shears where joints bend, as linear blending does. Turns off the viewports' relationship
    lines, of which there would be some thousand.
    """
    hide_relationship_lines()
    quaternions = matrix_to_quaternion(rotation)
    objects = []
    for k, path in enumerate(files):
        label = f"{name}_prim_{k:04d}"
        volume = bpy.data.volumes.new(label)
        volume.filepath = stored_path(path)
        volume.render.space = "WORLD"
        volume.materials.append(material)
        primitive = bpy.data.objects.new(label, volume)
        primitive.parent = armature
        primitive.matrix_parent_inverse = Matrix.Identity(4)
        primitive.rotation_mode = "QUATERNION"
        primitive.location = position[k]
        primitive.rotation_quaternion = quaternions[k]
        constraint = primitive.constraints.new("ARMATURE")
        constraint.use_deform_preserve_volume = False
        for joint in np.flatnonzero(weights[k]):
            target = constraint.targets.new()
            target.target = armature
            target.subtarget = JOINT_NAMES[joint]
            target.weight = weights[k, joint]
        collection.objects.link(primitive)
        objects.append(primitive)
    return objects
