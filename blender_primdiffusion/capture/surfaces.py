"""Materials of a scan: its textures or vertex colours, unlit; and for each face the joint that moves it."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

_PICTURES = {".jpg", ".jpeg", ".png", ".tga", ".tif", ".tiff", ".bmp", ".webp", ".exr"}
_COLOUR_WORDS = {
    "dif", "diff", "diffuse", "albedo", "col", "color", "colour", "basecolor", "basecolour", "base", "tex", "texture",
    "d",
}  # fmt: skip
_OTHER_WORDS = {
    "norm", "normal", "nrm", "gloss", "rough", "roughness", "spec", "specular", "metal", "metallic", "ao", "disp",
    "displacement", "height", "mask", "bump", "opacity", "alpha",
}  # fmt: skip
_FOLDERS = (".", "tex", "texture", "textures", "maps", "images", "../tex", "../textures")


def complete_colours(objects: Sequence[bpy.types.Object], path: Path) -> list[str]:
    """Give every mesh its colours; returns what was done, a sentence each.

    Missing textures are looked for beside the scan at `path` by name: `rp_x_rigged_001.fbx` finds
    `tex/rp_x_dif.jpg`. A mesh without any is drawn in its vertex colours or its base colour.
    """
    nearby = list(pictures_beside(path))
    names_by_note: dict[str, list[str]] = {}
    for obj in objects:
        names_by_note.setdefault(_complete_mesh(obj, path, nearby), []).append(obj.name)
    return [note if len(names_by_note) == 1 else f"{', '.join(names)}: {note}" for note, names in names_by_note.items()]


def pictures_beside(path: Path) -> Iterator[Path]:
    """Image files beside a scan and in the usual folders for textures."""
    for folder in _FOLDERS:
        place = path.parent / folder
        if place.is_dir():
            yield from sorted(file for file in place.iterdir() if file.suffix.lower() in _PICTURES and file.is_file())


def choose_picture(path: Path, pictures: Sequence[Path]) -> Path | None:
    """The picture that is most likely the colour texture of the scan at `path`, if any.

    Its name shares the first words of the scan's name and no word of other textures (normals, gloss, ...).
    """
    stem = _words(path.stem)
    best, best_score = None, (0, 0)
    for picture in pictures:
        words = _words(picture.stem)
        if _OTHER_WORDS & set(words):
            continue
        shared = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(stem, words, strict=False)))
        left = [word for word in words[shared:] if word not in _COLOUR_WORDS and not word.isdigit()]
        score = (shared, int(bool(_COLOUR_WORDS & set(words))))
        if shared and not left and shared >= min(2, len(stem)) and score > best_score:
            best, best_score = picture, score
    return best


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]


def _complete_mesh(obj: bpy.types.Object, path: Path, nearby: list[Path]) -> str:
    if not obj.data.uv_layers and not obj.data.color_attributes:
        return "no texture coordinates and no vertex colours: drawn in its base colour"
    if not obj.data.uv_layers:
        return _show_vertex_colours(obj)
    missing, notes = [], set()
    for material in _materials(obj):
        image = _base_picture(material)
        if image is not None and image.size[0] > 0:
            notes.add("texture found by the file")
            continue
        wanted = Path(image.filepath.replace("\\", "/")).name.lower() if image is not None else ""
        found = next((picture for picture in nearby if picture.name.lower() == wanted), None)
        found = found or choose_picture(path, nearby)
        if found is None:
            missing.append(wanted or material.name)
            continue
        _show_picture(material, found)
        notes.add(f"texture found beside it: {found.name}")
    if missing and not notes and obj.data.color_attributes:
        return _show_vertex_colours(obj)
    if missing:
        notes.add(f"no texture ({', '.join(sorted(set(missing)))}): drawn in its base colour")
    return "; ".join(sorted(notes))


def _materials(obj: bpy.types.Object) -> list[bpy.types.Material]:
    """The mesh's materials; a light grey one is made where it has none."""
    if not obj.material_slots:
        obj.data.materials.append(None)
    for slot in obj.material_slots:
        if slot.material is None:
            slot.material = _grey()
    return list({slot.material.name: slot.material for slot in obj.material_slots}.values())


def _shader(material: bpy.types.Material) -> bpy.types.Node | None:
    return next((node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"), None)


def _base_picture(material: bpy.types.Material) -> bpy.types.Image | None:
    """The first image upstream of the base colour; of a material without Principled BSDF, any."""
    shader = _shader(material)
    nodes = material.node_tree.nodes if shader is None else _upstream(shader.inputs["Base Color"])
    return next((node.image for node in nodes if node.type == "TEX_IMAGE" and node.image is not None), None)


def _show_picture(material: bpy.types.Material, picture: Path) -> None:
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.load(str(picture), check_existing=True)
    _feed(material, node.outputs["Color"])


def _show_vertex_colours(obj: bpy.types.Object) -> str:
    layer = obj.data.color_attributes[0].name
    for material in _materials(obj):
        node = material.node_tree.nodes.new("ShaderNodeVertexColor")
        node.layer_name = layer
        _feed(material, node.outputs["Color"])
    return "no texture: drawn in its vertex colours"


def _feed(material: bpy.types.Material, colour: bpy.types.NodeSocket) -> None:
    shader = _shader(material)
    if shader is None:
        shader = material.node_tree.nodes.new("ShaderNodeBsdfPrincipled")
        output = material.node_tree.get_output_node("ALL") or material.node_tree.nodes.new("ShaderNodeOutputMaterial")
        material.node_tree.links.new(shader.outputs[0], output.inputs["Surface"])
    material.node_tree.links.new(colour, shader.inputs["Base Color"])


PART = "primdiffusion_part"
"""Attribute of the faces and name of the render pass: 1 + joint, 0 where no joint moves the face."""
OPAQUE = 0.5
"""Alpha from which on a surface counts as solid."""


def mark_parts(obj: bpy.types.Object, joint_of_group: Callable[[str], int | None]) -> None:
    """Give every face of a skinned mesh the number of the joint with the most weight on its corners."""
    part = parts_of_faces(obj, joint_of_group)
    attributes = obj.data.attributes
    if PART in attributes:
        attributes.remove(attributes[PART])
    attributes.new(PART, "FLOAT", "FACE").data.foreach_set("value", part.astype(np.float32))


def parts_of_faces(obj: bpy.types.Object, joint_of_group: Callable[[str], int | None]) -> NDArray[np.int64]:
    """1 + joint of each face [F]; 0 where its corners have no weights."""
    mesh = obj.data
    joints = [joint_of_group(group.name) for group in obj.vertex_groups]
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


def prepare_materials(objects: Iterable[bpy.types.Object], unlit: bool) -> None:
    """Every material of `objects` gives the pass PART, and if `unlit` its own colour instead of reflecting light.

    Meshes without a material get a light grey one. The materials are changed where they are: they must be ours.
    """
    for material in {material for obj in objects for material in _materials(obj)}:
        _add_part(material.node_tree)
        if unlit:
            make_unlit(material)


def make_unlit(material: bpy.types.Material) -> None:
    """Emit the base colour, through the same transparency; two-sided, and without lighting anything else."""
    material.cycles.emission_sampling = "NONE"  # else every triangle becomes a lamp in Cycles' light tree
    tree = material.node_tree
    output = _output(tree)
    shader = next((node for node in _shaders(tree) if _colour(node) is not None), None)
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
    """Nodes that lead into a socket, nearest first."""
    waiting, seen = [link.from_node for link in socket.links], set()
    while waiting:
        node = waiting.pop(0)
        if node.name in seen:
            continue
        seen.add(node.name)
        yield node
        waiting += [link.from_node for entry in node.inputs for link in entry.links]


def _shaders(tree: bpy.types.NodeTree) -> Iterator[bpy.types.Node]:
    """Shaders of the surface, nearest to the output first."""
    nodes = _upstream(_output(tree).inputs["Surface"])
    return (node for node in nodes if any(output.type == "SHADER" for output in node.outputs))


def _output(tree: bpy.types.NodeTree) -> bpy.types.Node:
    return tree.get_output_node("CYCLES") or tree.nodes.new("ShaderNodeOutputMaterial")


def _add_part(tree: bpy.types.NodeTree) -> None:
    """Cycles adds up the values of all surfaces on the way to the first solid one: holes must give nothing."""
    attribute, value = tree.nodes.new("ShaderNodeAttribute"), tree.nodes.new("ShaderNodeOutputAOV")
    attribute.attribute_name = value.aov_name = PART
    shader = next((node for node in _shaders(tree) if "Alpha" in node.inputs), None)
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
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (0.6, 0.6, 0.6, 1.0)
    return material
