"""Who is in the picture: people's armatures as the dependency graph has evaluated them, in the backend's terms."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..scene.convention import transforms_to_backend
from ..scene.files import person_file
from ..scene.human import BETAS, MARK
from .visible import visible_instances

SMALLEST_SCALE = 1e-4
"""Animators hide things by scaling them to nothing: below this a person is smaller than a hair is thick."""


@dataclasses.dataclass(frozen=True)
class Posed:
    """One person as the child wants them; backend axes, metres."""

    file: Path
    object_to_world: NDArray[np.float64]
    """[3, 4] of the armature object."""
    joints: NDArray[np.float64]
    """[24, 3, 4], rest to pose in the armature's space, of SMPL's joints."""
    betas: list[float] | None
    """The body's shape; None for the file's."""
    pelvis: NDArray[np.float64]
    """Where they are [3]: Blender's world."""

    def params(self) -> dict[str, object]:
        """As the request `draw` wants it."""
        return {
            "human": str(self.file),
            "object": self.object_to_world.tolist(),
            "joints": self.joints.tolist(),
            "betas": self.betas,
        }


def posed_people(depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None) -> list[Posed]:
    """Everybody whose armature is visible, in a viewport where one is given; instances included.

    An armature stands for its person: it is hidden with it and shown wherever it is instanced. One that is scaled to
    nothing has nothing to show. Raises FileNotFoundError for a person whose file is missing and ValueError for a shape
    that is no list of numbers or a pose that holds NaN.
    """
    owners = dict(_armatures())
    people = []
    for instance in visible_instances(depsgraph, space):
        thing = instance.object
        owner = owners.get(thing.original) if thing.type == "ARMATURE" else None
        matrix = np.array(instance.matrix_world, np.float64)
        if owner is not None and not abs(np.linalg.det(matrix[:3, :3])) < SMALLEST_SCALE**3:
            people.append(posed(thing, matrix, owner))
    return people


def _armatures() -> Iterator[tuple[bpy.types.Object, bpy.types.Collection]]:
    """Each armature with SMPL's joints in a person's collection, in this file and in linked ones."""
    for collection in bpy.data.collections:
        if MARK not in collection:
            continue
        for thing in collection.objects:
            if thing.type == "ARMATURE" and all(name in thing.data.bones for name in JOINT_NAMES):
                yield thing, collection


def posed(armature: bpy.types.Object, matrix: NDArray, owner: bpy.types.Collection) -> Posed:
    """A person as their armature is posed, its object at `matrix` [4, 4]. Raises as `posed_people` does."""
    bones = armature.pose.bones
    posed = np.array([bones[name].matrix for name in JOINT_NAMES], np.float64)
    rest = np.array([bones[name].bone.matrix_local for name in JOINT_NAMES], np.float64)
    if not (np.isfinite(posed).all() and np.isfinite(matrix).all()):
        raise ValueError(f"the armature of {owner.name!r} holds NaN or infinite numbers: check its pose and drivers")
    return Posed(
        person_file(owner),
        transforms_to_backend(matrix),
        transforms_to_backend(posed @ np.linalg.inv(rest)),
        _betas(armature, owner.name),
        (matrix @ posed[0])[:3, 3],
    )


def _betas(armature: bpy.types.Object, name: str) -> list[float] | None:
    if BETAS not in armature:
        return None
    try:
        return [float(value) for value in armature[BETAS]]
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"the custom property {BETAS!r} on the armature of {name!r} is {armature[BETAS]!r}; "
            "make it a list of ten numbers, or delete it"
        ) from error
