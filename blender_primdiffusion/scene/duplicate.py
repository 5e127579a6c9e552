"""Duplicate and rename humans: all of their parts, and what points to these."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

import bpy

from .human import armature_of, volumes_of
from .surface import build_surface, carrier_of, node_inputs, set_node_input

LONGEST = 40
"""Characters; parts of people add to it, and Blender's names end at 63."""


def duplicate_human(collection: bpy.types.Collection) -> bpy.types.Collection:
    """A copy of a person in the same place, linked beside them; posing, reshaping and editing one leaves the other.

    Everything in the person's collections comes along, and what points to a part of the person points to the copy's.
    Files are shared, and so are the volumes' data, which edits copy before they change them (see `shape.own_data`).
    Raises ValueError for a collection that holds no person.
    """
    armature_of(collection)
    shared = {thing for objects in volumes_of(collection).values() for thing in objects}
    twin = collection.copy()
    twins: dict[Any, Any] = {collection: twin}
    _copy_children(twin, twins)
    objects = [thing for thing in collection.all_objects if thing not in twins]
    for thing in objects:
        twins[thing] = thing.copy()
    for copy in [twins[key] for key in list(twins) if isinstance(key, bpy.types.Collection)]:
        for thing in list(copy.objects):
            copy.objects.unlink(thing)
            copy.objects.link(twins[thing])
    for thing in objects:
        if thing.data is not None and thing not in shared:
            twins[thing].data = thing.data.copy()
        _own(thing, twins[thing], twins)
    for holder in _holders(collection):
        holder.children.link(twin)
    _name_parts(collection, twin, twins)
    keep_surface(twin)
    return twin


def rename_human(collection: bpy.types.Collection, name: str) -> None:
    """Call a person `name`, and their armature, body mesh and volumes after it; files on disk keep their names.

    Parts that somebody has renamed keep their names. Blender adds a number where the name is taken. Raises ValueError
    for an empty name and for a person who is linked.
    """
    armature = armature_of(collection)
    name = name.strip()[:LONGEST]
    if not name:
        raise ValueError(f"the person {collection.name!r} needs a name: type one")
    linked = next((thing.library for thing in (collection, armature) if thing.library is not None), None)
    if linked is not None:
        raise ValueError(f"the person {collection.name!r} is linked from {linked.filepath!r}: rename them there")
    before = collection.name
    collection.name = name
    parts = [*collection.children_recursive, *collection.all_objects]
    shared = {thing.data for thing in collection.all_objects if thing.data is not None}
    for part in [*parts, *shared]:
        new = part_name(part.name, before, collection.name)
        if part.library is None and new != part.name:
            part.name = new
    keep_surface(collection)


def part_name(name: str, before: str, after: str) -> str:
    """What a part is called once the person who was `before` is `after`."""
    if name == before or name.startswith(f"{before}_"):
        return after + name[len(before) :]
    return name


def keep_surface(collection: bpy.types.Collection) -> None:
    """Have a person attached to their surface show the same volumes after names have changed: its nodes sort by name.

    Where the body mesh or the body's file is gone nothing can be kept, and nothing is shown there either.
    """
    if carrier_of(collection) is not None:
        with contextlib.suppress(ValueError, FileNotFoundError):
            build_surface(collection)


def _copy_children(copy: bpy.types.Collection, twins: dict[Any, Any]) -> None:
    for child in list(copy.children):
        copy.children.unlink(child)
        twins[child] = child.copy()
        copy.children.link(twins[child])
        _copy_children(twins[child], twins)


def _own(thing: bpy.types.Object, copy: bpy.types.Object, twins: dict[Any, Any]) -> None:
    """Give the copy an action of its own, and turn what it points to into the copies."""
    if thing.animation_data is not None and thing.animation_data.action is not None:
        slot = thing.animation_data.action_slot
        copy.animation_data.action = thing.animation_data.action.copy()
        if slot is not None:
            copy.animation_data.action_slot = copy.animation_data.action.slots[slot.identifier]
    if copy.parent in twins:
        inverse = copy.matrix_parent_inverse.copy()
        copy.parent = twins[copy.parent]
        copy.matrix_parent_inverse = inverse
    bones = copy.pose.bones if copy.pose is not None else ()
    for pointing in (*copy.modifiers, *copy.constraints, *(one for bone in bones for one in bone.constraints)):
        _point_to(pointing, twins)
        for target in getattr(pointing, "targets", ()):
            _point_to(target, twins)
        _point_sockets_to(pointing, twins)


def _point_to(pointing: Any, twins: dict[Any, Any]) -> None:
    for prop in pointing.bl_rna.properties:
        if prop.type == "POINTER" and not prop.is_readonly:
            value = getattr(pointing, prop.identifier)
            if isinstance(value, bpy.types.ID) and value in twins:
                setattr(pointing, prop.identifier, twins[value])


def _point_sockets_to(modifier: Any, twins: dict[Any, Any]) -> None:
    """The inputs of a Geometry Nodes modifier are no properties of its type."""
    if getattr(modifier, "type", "") == "NODES":
        for socket, value in node_inputs(modifier).items():
            if isinstance(value, bpy.types.ID) and value in twins:
                set_node_input(modifier, socket, twins[value])


def _holders(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    every: Iterable[bpy.types.Collection] = (*bpy.data.collections, *(scene.collection for scene in bpy.data.scenes))
    return [holder for holder in every if collection in list(holder.children)]


def _name_parts(collection: bpy.types.Collection, twin: bpy.types.Collection, twins: dict[Any, Any]) -> None:
    """Call the parts of the copy as those of the person are called."""
    for part, copy in twins.items():
        copy.name = part_name(part.name, collection.name, twin.name)
        data = getattr(copy, "data", None)
        if data is not None and data != part.data:
            data.name = part_name(part.data.name, collection.name, twin.name)
