"""The density gain of a person: the shared material, or a copy of their own where they need another factor."""

from __future__ import annotations

import bpy

from .material import GAIN_NODE, volume_material

_SAME = 1e-4


def person_material(collection: bpy.types.Collection) -> bpy.types.Material:
    """What the person's volumes show, as their first one has it."""
    for data in _volumes(collection):
        if data.materials and data.materials[0] is not None:
            return data.materials[0]
    return volume_material()


def density_gain(collection: bpy.types.Collection) -> float | None:
    """The factor on density in the person's material; None where somebody has given them one without it."""
    node = _gain_node(person_material(collection))
    return None if node is None else node.outputs[0].default_value


def set_density_gain(collection: bpy.types.Collection, gain: float) -> None:
    """Give a person this factor: the shared material where it is the usual one, else a material of their own.

    Raises ValueError for a person with a material that has no such factor, or a linked one.
    """
    material = person_material(collection)
    if _gain_node(material) is None:
        raise ValueError(
            f"the material {material.name!r} of {collection.name!r} has no node {GAIN_NODE!r}: give the person's "
            f"volumes the material {volume_material().name!r} again"
        )
    if material.library is not None or any(data.library is not None for data in _volumes(collection)):
        raise ValueError(f"the person {collection.name!r} is linked: make them local to change the density gain")
    current = _gain_node(material).outputs[0]
    if abs(current.default_value - gain) <= _SAME:
        return
    shown_to_others = _keep_own_data(collection)
    volumes = _volumes(collection)
    usual = _gain_node(volume_material()).outputs[0].default_value
    if abs(gain - usual) <= _SAME:
        _assign(volumes, volume_material())
        return
    shown_by = bpy.data.user_map(subset=[material])[material]
    if material == volume_material() or shown_to_others or not shown_by <= set(volumes):
        material = material.copy()
        material.name = f"{volume_material().name} {collection.name}"
        _assign(volumes, material)
        current = _gain_node(material).outputs[0]
    current.default_value = gain


def _keep_own_data(collection: bpy.types.Collection) -> bool:
    """Copy the data of volumes that objects of other people show too, as duplicates do; whether there were such."""
    own = [thing for thing in collection.all_objects if thing.type == "VOLUME"]
    mine = set(own)
    others = {thing.data for thing in bpy.data.objects if thing.type == "VOLUME" and thing not in mine}
    shared = [thing for thing in own if thing.data in others]
    for thing in shared:
        thing.data = thing.data.copy()
    return bool(shared)


def _volumes(collection: bpy.types.Collection) -> list[bpy.types.Volume]:
    return [thing.data for thing in collection.all_objects if thing.type == "VOLUME"]


def _gain_node(material: bpy.types.Material) -> bpy.types.Node | None:
    return None if material.node_tree is None else material.node_tree.nodes.get(GAIN_NODE)


def _assign(volumes: list[bpy.types.Volume], material: bpy.types.Material) -> None:
    for data in volumes:
        if data.materials:
            data.materials[0] = material
        else:
            data.materials.append(material)
