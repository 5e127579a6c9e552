"""Colours of a scan: its textures if they are found, in the file or beside it, or its vertex colours."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy

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


def complete_colours(things: Sequence[bpy.types.Object], path: Path) -> list[str]:
    """See to it that every mesh shows the colours it has, and tell what was done, a sentence each.

    A picture that the file names but that is not where it says, and one that the file does not name, are looked for
    beside the scan at `path` by name: `rp_x_rigged_001.fbx` finds `tex/rp_x_dif.jpg`. A mesh that has none is drawn in
    its vertex colours or its base colour.
    """
    nearby = list(pictures_beside(path))
    told: dict[str, list[str]] = {}
    for thing in things:
        told.setdefault(_complete_mesh(thing, path, nearby), []).append(thing.name)
    return [note if len(told) == 1 else f"{', '.join(names)}: {note}" for note, names in told.items()]


def pictures_beside(path: Path) -> Iterator[Path]:
    """Image files in the folder of a scan and in the folders where textures are kept."""
    for folder in _FOLDERS:
        place = path.parent / folder
        if place.is_dir():
            yield from sorted(file for file in place.iterdir() if file.suffix.lower() in _PICTURES)


def choose_picture(path: Path, pictures: Sequence[Path]) -> Path | None:
    """Of `pictures` the one that is most likely the colours of the scan at `path`; None where none is.

    It shares the beginning of the scan's name, up to a whole word, and is not of another kind (normals, gloss, ...).
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


def _complete_mesh(thing: bpy.types.Object, path: Path, nearby: list[Path]) -> str:
    if not thing.data.uv_layers and not thing.data.color_attributes:
        return "no texture coordinates and no vertex colours: drawn in its base colour"
    if not thing.data.uv_layers:
        return _show_vertex_colours(thing)
    missing, notes = [], set()
    for material in _materials(thing):
        image = _base_picture(material)
        if image is not None and _is_there(image):
            notes.add("texture found in or by the file")
            continue
        wanted = Path(image.filepath.replace("\\", "/")).name.lower() if image is not None else ""
        found = next((picture for picture in nearby if picture.name.lower() == wanted), None)
        found = found or choose_picture(path, nearby)
        if found is None:
            missing.append(wanted or material.name)
            continue
        _show_picture(material, found)
        notes.add(f"texture found beside it: {found.name}")
    if missing and not notes and thing.data.color_attributes:
        return _show_vertex_colours(thing)
    if missing:
        notes.add(f"no texture ({', '.join(sorted(set(missing)))}): drawn in its base colour")
    return "; ".join(sorted(notes))


def _materials(thing: bpy.types.Object) -> list[bpy.types.Material]:
    """The mesh's materials; one is made where it has none."""
    if not thing.material_slots:
        thing.data.materials.append(None)
    for slot in thing.material_slots:
        if slot.material is None:
            slot.material = bpy.data.materials.new(thing.name)
        if slot.material.node_tree is None:
            slot.material.use_nodes = True
    return list({slot.material.name: slot.material for slot in thing.material_slots}.values())


def _shader(material: bpy.types.Material) -> bpy.types.Node | None:
    return next((node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"), None)


def _base_picture(material: bpy.types.Material) -> bpy.types.Image | None:
    """The first image upstream of the base colour; of a material without Principled BSDF, any."""
    shader = _shader(material)
    waiting = list(shader.inputs["Base Color"].links) if shader is not None else []
    nodes = [] if shader is not None else list(material.node_tree.nodes)
    seen = set()
    while waiting:
        node = waiting.pop(0).from_node
        if node.name not in seen:
            seen.add(node.name)
            nodes.append(node)
            waiting += [link for entry in node.inputs for link in entry.links]
    return next((node.image for node in nodes if node.type == "TEX_IMAGE" and node.image is not None), None)


def _is_there(image: bpy.types.Image) -> bool:
    return image.size[0] > 0


def _show_picture(material: bpy.types.Material, picture: Path) -> None:
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.load(str(picture), check_existing=True)
    _feed(material, node.outputs["Color"])


def _show_vertex_colours(thing: bpy.types.Object) -> str:
    layer = thing.data.color_attributes[0].name
    for material in _materials(thing):
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
