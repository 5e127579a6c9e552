"""Copies of a human's armature that Blender's own operators make (Shift-D, Alt-D): each becomes a human of its own.

Such a copy is in the collections of its original, without body mesh and volumes unless these were selected too.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import bpy

from ..formats.joints import JOINT_NAMES
from .duplicate import copy_children, copy_data, enter_scenes, redirect
from .human import BODY_MARK, MARK, volume_path
from .proxy import PROXY_MARK
from .stand_in import STAND_IN
from .surface import MARK as CARRIER_MARK

_MARKS = (BODY_MARK, PROXY_MARK, CARRIER_MARK, STAND_IN)
"""Custom properties by which parts that are meshes are recognised."""


def separate_copies() -> list[str]:
    """Make a human of each copy of an armature in this .blend; returns their names. Makes no undo step.

    Linked humans and library overrides stay as they are.
    """
    made = []
    for person in list(bpy.data.collections):
        if MARK in person and person.library is None and person.override_library is None:
            _adopt_parts(person)
            own, copied = _own_and_copied(person)
            made += [_human_of(person, own, armature).name for armature in copied]
    return made


def any_copies() -> bool:
    """Whether there is anything for `separate_copies`; for handlers of frequent events."""
    own = (c for c in bpy.data.collections if MARK in c and c.library is None and c.override_library is None)
    return any(len(_armatures(person)) > 1 or _lost_armature(person) for person in own)


def _own_and_copied(person: bpy.types.Collection) -> tuple[bpy.types.Object | None, list[bpy.types.Object]]:
    """The armature that the human's parts follow, and the others, the earliest first."""
    armatures = _armatures(person)
    if len(armatures) < 2:
        return next(iter(armatures), None), []
    followed = {obj.parent for obj in person.all_objects}
    own = next((armature for armature in armatures if armature in followed), armatures[0])
    return own, [armature for armature in armatures if armature != own]


def _armatures(person: bpy.types.Collection) -> list[bpy.types.Object]:
    """Armatures with SMPL's joints, which are drawn as humans."""
    found = [obj for obj in person.objects if obj.type == "ARMATURE"]
    return [obj for obj in found if all(name in obj.data.bones for name in JOINT_NAMES)] if len(found) > 1 else found


def _human_of(
    person: bpy.types.Collection, own: bpy.types.Object | None, armature: bpy.types.Object
) -> bpy.types.Collection:
    """Make a human of `armature`, a copy of `own`, and of what was copied with it; other parts are copied now."""
    copied = {obj for obj in person.all_objects if _follows(obj, armature)}
    by_kind = defaultdict(list)
    for obj in sorted(copied, key=lambda obj: obj.name):
        by_kind[_kind(obj)].append(obj)
    twin = person.copy()
    copies: dict[Any, Any] = {person: twin, own: armature}
    copy_children(twin, copies)
    new = []
    for part in [obj for obj in person.all_objects if obj not in copied and _kind(obj) and _follows(obj, own)]:
        if by_kind[_kind(part)]:
            copies[part] = by_kind[_kind(part)].pop(0)
        else:
            copies[part] = part.copy()
            new.append(part)
    copied.add(armature)
    pairs = [(source, copy) for source, copy in copies.items() if isinstance(source, bpy.types.Collection)]
    for _, copy in pairs:
        _replace_objects(copy, copies, copied)
    copy_data([part for part in new if part.type != "VOLUME"], copies)
    for obj in {*copied, *(copies[part] for part in new)}:
        redirect(obj, copies)
    enter_scenes(person, twin, copies)
    for source, _ in pairs:  # only now: an object that is in no scene is deselected
        for obj in copied.intersection(source.objects):
            source.objects.unlink(obj)
    return twin


def _replace_objects(collection: bpy.types.Collection, copies: dict[Any, Any], copied: set[bpy.types.Object]) -> None:
    """In a copied collection, put copies in place of originals, and keep what the user has copied."""
    before = set(collection.objects)
    for obj in before - copied:
        collection.objects.unlink(obj)
        if obj in copies and copies[obj] not in before:
            collection.objects.link(copies[obj])


def _follows(obj: bpy.types.Object, armature: bpy.types.Object) -> bool:
    """Whether an object is below the armature."""
    parent = obj.parent
    while parent is not None and parent != armature:
        parent = parent.parent
    return parent is not None


def _kind(obj: bpy.types.Object) -> str:
    """What part of a human an object is, the same for its copies; empty for other objects."""
    if obj.type == "VOLUME":
        path = volume_path(obj.data)
        return path.name if path is not None else ""
    return next((mark for mark in _MARKS if mark in obj), "") if obj.type == "MESH" else ""


def _lost_armature(person: bpy.types.Collection) -> bool:
    """Whether the armature that the volumes followed was deleted, while another is left."""
    volume = next((obj for obj in person.all_objects if obj.type == "VOLUME"), None)
    if volume is None or volume.parent is not None or not _armatures(person):
        return False
    targets = [target.target for constraint in volume.constraints for target in getattr(constraint, "targets", ())]
    return bool(targets) and not any(targets)


def _adopt_parts(person: bpy.types.Collection) -> None:
    """Have the human's parts follow the earliest copy, where their own armature was deleted."""
    if not _lost_armature(person):
        return
    armature = _armatures(person)[0]
    for part in [obj for obj in person.all_objects if _kind(obj) and obj.parent is None]:
        inverse = part.matrix_parent_inverse.copy()
        part.parent = armature
        part.matrix_parent_inverse = inverse
        for modifier in part.modifiers:
            if modifier.type == "ARMATURE" and modifier.object is None:
                modifier.object = armature
        for constraint in part.constraints:
            for target in getattr(constraint, "targets", ()):
                target.target = target.target or armature
