"""Copies of humans: all of their parts, and what points to these. Renaming a human renames the same parts.

Blender's own operators (Shift-D, Alt-D) copy a human's armature into the collections of its original, without body mesh
and volumes unless these were selected too: `separate_copies` makes each such armature a human of its own.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import bpy

from ..formats.joints import JOINT_NAMES
from .human import BODY_MARK, MARK, armature_of, volume_path, volumes_of
from .proxy import PROXY_MARK
from .splats import CELLS_MARK, SPLATS_MARK
from .stand_in import STAND_IN
from .surface import MARK as CARRIER_MARK
from .surface import build_surface, carrier_of, node_inputs, set_node_input

LONGEST_NAME = 40
"""Characters of a human's name; names of its parts are longer, and Blender allows 63."""
_MARKS = (BODY_MARK, PROXY_MARK, CARRIER_MARK, STAND_IN, SPLATS_MARK, CELLS_MARK)
"""Custom properties by which parts that are no volumes are recognised."""


def duplicate_human(collection: bpy.types.Collection) -> bpy.types.Collection:
    """Copy a human, in the same place and scene; posing, reshaping and editing one leaves the other unchanged.

    Everything in the human's collections is copied, and pointers to parts of the human become pointers to the copies.
    Files are shared, and so is the data of volumes and splats, which edits copy before they change it (see
    `human.own_data`). Raises ValueError for a collection that is no human.
    """
    armature_of(collection)
    shared = {obj for objects in volumes_of(collection).values() for obj in objects}
    shared |= {obj for obj in collection.all_objects if obj.type == "POINTCLOUD"}
    duplicate = collection.copy()
    copies: dict[Any, Any] = {collection: duplicate}
    _copy_children(duplicate, copies)
    objects = [obj for obj in collection.all_objects if obj not in copies]
    for obj in objects:
        copies[obj] = obj.copy()
    for copy in [copies[key] for key in list(copies) if isinstance(key, bpy.types.Collection)]:
        for obj in list(copy.objects):
            copy.objects.unlink(obj)
            copy.objects.link(copies[obj])
    _copy_data([obj for obj in objects if obj not in shared], copies)
    for obj in objects:
        _copy_action(obj, copies[obj])
        _redirect(copies[obj], copies)
    _enter_scenes(collection, duplicate, copies)
    return duplicate


def _copy_data(objects: Iterable[bpy.types.Object], copies: dict[Any, Any]) -> None:
    """Give the copies of these objects data of their own, shared among them as the originals' is."""
    made: dict[Any, Any] = {}
    for obj in objects:
        if obj.data is not None:
            made[obj.data] = made.get(obj.data) or obj.data.copy()
            copies[obj].data = made[obj.data]


def _enter_scenes(collection: bpy.types.Collection, duplicate: bpy.types.Collection, copies: dict[Any, Any]) -> None:
    """Link a duplicate wherever the original is, and name its parts."""
    for holder in _holders(collection):
        holder.children.link(duplicate)
    _name_parts(collection, duplicate, copies)
    _rebuild_surface(duplicate)


def rename_human(collection: bpy.types.Collection, name: str) -> None:
    """Rename a human, and the armature, body mesh and volumes that are named after it; files keep their names.

    Parts that the user has renamed keep their names. Blender adds a number where the name is taken. Raises ValueError
    for an empty name and for a linked human.
    """
    armature = armature_of(collection)
    name = name.strip()[:LONGEST_NAME]
    if not name:
        raise ValueError(f"the human {collection.name!r} needs a name: type one")
    linked = next((obj.library for obj in (collection, armature) if obj.library is not None), None)
    if linked is not None:
        raise ValueError(f"the human {collection.name!r} is linked from {linked.filepath!r}: rename it there")
    before = collection.name
    collection.name = name
    parts = [*collection.children_recursive, *collection.all_objects]
    shared = {obj.data for obj in collection.all_objects if obj.data is not None}
    for part in [*parts, *shared]:
        new = _part_name(part.name, before, collection.name)
        if part.library is None and new != part.name:
            part.name = new
    _rebuild_surface(collection)


def _part_name(name: str, before: str, after: str) -> str:
    """The name of a part of a human that is renamed from `before` to `after`."""
    if name == before or name.startswith(f"{before}_"):
        return after + name[len(before) :]
    return name


def _rebuild_surface(collection: bpy.types.Collection) -> None:
    """Update the surface attachment after names have changed, since its nodes sort volumes by name.

    Where the body mesh or the body's file is missing, the attachment shows nothing anyway.
    """
    if carrier_of(collection) is not None:
        with contextlib.suppress(ValueError, FileNotFoundError):
            build_surface(collection)


def _copy_children(copy: bpy.types.Collection, copies: dict[Any, Any]) -> None:
    """Replace the children of a copied collection, and theirs, by copies, which are added to `copies`."""
    for child in list(copy.children):
        copy.children.unlink(child)
        copies[child] = child.copy()
        copy.children.link(copies[child])
        _copy_children(copies[child], copies)


def _copy_action(obj: bpy.types.Object, copy: bpy.types.Object) -> None:
    if obj.animation_data is not None and obj.animation_data.action is not None:
        slot = obj.animation_data.action_slot
        copy.animation_data.action = obj.animation_data.action.copy()
        if slot is not None:
            copy.animation_data.action_slot = copy.animation_data.action.slots[slot.identifier]


def _redirect(copy: bpy.types.Object, copies: dict[Any, Any]) -> None:
    """Redirect an object's pointers to the copies."""
    if copy.parent in copies:
        inverse = copy.matrix_parent_inverse.copy()
        copy.parent = copies[copy.parent]
        copy.matrix_parent_inverse = inverse
    bones = copy.pose.bones if copy.pose is not None else ()
    for pointing in (*copy.modifiers, *copy.constraints, *(one for bone in bones for one in bone.constraints)):
        _point_to(pointing, copies)
        for target in getattr(pointing, "targets", ()):
            _point_to(target, copies)
        _point_sockets_to(pointing, copies)


def _point_to(pointing: Any, copies: dict[Any, Any]) -> None:
    for prop in pointing.bl_rna.properties:
        if prop.type == "POINTER" and not prop.is_readonly:
            value = getattr(pointing, prop.identifier)
            if isinstance(value, bpy.types.ID) and value in copies:
                setattr(pointing, prop.identifier, copies[value])


def _point_sockets_to(modifier: Any, copies: dict[Any, Any]) -> None:
    """Redirect the inputs of a Geometry Nodes modifier, which are not properties of its type."""
    if getattr(modifier, "type", "") == "NODES":
        for socket, value in node_inputs(modifier).items():
            if isinstance(value, bpy.types.ID) and value in copies:
                set_node_input(modifier, socket, copies[value])


def _holders(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    every: Iterable[bpy.types.Collection] = (*bpy.data.collections, *(scene.collection for scene in bpy.data.scenes))
    return [holder for holder in every if collection in list(holder.children)]


def _name_parts(collection: bpy.types.Collection, duplicate: bpy.types.Collection, copies: dict[Any, Any]) -> None:
    """Name the parts of the copy as those of the original are named."""
    for part, copy in copies.items():
        copy.name = _part_name(part.name, collection.name, duplicate.name)
        data = getattr(copy, "data", None)
        if data is not None and data != part.data:
            data.name = _part_name(part.data.name, collection.name, duplicate.name)


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
    _copy_children(twin, copies)
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
    _copy_data([part for part in new if part.type not in ("VOLUME", "POINTCLOUD")], copies)
    for obj in {*copied, *(copies[part] for part in new)}:
        _redirect(obj, copies)
    _enter_scenes(person, twin, copies)
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
    return next((mark for mark in _MARKS if mark in obj), "") if obj.type in ("MESH", "POINTCLOUD") else ""


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
