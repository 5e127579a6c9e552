"""Duplicate and rename humans: all of their parts, and what points to these."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

import bpy

from .human import armature_of, volumes_of
from .surface import build_surface, carrier_of, node_inputs, set_node_input

LONGEST_NAME = 40
"""Characters of a human's name; names of its parts are longer, and Blender allows 63."""


def duplicate_human(collection: bpy.types.Collection) -> bpy.types.Collection:
    """Copy a human, in the same place and scene; posing, reshaping and editing one leaves the other unchanged.

    Everything in the human's collections is copied, and pointers to parts of the human become pointers to the copies.
    Files are shared, and so is the volumes' data, which edits copy before they change it (see `human.own_data`). Raises
    ValueError for a collection that is no human.
    """
    armature_of(collection)
    shared = {obj for objects in volumes_of(collection).values() for obj in objects}
    duplicate = collection.copy()
    copies: dict[Any, Any] = {collection: duplicate}
    copy_children(duplicate, copies)
    objects = [obj for obj in collection.all_objects if obj not in copies]
    for obj in objects:
        copies[obj] = obj.copy()
    for copy in [copies[key] for key in list(copies) if isinstance(key, bpy.types.Collection)]:
        for obj in list(copy.objects):
            copy.objects.unlink(obj)
            copy.objects.link(copies[obj])
    copy_data([obj for obj in objects if obj not in shared], copies)
    for obj in objects:
        _copy_action(obj, copies[obj])
        redirect(copies[obj], copies)
    enter_scenes(collection, duplicate, copies)
    return duplicate


def copy_data(objects: Iterable[bpy.types.Object], copies: dict[Any, Any]) -> None:
    """Give the copies of these objects data of their own, shared among them as the originals' is."""
    made: dict[Any, Any] = {}
    for obj in objects:
        if obj.data is not None:
            made[obj.data] = made.get(obj.data) or obj.data.copy()
            copies[obj].data = made[obj.data]


def enter_scenes(collection: bpy.types.Collection, duplicate: bpy.types.Collection, copies: dict[Any, Any]) -> None:
    """Link a duplicate wherever the original is, and name its parts."""
    for holder in _holders(collection):
        holder.children.link(duplicate)
    _name_parts(collection, duplicate, copies)
    rebuild_surface(duplicate)


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
        new = part_name(part.name, before, collection.name)
        if part.library is None and new != part.name:
            part.name = new
    rebuild_surface(collection)


def part_name(name: str, before: str, after: str) -> str:
    """The name of a part of a human that is renamed from `before` to `after`."""
    if name == before or name.startswith(f"{before}_"):
        return after + name[len(before) :]
    return name


def rebuild_surface(collection: bpy.types.Collection) -> None:
    """Update the surface attachment after names have changed, since its nodes sort volumes by name.

    Where the body mesh or the body's file is missing, the attachment shows nothing anyway.
    """
    if carrier_of(collection) is not None:
        with contextlib.suppress(ValueError, FileNotFoundError):
            build_surface(collection)


def copy_children(copy: bpy.types.Collection, copies: dict[Any, Any]) -> None:
    """Replace the children of a copied collection, and theirs, by copies, which are added to `copies`."""
    for child in list(copy.children):
        copy.children.unlink(child)
        copies[child] = child.copy()
        copy.children.link(copies[child])
        copy_children(copies[child], copies)


def _copy_action(obj: bpy.types.Object, copy: bpy.types.Object) -> None:
    if obj.animation_data is not None and obj.animation_data.action is not None:
        slot = obj.animation_data.action_slot
        copy.animation_data.action = obj.animation_data.action.copy()
        if slot is not None:
            copy.animation_data.action_slot = copy.animation_data.action.slots[slot.identifier]


def redirect(copy: bpy.types.Object, copies: dict[Any, Any]) -> None:
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
        copy.name = part_name(part.name, collection.name, duplicate.name)
        data = getattr(copy, "data", None)
        if data is not None and data != part.data:
            data.name = part_name(part.data.name, collection.name, duplicate.name)
