"""The one material of all volumes: emission and absorption, both driven by the density grid."""

from __future__ import annotations

import bpy

MATERIAL_NAME = "PrimDiffusion Volume"
DENSITY_GAIN = 1.6
"""Cycles absorbs exponentially, the paper's marcher adds and clamps; with this factor on density their alpha is nearest
for people of the default checkpoint, each of whom can have a fitted one (see `gain`)."""
GAIN_NODE = "Density Gain"


def volume_material(gain: float = DENSITY_GAIN) -> bpy.types.Material:
    """The shared material, made on first use.

    With s = gain * density: Emission of strength s and colour Cd, Absorption of density s in black; so a ray gathers
    the integral of Cd s exp(-integral of s): premultiplied colour.
    """
    existing = bpy.data.materials.get(MATERIAL_NAME)
    if existing is not None and existing.node_tree is not None and GAIN_NODE in existing.node_tree.nodes:
        return existing
    material = bpy.data.materials.new(MATERIAL_NAME)
    if bpy.app.version < (5, 0):
        material.use_nodes = True  # always true, and deprecated, since 5.0
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
    factor.outputs[0].default_value = gain
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
