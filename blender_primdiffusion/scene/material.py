"""The material of volumes: emission and absorption driven by the density grid, times a gain."""

from __future__ import annotations

import bpy

from ..formats.requests import DENSITY_GAIN

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


def density_gain() -> bpy.types.NodeSocketFloat | None:
    """The factor on density in the shared material; None before its first use, and where the user has removed it."""
    material = bpy.data.materials.get(MATERIAL_NAME)
    tree = material.node_tree if material is not None else None
    node = tree.nodes.get(GAIN_NODE) if tree is not None else None
    return node.outputs[0] if node is not None and node.outputs else None
