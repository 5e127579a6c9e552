"""The mesh proxy: a human's clothed surface, textured, skinned to the armature; and its export to other programs.

Blender's own exporters write a temporary scene that holds nothing but armature and proxy, so the user's selection,
modes and visibility stay as they are. Bones that deform nothing (IK handles) are left out, and their effect is in the
joints.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import addon_utils
import bpy
import numpy as np
from mathutils import Color
from numpy.typing import NDArray

from ..files.arrays import all_finite, check_shapes, read_arrays
from ..files.regular_files import FileError, as_file_error, portable_name, remove_folder
from ..files.whole_files import atomic_replace
from ..formats.joints import JOINT_NAMES
from .actions import scene_with_only
from .armature import check_joints, model_origin
from .blend_values import as_numbers, stored_record
from .build import build_body_mesh
from .convention import points_to_blender
from .human import BETA_COUNT, BODY_MARK, PROXY_MARK, state_of
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


def write_model(
    context: bpy.types.Context,
    armature: bpy.types.Object,
    mesh: bpy.types.Object,
    path: Path,
    kind: str,
    frames: range,
) -> None:
    """Write a file of `kind` (GLB or FBX), which appears whole or not at all; one frame is a pose.

    Raises ValueError or RuntimeError where an exporter is missing or fails, and OSError.
    """
    check_joints(armature)
    folder = Path(tempfile.mkdtemp(prefix="export_", dir=bpy.app.tempdir or None))
    try:
        with _selected_in_scene(context, armature, mesh, frames) as overrides, context.temp_override(**overrides):
            _EXPORTERS[kind](folder / path.name, frames)
        if not (folder / path.name).is_file():
            raise RuntimeError(f"Blender's exporter wrote no {kind} file: see the console")
        with atomic_replace(path) as unfinished:
            shutil.copyfile(folder / path.name, unfinished)
    finally:
        remove_folder(folder, folder.parent)


@contextmanager
def _selected_in_scene(
    context: bpy.types.Context, armature: bpy.types.Object, mesh: bpy.types.Object, frames: range
) -> Iterator[dict[str, object]]:
    """Context overrides for a temporary scene in which the armature and the mesh are selected."""
    with scene_with_only(context, armature) as scene:
        scene.frame_start, scene.frame_end = frames[0], frames[-1]
        scene.collection.objects.link(mesh)
        layer = scene.view_layers[0]
        if len(frames) > 1:
            scene.frame_set(frames[0])
        for obj in (armature, mesh):
            obj.select_set(True, view_layer=layer)
        layer.objects.active = armature
        yield {
            "scene": scene, "view_layer": layer, "active_object": armature, "object": armature,
            "selected_objects": [armature, mesh], "collection": scene.collection,
        }  # fmt: skip


def _write_glb(path: Path, frames: range) -> None:
    with _enabled("io_scene_gltf2", "glTF"):
        _run(
            bpy.ops.export_scene.gltf,
            filepath=str(path),
            export_format="GLB",
            use_selection=True,
            use_active_scene=True,
            export_image_format="AUTO",
            export_animations=len(frames) > 1,
            export_animation_mode="SCENE",
            export_anim_scene_split_object=False,
            export_frame_range=True,
            export_rest_position_armature=len(frames) > 1,
            export_current_frame=True,
            export_influence_nb=4,
            export_def_bones=True,
            export_extras=False,
        )


def _write_fbx(path: Path, frames: range) -> None:
    with _enabled("io_scene_fbx", "FBX"):
        _run(
            bpy.ops.export_scene.fbx,
            filepath=str(path),
            use_selection=True,
            object_types={"ARMATURE", "MESH"},
            add_leaf_bones=False,
            use_armature_deform_only=True,
            mesh_smooth_type="FACE",
            path_mode="COPY",
            embed_textures=True,
            bake_anim=True,  # of one frame, too: that is how FBX holds a pose
            bake_anim_use_all_actions=False,
            bake_anim_use_nla_strips=False,
            bake_anim_simplify_factor=0.0,
        )


_EXPORTERS: dict[str, Callable[[Path, range], None]] = {"GLB": _write_glb, "FBX": _write_fbx}


@contextmanager
def _enabled(module: str, label: str) -> Iterator[None]:
    """Enable Blender's own add-on `module` for the block where the user has disabled it."""
    _, loaded = addon_utils.check(module)
    if not loaded and addon_utils.enable(module, default_set=False) is None:
        raise ValueError(f"Blender's {label} add-on {module!r} cannot be enabled: choose another format")
    try:
        yield
    finally:
        if not loaded:
            addon_utils.disable(module, default_set=False)


def _run(exporter: Callable[..., set[str]], **settings: object) -> None:
    """Run an operator; raises RuntimeError, with Blender's own message, where it fails."""
    if exporter(**settings) != {"FINISHED"}:
        raise RuntimeError("Blender's exporter was cancelled: see the console")
