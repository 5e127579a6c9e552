"""The limbs that IK handles move, and the bones that `handles` adds to an armature for them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

POLE_M = 0.4
"""From the limb to its pole, metres."""
_HANDLE_M, _POLE_LENGTH_M = 0.2, 0.1


@dataclasses.dataclass(frozen=True)
class Limb:
    """Two bones that reach for a handle and bend towards a pole."""

    root: str
    """SMPL's joint, as the next two."""
    middle: str
    end: str
    """Turns as the handle does."""
    handle: str
    """A bone without a parent, with the rest axes of `end`."""
    pole: str
    """A bone without a parent."""
    tip: str
    """A child of `middle`, from there to `end`: the middle bone's own tail leaves the joint when the shape changes."""
    bend: tuple[float, float, float]
    """Where the middle goes at rest when the limb bends, z up."""

    @property
    def joints(self) -> tuple[str, str, str]:
        """The joints that the handle moves."""
        return self.root, self.middle, self.end

    @property
    def controls(self) -> tuple[str, str, str]:
        """The bones that are added for the limb."""
        return self.handle, self.pole, self.tip

    def bend_axis(self, rest: NDArray) -> NDArray[np.float64]:
        """The axis of the root's bone, in its own space [3], that Blender turns to the pole; orthogonal to the bone.

        `rest` [3, 3] are the root's axes at rest.
        """
        x, _, z = np.asarray(rest, np.float64).T @ self.bend
        return np.array([x, 0.0, z]) / np.hypot(x, z)


def _limbs() -> Iterator[Limb]:
    for side in ("left", "right"):
        for root, middle, end, name, bend in (
            ("hip", "knee", "ankle", "foot", (0.0, -1.0, 0.0)),
            ("shoulder", "elbow", "wrist", "hand", (0.0, 1.0, 0.0)),
        ):
            controls = (f"{side}_{name}_ik", f"{side}_{middle}_pole", f"{side}_{name}_tip")
            yield Limb(f"{side}_{root}", f"{side}_{middle}", f"{side}_{end}", *controls, bend)


LIMBS = tuple(_limbs())
CONTROLS = tuple(name for limb in LIMBS for name in limb.controls)


def place_controls(bones: bpy.types.ArmatureEditBones) -> None:
    """Put the controls that there are where the joints are at rest. Handles keep their axes, so that poses and keys
    mean the same distances from rest and the same turns."""
    for limb in LIMBS:
        middle, end = bones[limb.middle].head.copy(), bones[limb.end].head.copy()
        if handle := bones.get(limb.handle):
            _put(handle, end, bones[limb.end].vector.normalized() * _HANDLE_M)
        if pole := bones.get(limb.pole):
            _put(pole, middle + Vector(limb.bend) * POLE_M, Vector((0.0, 0.0, _POLE_LENGTH_M)))
        if tip := bones.get(limb.tip):
            _put(tip, middle, end - middle)


def _put(bone: bpy.types.EditBone, head: Vector, along: Vector) -> None:
    bone.head, bone.tail = head, head + along
