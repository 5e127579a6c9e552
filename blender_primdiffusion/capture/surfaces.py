"""The surfaces of a scan as captures need them: unlit colours, and the number of the joint that moves each face."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import bpy
import numpy as np
from numpy.typing import NDArray

PART = "primdiffusion_part"
"""Attribute of the faces and name of the render pass: 1 + joint, 0 where no joint moves the face."""
OPAQUE = 0.5
"""Alpha from which on a surface counts as solid."""


def mark_parts(thing: bpy.types.Object, joint_of_group: Callable[[str], int | None]) -> None:
    """Give every face of a skinned mesh the number of the joint with the most weight on its corners."""
    part = parts_of_faces(thing, joint_of_group)
    attributes = thing.data.attributes
    if PART in attributes:
        attributes.remove(attributes[PART])
    attributes.new(PART, "FLOAT", "FACE").data.foreach_set("value", part.astype(np.float32))


def parts_of_faces(thing: bpy.types.Object, joint_of_group: Callable[[str], int | None]) -> NDArray[np.int64]:
    """1 + joint of each face [F]; 0 where its corners have no weights."""
    mesh = thing.data
    joints = [joint_of_group(group.name) for group in thing.vertex_groups]
    weights = np.zeros((len(mesh.vertices), 25))  # column 0: groups that are no joint's
    for vertex in mesh.vertices:
        for element in vertex.groups:
            if element.group < len(joints):
                joint = joints[element.group]
                weights[vertex.index, 0 if joint is None else joint + 1] += element.weight
    weights[:, 0] = 0
    corners, faces = np.empty(len(mesh.loops), np.int64), len(mesh.polygons)
    mesh.loops.foreach_get("vertex_index", corners)
    sizes = np.empty(faces, np.int64)
    mesh.polygons.foreach_get("loop_total", sizes)
    sums = np.zeros((faces, 25))
    np.add.at(sums, np.repeat(np.arange(faces), sizes), weights[corners])
    return sums.argmax(1)


def prepare_materials(things: Iterable[bpy.types.Object], unlit: bool) -> None:
    """Every material of `things` gives the pass PART, and if `unlit` its own colour instead of reflecting light.

    Meshes without a material get a light grey one. The materials are changed where they are: they must be ours.
    """
    for thing in things:
        if not thing.material_slots:
            thing.data.materials.append(None)
        for slot in thing.material_slots:
            if slot.material is None:
                slot.material = _grey()
    for material in {slot.material for thing in things for slot in thing.material_slots}:
        if material.node_tree is None:
            material.use_nodes = True
        _add_part(material.node_tree)
        if unlit:
            make_unlit(material)


def make_unlit(material: bpy.types.Material) -> None:
    """Emit the base colour, through the same transparency; two-sided, and without lighting anything else."""
    material.cycles.emission_sampling = "NONE"  # else every triangle becomes a lamp in Cycles' light tree
    tree = material.node_tree
    output = _output(tree)
    shader = next((node for node in _upstream(output.inputs["Surface"]) if _colour(node) is not None), None)
    if shader is None or shader.type == "EMISSION":
        return  # unlit already
    emission, clear, mix = (
        tree.nodes.new(kind) for kind in ("ShaderNodeEmission", "ShaderNodeBsdfTransparent", "ShaderNodeMixShader")
    )
    _follow(tree, _colour(shader), emission.inputs["Color"])
    mix.inputs["Fac"].default_value = 1.0
    if "Alpha" in shader.inputs:
        _follow(tree, shader.inputs["Alpha"], mix.inputs["Fac"])
    tree.links.new(clear.outputs[0], mix.inputs[1])
    tree.links.new(emission.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])


def has_picture(material: bpy.types.Material | None) -> bool:
    """Whether a material shows an image that is there."""
    tree = material.node_tree if material is not None else None
    return tree is not None and any(node.type == "TEX_IMAGE" and node.image is not None for node in tree.nodes)


def _colour(node: bpy.types.Node) -> bpy.types.NodeSocket | None:
    if node.type == "BSDF_TRANSPARENT":
        return None
    return next((node.inputs[name] for name in ("Base Color", "Color") if name in node.inputs), None)


def _follow(tree: bpy.types.NodeTree, source: bpy.types.NodeSocket, target: bpy.types.NodeSocket) -> None:
    """Give `target` what `source` has: a link or a value."""
    if source.is_linked:
        tree.links.new(source.links[0].from_socket, target)
    else:
        target.default_value = source.default_value


def _upstream(socket: bpy.types.NodeSocket) -> Iterator[bpy.types.Node]:
    """Shader nodes that lead into a socket, nearest first."""
    waiting, seen = [link.from_node for link in socket.links], set()
    while waiting:
        node = waiting.pop(0)
        if node.name in seen:
            continue
        seen.add(node.name)
        if any(output.type == "SHADER" for output in node.outputs):
            yield node
        waiting += [link.from_node for entry in node.inputs for link in entry.links]


def _output(tree: bpy.types.NodeTree) -> bpy.types.Node:
    return tree.get_output_node("CYCLES") or tree.nodes.new("ShaderNodeOutputMaterial")


def _add_part(tree: bpy.types.NodeTree) -> None:
    """Cycles adds up the values of all surfaces on the way to the first solid one: holes must give nothing."""
    attribute, value = tree.nodes.new("ShaderNodeAttribute"), tree.nodes.new("ShaderNodeOutputAOV")
    attribute.attribute_name = value.aov_name = PART
    shaders = _upstream(_output(tree).inputs["Surface"])
    shader = next((node for node in shaders if "Alpha" in node.inputs), None)
    if shader is None or not shader.inputs["Alpha"].is_linked:
        tree.links.new(attribute.outputs["Fac"], value.inputs["Value"])
        return
    solid, product = tree.nodes.new("ShaderNodeMath"), tree.nodes.new("ShaderNodeMath")
    solid.operation, product.operation = "GREATER_THAN", "MULTIPLY"
    solid.inputs[1].default_value = OPAQUE - 1e-4
    _follow(tree, shader.inputs["Alpha"], solid.inputs[0])
    tree.links.new(solid.outputs[0], product.inputs[0])
    tree.links.new(attribute.outputs["Fac"], product.inputs[1])
    tree.links.new(product.outputs[0], value.inputs["Value"])


def _grey() -> bpy.types.Material:
    material = bpy.data.materials.new("Grey")
    if material.node_tree is None:
        material.use_nodes = True
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (0.6, 0.6, 0.6, 1.0)
    return material
