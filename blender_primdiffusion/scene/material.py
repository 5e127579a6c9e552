"""The material of volumes, emission and absorption driven by the density grid, and each human's density gain."""

from __future__ import annotations

import bpy

from ..formats.requests import DENSITY_GAIN
from .human import parts_of

MATERIAL_NAME = "PrimDiffusion Volume"
GAIN_NODE = "Density Gain"


def volume_material() -> bpy.types.Material:
    """The shared material, made on first use.

    With s = gain * density, at first DENSITY_GAIN: emission of strength s and colour Cd, absorption of density s in
    black, so that a ray integrates Cd s exp(-integral of s): premultiplied colour.
    """
    existing = bpy.data.materials.get(MATERIAL_NAME)
    if existing is not None and existing.node_tree is not None and GAIN_NODE in existing.node_tree.nodes:
        return existing
    material = bpy.data.materials.new(MATERIAL_NAME)
    tree = material.node_tree
    tree.nodes.clear()

    def node(kind: str, x: float, y: float, **values: object) -> bpy.types.Node:
        made = tree.nodes.new(kind)
        made.location = (x, y)
        for key, value in values.items():
            setattr(made, key, value)
        return made

    colour = node("ShaderNodeAttribute", -600, 200, attribute_name="Cd")
    density = node("ShaderNodeAttribute", -600, 0, attribute_name="density")
    factor = node("ShaderNodeValue", -600, -200, name=GAIN_NODE, label=GAIN_NODE)
    factor.outputs[0].default_value = DENSITY_GAIN
    strength = node("ShaderNodeMath", -400, 0, operation="MULTIPLY")
    emission = node("ShaderNodeEmission", -200, 100)
    absorption = node("ShaderNodeVolumeAbsorption", -200, -100)
    absorption.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    both = node("ShaderNodeAddShader", 0, 0)
    output = node("ShaderNodeOutputMaterial", 200, 0)
    for source, target in (
        (density.outputs["Fac"], strength.inputs[0]),
        (factor.outputs[0], strength.inputs[1]),
        (colour.outputs["Color"], emission.inputs["Color"]),
        (strength.outputs[0], emission.inputs["Strength"]),
        (strength.outputs[0], absorption.inputs["Density"]),
        (emission.outputs[0], both.inputs[0]),
        (absorption.outputs[0], both.inputs[1]),
        (both.outputs[0], output.inputs["Volume"]),
    ):
        tree.links.new(source, target)
    return material


_SAME = 1e-4


def person_material(person: bpy.types.Object) -> bpy.types.Material:
    """The material of the human's volumes, as the first one has it."""
    for data in _volumes(person):
        if data.materials and data.materials[0] is not None:
            return data.materials[0]
    return volume_material()


def density_gain(person: bpy.types.Object) -> float | None:
    """The factor on density in the human's material; None where the user has assigned one without it."""
    node = _gain_node(person_material(person))
    return None if node is None else node.outputs[0].default_value


def set_density_gain(person: bpy.types.Object, gain: float) -> None:
    """Give a human this factor: by the shared material where it is the default, else by a material of its own.

    Raises ValueError for a human whose material has no such factor or is linked.
    """
    material = person_material(person)
    if _gain_node(material) is None:
        raise ValueError(
            f"the material {material.name!r} of {person.name!r} has no node {GAIN_NODE!r}: give the human's "
            f"volumes the material {volume_material().name!r} again"
        )
    if material.library is not None or any(data.library is not None for data in _volumes(person)):
        raise ValueError(f"the human {person.name!r} is linked: make it local to change the density gain")
    current = _gain_node(material).outputs[0]
    if abs(current.default_value - gain) <= _SAME:
        return
    shown_to_others = _make_data_own(person)
    volumes = _volumes(person)
    default = _gain_node(volume_material()).outputs[0].default_value
    if abs(gain - default) <= _SAME:
        _assign(volumes, volume_material())
        return
    shown_by = bpy.data.user_map(subset=[material])[material]
    if material == volume_material() or shown_to_others or not shown_by <= set(volumes):
        material = material.copy()
        material.name = f"{volume_material().name} {person.name}"
        _assign(volumes, material)
        current = _gain_node(material).outputs[0]
    current.default_value = gain


def _make_data_own(person: bpy.types.Object) -> bool:
    """Copy the data of volumes that other humans (duplicates) use too; returns whether there were any."""
    own = [obj for obj in parts_of(person) if obj.type == "VOLUME"]
    mine = set(own)
    others = {obj.data for obj in bpy.data.objects if obj.type == "VOLUME" and obj not in mine}
    shared = [obj for obj in own if obj.data in others]
    for obj in shared:
        obj.data = obj.data.copy()
    return bool(shared)


def _volumes(person: bpy.types.Object) -> list[bpy.types.Volume]:
    return [obj.data for obj in parts_of(person) if obj.type == "VOLUME"]


def _gain_node(material: bpy.types.Material) -> bpy.types.Node | None:
    return None if material.node_tree is None else material.node_tree.nodes.get(GAIN_NODE)


def _assign(volumes: list[bpy.types.Volume], material: bpy.types.Material) -> None:
    for data in volumes:
        if data.materials:
            data.materials[0] = material
        else:
            data.materials.append(material)
