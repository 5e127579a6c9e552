"""A Volume object for every primitive of a human, which the bones of the armature move by linear blend skinning."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.rotation import matrix_to_quaternion
from .armature import floor_below
from .convention import frames_to_blender, points_to_blender
from .human import home_of, volume_name
from .material import volume_material
from .payload import session_file
from .rest_human import shape_model_of
from .shape import betas_of, generated_betas


def build_volumes(person: bpy.types.Object) -> bpy.types.Collection:
    """Give a human a volume for every primitive, hidden in views, in a collection of their own; writes no files.

    Raises as `shape_model_of` and `session_file`. Makes no undo step.
    """
    model, betas = shape_model_of(person), betas_of(person)
    rest, growth = model.rest(betas), model.growth(generated_betas(person), betas)
    folder, origin = session_file(person).parent, floor_below(points_to_blender(rest.vertices))
    primitives = bpy.data.collections.new(f"{person.name}_primitives")
    primitives.hide_viewport = True
    home_of(person).children.link(primitives)
    primitives.objects.link(person)  # the Outliner then shows the volumes inside the armature's closed row
    volumes = attach_volumes(
        person.name,
        person,
        primitives,
        [folder / volume_name(k) for k in range(len(rest.position))],
        points_to_blender(rest.position) + origin,
        frames_to_blender(rest.rotation),
        model.primitive_weights(),
        volume_material(),
    )
    for volume, scale in zip(volumes, growth.tolist(), strict=True):
        volume.scale = scale
    return primitives


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
    """A Volume object for each file, in `collection`, with rest position [K, 3] and rotation [K, 3, 3] (z up).

    Parented to the armature, with an Armature constraint of one target per non-zero weight [K, 24] and preserve volume
    off: the evaluated matrix is A (sum_j w_j G_j) [rotation | position], with the armature object's matrix A and SMPL's
    skinning transforms G_j. It shears where joints bend, as linear blending does. Turns off the viewports' relationship
    lines, of which there would be thousands.
    """
    hide_relationship_lines()
    positions, quaternions = np.asarray(position).tolist(), matrix_to_quaternion(rotation).tolist()
    targets = _targets(weights)
    labels = [f"{name}_prim_{k:04d}" for k in range(len(files))]
    volumes = _volumes(f"{name}_prim", material, len(files))
    objects = [bpy.data.objects.new(label, volume) for label, volume in zip(labels, volumes, strict=True)]
    prototypes: dict[tuple[str, ...], bpy.types.ArmatureConstraint] = {}
    for k, primitive in enumerate(objects):  # a loop of its own: new data make these changes slow
        volume = volumes[k]
        volume.filepath = str(files[k])
        primitive.parent = armature
        primitive.rotation_mode = "QUATERNION"
        primitive.location = positions[k]
        primitive.rotation_quaternion = quaternions[k]
        bones = tuple(bone for bone, _ in targets[k])
        if bones in prototypes:
            constraint = primitive.constraints.copy(prototypes[bones])
        else:
            constraint = prototypes[bones] = _armature_constraint(primitive, armature, bones)
        constraint.targets.foreach_set("weight", [weight for _, weight in targets[k]])
        collection.objects.link(primitive)
    return objects


def _volumes(name: str, material: bpy.types.Material, count: int) -> list[bpy.types.Volume]:
    """New volume data without files, which Blender numbers.

    Appending a material takes a time in proportion to the number of objects in the file; copies do not.
    """
    first = bpy.data.volumes.new(name)
    first.render.space = "WORLD"
    first.materials.append(material)
    return [first, *(first.copy() for _ in range(count - 1))][:count]


def _armature_constraint(
    primitive: bpy.types.Object, armature: bpy.types.Object, bones: Sequence[str]
) -> bpy.types.ArmatureConstraint:
    """A new constraint of `primitive` with these targets, which copies have too: setting them takes longer."""
    constraint = primitive.constraints.new("ARMATURE")
    constraint.use_deform_preserve_volume = False
    for bone in bones:
        target = constraint.targets.new()
        target.target = armature
        target.subtarget = bone
    return constraint


def _targets(weights: NDArray) -> list[list[tuple[str, float]]]:
    """Bones and their non-zero weights for each row of weights [K, 24]."""
    rows, joints = np.nonzero(weights)
    found: list[list[tuple[str, float]]] = [[] for _ in weights]
    for row, joint, weight in zip(rows.tolist(), joints.tolist(), weights[rows, joints].tolist(), strict=True):
        found[row].append((JOINT_NAMES[joint], weight))
    return found


def hide_relationship_lines() -> None:
    """Turn Blender's dashed lines from children to parents off in the 3D viewports of all workspaces: a human's
    volumes would have two thousand. Overlays > Relationship Lines shows them again."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.overlay.show_relationship_lines = False
