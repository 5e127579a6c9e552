"""The mesh proxy: a human's clothed surface, textured, skinned to the armature."""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Color
from numpy.typing import NDArray

from ..files.arrays import all_finite, check_shapes, read_arrays
from ..files.regular_files import FileError, as_file_error, portable_name
from ..formats.joints import JOINT_NAMES
from .armature import model_origin
from .blend_values import as_numbers, stored_record
from .build import build_body_mesh
from .convention import points_to_blender
from .human import BETA_COUNT, BODY_MARK, PROXY_MARK
from .payload import state_of
from .shape import betas_of

_FORMAT_VERSION = 1
_SHAPES = {"vertices": ("V", 3), "faces": ("F", 3), "uv_corner": ("F", 3, 2), "skin_weights": ("V", 24)}


@dataclasses.dataclass(frozen=True)
class ProxyMesh:
    """The child's mesh in the T pose; y up, metres."""

    vertices: NDArray[np.float64]
    """[V, 3]"""
    faces: NDArray[np.int64]
    """[F, 3]"""
    uv_corner: NDArray[np.float64]
    """[F, 3, 2], v up."""
    skin_weights: NDArray[np.float64]
    """[V, 24]; rows sum to one."""


def read_proxy(path: Path) -> ProxyMesh:
    """Read the child's proxy.npz. Raises ValueError for a damaged one, OSError."""
    sizes: dict[str, int] = {}
    with as_file_error(path, "is not a mesh or is damaged", "export again"):
        arrays = read_arrays(path, ("format_version", "joint_names", *_SHAPES))
        check_shapes(path, arrays, _SHAPES, sizes)
    names = tuple(str(name) for name in arrays["joint_names"].ravel())
    if str(arrays["format_version"]) != str(_FORMAT_VERSION) or names != JOINT_NAMES:
        raise FileError(path, "holds a mesh of another version", "use an add-on and a backend of one release")
    for name in _SHAPES:
        if not all_finite(arrays[name]):
            raise FileError(path, f"holds NaN or infinite values in {name!r}", "export again")
    if arrays["faces"].min() < 0 or arrays["faces"].max() >= sizes["V"]:
        raise FileError(path, "has faces with corners that do not exist", "export again")
    return ProxyMesh(**{name: arrays[name].astype(np.int64 if name == "faces" else np.float64) for name in _SHAPES})


def build_proxy(person: bpy.types.Object, proxy: ProxyMesh, texture: Path) -> bpy.types.Object:
    """The proxy, made in the human's shape, as an object that follows its armature, shown and rendered, linked to no
    collection. The texture is packed into the .blend."""
    name = f"{person.name}_proxy"
    vertices = points_to_blender(proxy.vertices) + model_origin(person.data)
    made = build_body_mesh(name, person, vertices, proxy.faces, proxy.uv_corner, proxy.skin_weights)
    del made[BODY_MARK]
    made[PROXY_MARK] = json.dumps({"file": state_of(person), "betas": betas_of(person).tolist()})
    made.hide_viewport = made.hide_render = False
    made.data.materials.append(_material(name, texture))
    return made


def is_outdated(person: bpy.types.Object, proxy: bpy.types.Object) -> bool:
    """Whether the human was edited or reshaped since."""
    made = stored_record(proxy, PROXY_MARK)
    betas = as_numbers(made.get("betas"), BETA_COUNT)
    return made.get("file") != state_of(person) or betas is None or not np.allclose(betas, betas_of(person), atol=1e-4)


def show_textures_in_solid() -> None:
    """Solid shading shows textures in all 3D viewports that show the colours of materials, Blender's default; objects
    without a texture look the same. Another choice of the user stays."""
    for screen in bpy.data.screens:
        for space in (space for area in screen.areas for space in area.spaces if space.type == "VIEW_3D"):
            if space.shading.type != "WIREFRAME" and space.shading.color_type == "MATERIAL":
                space.shading.color_type = "TEXTURE"


def remove_proxy(proxy: bpy.types.Object) -> None:
    """Remove a proxy from the .blend with its mesh, material and texture."""
    mesh = proxy.data
    materials = [material for material in mesh.materials if material is not None]
    nodes = [node for material in materials if material.node_tree for node in material.node_tree.nodes]
    images = [node.image for node in nodes if node.type == "TEX_IMAGE" and node.image is not None]
    bpy.data.objects.remove(proxy)
    for block in (mesh, *materials, *images):  # in this order: removing a user frees what it uses
        if block.users == 0:
            bpy.data.batch_remove([block])


def _material(name: str, texture: Path) -> bpy.types.Material:
    file = f"{portable_name(bpy.path.clean_name(name))}.png"
    with tempfile.TemporaryDirectory(dir=bpy.app.tempdir or None) as folder:
        shutil.copyfile(texture, Path(folder) / file)  # exporters name textures after the file that was packed
        image = bpy.data.images.load(str(Path(folder) / file))
        image.name = name
        image.pack()
    image.filepath_raw = f"//{file}"  # `filepath` would look for the file at once
    material = bpy.data.materials.new(name)
    nodes = material.node_tree.nodes
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    picture = nodes.new("ShaderNodeTexImage")
    picture.image = image
    picture.location = (shader.location.x - 300, shader.location.y)
    material.node_tree.links.new(picture.outputs["Color"], shader.inputs["Base Color"])
    nodes.active = picture  # the texture that Solid shading shows
    pixels = np.empty((*image.size, 4), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    material.diffuse_color[:3] = Color(pixels[..., :3].mean((0, 1))).from_srgb_to_scene_linear()
    shader.inputs["Roughness"].default_value = 0.9
    shader.inputs["Metallic"].default_value = 0.0
    return material
