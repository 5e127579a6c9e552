"""The mesh proxy: a human's clothed surface, textured, skinned to the armature; it follows the shape.

Each vertex moves as the body's surface next to it, so clothes keep their distance from the skin. The betas that a proxy
shows are stored with it and only the difference is added, so edits by hand stay.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import shutil
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Color
from mathutils.kdtree import KDTree
from numpy.typing import NDArray

from ..files.arrays import all_finite, check_shapes, read_arrays
from ..files.regular_files import FileError, as_file_error, portable_name
from ..formats.joints import JOINT_NAMES
from .armature import floor_below, model_origin
from .blend_values import as_numbers, stored_record
from .build import build_body_mesh
from .convention import points_to_blender
from .human import BETA_COUNT, BODY_MARK, own_data, parts_of
from .payload import state_of
from .rest_human import shape_model_of
from .shape import SAME_BETAS, ShapeModel

PROXY_MARK = "primdiffusion_proxy"
"""Custom property of a proxy: the human's file that it was made from and the shape that it shows, as JSON."""
_FORMAT_VERSION = 1
_SHAPES = {"vertices": ("V", 3), "faces": ("F", 3), "uv_corner": ("F", 3, 2), "skin_weights": ("V", 24)}
NEIGHBOURS = 12
"""Vertices of the body that one of the proxy follows."""
REACH = 0.02
"""Metres beyond the nearest at which another vertex's weight has fallen to a third, so that seams of folds are not
followed."""
_CACHED = 4


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


def build_proxy(person: bpy.types.Object, proxy: ProxyMesh, texture: Path, betas: NDArray | None) -> bpy.types.Object:
    """The proxy as an object that follows the human's armature, shown and rendered, linked to no collection.

    The texture is packed into the .blend. `betas` [10]: the shape it was made in.
    """
    name = f"{person.name}_proxy"
    vertices = points_to_blender(proxy.vertices) + _model_origin(person, betas)
    made = build_body_mesh(name, person, vertices, proxy.faces, proxy.uv_corner, proxy.skin_weights)
    del made[BODY_MARK]
    made[PROXY_MARK] = json.dumps(_origin(person, betas))
    made.hide_viewport = made.hide_render = False
    made.data.materials.append(_material(name, texture))
    return made


def proxy_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The human's proxy in the scene, if any."""
    return next((obj for obj in parts_of(person) if obj.type == "MESH" and PROXY_MARK in obj), None)


def is_outdated(person: bpy.types.Object, proxy: bpy.types.Object, betas: NDArray | None) -> bool:
    """Whether the human was edited since, or has a shape that the proxy could not follow."""
    shown = shown_betas(proxy)
    same_shape = shown is None if betas is None else shown is not None and np.allclose(shown, betas, atol=1e-4)
    return stored_record(proxy, PROXY_MARK).get("file") != state_of(person) or not same_shape


def shown_betas(proxy: bpy.types.Object) -> NDArray[np.float64] | None:
    """The shape [10] that a proxy shows; None where it is unknown."""
    betas = as_numbers(stored_record(proxy, PROXY_MARK).get("betas"), BETA_COUNT)
    return None if betas is None else np.array(betas, np.float64)


def show_betas(proxy: bpy.types.Object, betas: NDArray) -> None:
    """Store with a proxy that it shows another shape [10]."""
    proxy[PROXY_MARK] = json.dumps({**stored_record(proxy, PROXY_MARK), "betas": _rounded(betas)})


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


def follow_shape(person: bpy.types.Object, proxy: bpy.types.Object | None, betas: NDArray) -> None:
    """Move a human's proxy, if there is one, to the body of these betas [10], at rest.

    Takes some tenths of a second for a new mesh, a few milliseconds afterwards. A proxy that has shape keys, is in Edit
    Mode or linked from another file stays as it is, and then counts as outdated. Raises as `shape_model_of`.
    """
    shown = None if proxy is None else shown_betas(proxy)
    if proxy is None or shown is None or not _can_follow(proxy):
        return
    change = np.asarray(betas, np.float64) - shown
    if np.abs(change).max() <= SAME_BETAS:
        return
    model, mesh = shape_model_of(person), own_data(proxy, person)
    origin = _model_origin(person, shown)
    moved = _vertices(mesh) + _basis(_Bound(mesh, shown, origin), model) @ change
    moved += _model_origin(person, betas) - origin
    mesh.vertices.foreach_set("co", moved.astype(np.float32).ravel())
    mesh.update()
    show_betas(proxy, betas)


def _model_origin(person: bpy.types.Object, betas: NDArray | None) -> NDArray[np.float64]:
    """The origin of the body model in the armature's space [3] when the human has these betas [10], not those it has
    now: see `human.ORIGIN`. Raises as `shape_model_of`."""
    if betas is None:
        return model_origin(person.data)
    return floor_below(points_to_blender(shape_model_of(person).surface(betas)))


def _origin(person: bpy.types.Object, betas: NDArray | None) -> dict[str, object]:
    return {"file": state_of(person), "betas": None if betas is None else _rounded(betas)}


def _rounded(betas: NDArray) -> list[float]:
    return np.round(np.asarray(betas, np.float64), 7).tolist()


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


class _Bound:
    """A mesh as first seen, identified by its faces, so that its nearest body vertices are searched once."""

    def __init__(self, mesh: bpy.types.Mesh, shown: NDArray, origin: NDArray) -> None:
        corners = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", corners)
        self.digest = hashlib.sha256(corners.tobytes()).hexdigest()
        self.vertices, self.shown = _vertices(mesh) - origin, shown

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Bound) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def _can_follow(proxy: bpy.types.Object) -> bool:
    mesh = proxy.data
    return mesh.shape_keys is None and mesh.library is None and proxy.library is None and not mesh.is_editmode


@functools.lru_cache(maxsize=_CACHED)
def _basis(bound: _Bound, model: ShapeModel) -> NDArray[np.float64]:
    """Displacements of the mesh's vertices by a unit of each beta [V, 3, 10], z up."""
    body = points_to_blender(model.surface(bound.shown))
    tree = KDTree(len(body))
    for index, point in enumerate(body):
        tree.insert(point, index)
    tree.balance()
    found = [tree.find_n(point, NEIGHBOURS) for point in bound.vertices]
    index = np.array([[one[1] for one in near] for near in found])
    distance = np.array([[one[2] for one in near] for near in found])
    weight = np.exp(-(((distance - distance[:, :1]) / REACH) ** 2))
    weight /= weight.sum(1, keepdims=True)
    basis = points_to_blender(np.moveaxis(model.shape_basis, -1, 0)).transpose(1, 2, 0)
    return np.einsum("vn,vnxb->vxb", weight, basis[index])


def _vertices(mesh: bpy.types.Mesh) -> NDArray[np.float64]:
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3).astype(np.float64)
