"""Write a skinned, textured mesh as one glTF 2.0 file (.glb).

Written by hand because trimesh does not write skins. Coordinates are glTF's: metres, y up, facing +z. The file's bytes
are a deterministic function of the mesh.
"""

from __future__ import annotations

import dataclasses
import io
import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from PIL import Image

from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart, vertex_normals

MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"
FLOAT, BYTE, SHORT, INT = 5126, 5121, 5123, 5125
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
OPAQUE = 128
"""Alpha from which a texel is opaque, as with glTF's cutoff of 0.5."""
NORMAL_STEPS = 4096
"""Normals are rounded to 1 / NORMAL_STEPS, so that files do not depend on the order of summation."""
JPEG_QUALITY = 92


@dataclasses.dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints of a rest pose, with axes parallel to the world's."""

    names: Sequence[str]
    parents: Sequence[int]
    """Index of each joint's parent, -1 for the root."""
    positions: Float[np.ndarray, "J 3"]
    """Metres."""


class _Binary:
    """Builds the binary chunk, its buffer views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, padded to four; return the index of their buffer view."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += data + b"\0" * (-len(data) % 4)
        return len(self.views) - 1

    def accessor(self, array: np.ndarray, kind: str, component: int, target: int | None, bounded: bool = False) -> int:
        """Append an array; return the index of its accessor."""
        entry: dict[str, Any] = {
            "bufferView": self.view(np.ascontiguousarray(array).tobytes(), target),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if bounded:
            entry |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def glb(mesh: TexturedMesh, skeleton: Skeleton, extras: Mapping[str, Any]) -> bytes:
    """Encode a mesh in the skeleton's rest pose: a mesh node for each part, one skin.

    Args:
        mesh: parts with at most four joints per vertex; parts without faces are left out.
        skeleton: the joints that their `skin_index` refers to.
        extras: JSON values for `extras` of the asset and of the scene (Blender shows the scene's).

    Raises:
        ValueError: no part has a face, or a value is NaN or infinite.
    """
    parts = [part for part in mesh.parts if len(part.faces)]
    _check(parts, skeleton)
    binary = _Binary()
    count = len(skeleton.names)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "primdiffusion", "extras": dict(extras)},
        "scene": 0,
        "scenes": [{"nodes": [0, *range(count, count + len(parts))], "extras": dict(extras)}],
        "nodes": [*_joint_nodes(skeleton), *({"name": p.name, "mesh": i, "skin": 0} for i, p in enumerate(parts))],
        "skins": [_skin(skeleton, binary)],
        "meshes": [{"name": p.name, "primitives": [_primitive(p, i, binary)]} for i, p in enumerate(parts)],
        "materials": [_material(part, i) for i, part in enumerate(parts)],
        "textures": [{"source": i, "sampler": 0} for i in range(len(parts))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497}],
        "images": [_image(part, binary) for part in parts],
    }
    document |= {
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": len(binary.data)}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = b"".join(
        struct.pack("<I", len(chunk)) + kind + chunk
        for kind, chunk in ((JSON_CHUNK, text), (BINARY_CHUNK, bytes(binary.data)))
    )
    return MAGIC + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def _check(parts: list[TexturedPart], skeleton: Skeleton) -> None:
    if not parts:
        raise ValueError("the mesh has no faces: give at least one")
    arrays = {"the joints' positions": skeleton.positions}
    for part in parts:
        arrays |= {
            f"{field} of part {part.name!r}": getattr(part, field) for field in ("vertices", "corner_uv", "skin_weight")
        }
    for what, array in arrays.items():
        if not np.isfinite(array).all():
            bad = int((~np.isfinite(array)).sum())
            raise ValueError(f"{bad} values of {what} are NaN or infinite: check the betas")


def _joint_nodes(skeleton: Skeleton) -> list[dict[str, Any]]:
    nodes = []
    for joint, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        offset = skeleton.positions[joint] - (skeleton.positions[parent] if parent >= 0 else 0)
        children = [child for child, its_parent in enumerate(skeleton.parents) if its_parent == joint]
        node = {"name": name, "translation": np.asarray(offset, np.float32).tolist()}
        nodes.append({**node, "children": children} if children else node)
    return nodes


def _skin(skeleton: Skeleton, binary: _Binary) -> dict[str, Any]:
    """The skin; its inverse bind matrices (column-major) are translations of the joints to the origin."""
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(skeleton.names), 1, 1))
    inverse[:, 3, :3] = -skeleton.positions
    matrices = binary.accessor(inverse.reshape(-1, 16), "MAT4", FLOAT, None)
    return {"name": "skeleton", "skeleton": 0, "joints": list(range(len(inverse))), "inverseBindMatrices": matrices}


def _primitive(part: TexturedPart, number: int, binary: _Binary) -> dict[str, Any]:
    """A glTF primitive; vertices are split where texture coordinates differ."""
    keys = np.concatenate(
        [part.faces.reshape(-1, 1).astype(np.float32), part.corner_uv.reshape(-1, 2).astype(np.float32)], axis=1
    )
    unique, corner = np.unique(keys, axis=0, return_inverse=True)
    source = unique[:, 0].astype(np.int64)
    uv = np.stack([unique[:, 1], 1 - unique[:, 2]], axis=1)
    index = np.where(part.skin_weight > 0, part.skin_index, 0)
    normals = _normals(part.vertices, part.faces)
    small = len(source) < 1 << 16

    def attribute(array: np.ndarray, kind: str, component: int = FLOAT, bounded: bool = False) -> int:
        return binary.accessor(array, kind, component, VERTEX_BUFFER, bounded)

    attributes = {
        "POSITION": attribute(part.vertices[source].astype(np.float32), "VEC3", bounded=True),
        "NORMAL": attribute(normals[source], "VEC3"),
        "TEXCOORD_0": attribute(uv.astype(np.float32), "VEC2"),
        "JOINTS_0": attribute(_four(index)[source].astype(np.uint8), "VEC4", BYTE),
        "WEIGHTS_0": attribute(_four(part.skin_weight)[source].astype(np.float32), "VEC4"),
    }
    indices = corner.reshape(-1).astype(np.uint16 if small else np.uint32)
    faces = binary.accessor(indices, "SCALAR", SHORT if small else INT, INDEX_BUFFER)
    return {"attributes": attributes, "indices": faces, "material": number, "mode": 4}


def _four(array: np.ndarray) -> np.ndarray:
    """Pad to four columns with zeros."""
    return np.pad(array, ((0, 0), (0, 4 - array.shape[1])))


def _normals(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float32[np.ndarray, "V 3"]:
    """Smooth normals, of unit length up to rounding; up for vertices of degenerate faces only."""
    unit = vertex_normals(vertices, faces)
    unit[np.linalg.norm(unit, axis=1) < 0.5] = (0.0, 1.0, 0.0)
    return (np.rint(unit * NORMAL_STEPS) / NORMAL_STEPS + 0.0).astype(np.float32)


def _material(part: TexturedPart, number: int) -> dict[str, Any]:
    surface = {"baseColorTexture": {"index": number}, "roughnessFactor": 1.0, "metallicFactor": 0.0}
    material = {"name": part.name, "pbrMetallicRoughness": surface, "doubleSided": True}
    return {**material, "alphaMode": "MASK", "alphaCutoff": 0.5} if _cut_out(part.texture) else material


def _cut_out(texture: UInt8[np.ndarray, "H W 4"]) -> bool:
    return bool((texture[..., 3] < OPAQUE).any())


def _image(part: TexturedPart, binary: _Binary) -> dict[str, Any]:
    """Encode as JPEG if opaque, as PNG with transparency or if tiny."""
    file = io.BytesIO()
    if _cut_out(part.texture):
        mime = "image/png"
        Image.fromarray(part.texture).save(file, "PNG")
    elif part.texture.size <= 64:
        mime = "image/png"
        Image.fromarray(part.texture[..., :3]).save(file, "PNG")
    else:
        mime = "image/jpeg"
        Image.fromarray(part.texture[..., :3]).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return {"name": part.name, "mimeType": mime, "bufferView": binary.view(file.getvalue())}
