"""Read humans from skinned .glb files in the default body's rest pose, as `primdiffusion people` writes them.

The reader of binary glTF 2.0 opens no other files. Sparse accessors and compressed meshes are not supported.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

from primdiffusion.body.model import BodyModel, J, default_body
from primdiffusion.files.arrays import LARGEST_NUMBER
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import FileError, as_file_error, read_regular
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.pictures import MOST_PIXELS, decoded, decoded_bytes, opened_picture
from primdiffusion.geometry.srgb import decode_srgb, encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.rasterise import Draw, Figure, figure_from_mesh

MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\x00"
NUMBERS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


LARGEST_GLB = 256 * 2**20
MOST_PARTS, MOST_CORNERS, MOST_TEXELS = 100, 20_000_000, 2 * MOST_PIXELS
"""Limits of a human."""
UNBACKED_CORNERS = 1_000_000
"""Corners and coordinates that a human may have however small its file is; beyond, one for each byte. Primitives may
share accessors, so that small files name gigabytes, while an ordinary file has two bytes for an index and four for a
coordinate."""
LARGEST_UV = 1e4
"""Repeats of a texture."""


@dataclasses.dataclass(frozen=True, eq=False)
class Glb:
    """A .glb file in memory."""

    path: Path
    content: dict[str, Any]
    """The JSON chunk."""
    binary: bytes
    size: int
    """Bytes of the file."""

    def array(self, accessor: int) -> NDArray:
        """Values of an accessor, [count] or [count, width]; normalised integers as float32 in [0, 1].

        Raises:
            FileError: it does not exist, exceeds the file, or is sparse.
        """
        with as_file_error(self.path, f"has a damaged accessor {accessor!s:.20}", "export it again"):
            about = self.content["accessors"][accessor]
            if "sparse" in about or accessor < 0:
                raise FileError(self.path, f"has a sparse accessor {accessor}", "export it without sparse accessors")
            view = self.content["bufferViews"][about["bufferView"]]
            number, width, count = np.dtype(NUMBERS[about["componentType"]]), WIDTHS[about["type"]], int(about["count"])
            first = int(view.get("byteOffset", 0)) + int(about.get("byteOffset", 0))
            stride = int(view.get("byteStride", 0)) or number.itemsize * width
            if min(first, count - 1, stride - number.itemsize * width) < 0:
                raise ValueError("negative size")
            raw = np.frombuffer(self.binary, np.uint8, (count - 1) * stride + number.itemsize * width, first)
        rows = np.lib.stride_tricks.as_strided(raw, (count, number.itemsize * width), (stride, 1))
        values = np.ascontiguousarray(rows).view(number)
        if about.get("normalized") and number.kind in "iu":
            values = np.maximum(values.astype(np.float32) / np.iinfo(number).max, -1)
        return values[:, 0] if width == 1 else values

    def picture(self, image: int) -> UInt8[np.ndarray, "H W 4"]:
        """An embedded image, sRGB-encoded with straight alpha.

        Raises:
            FileError: it does not exist, is not embedded, or cannot be decoded.
        """
        with self._image_named(image), opened_picture(io.BytesIO(self._image_bytes(image))) as picture:
            return decoded(picture, "RGBA")

    def picture_texels(self, image: int) -> int:
        """Number of an embedded image's pixels, from its header alone. Raises as `picture`."""
        with self._image_named(image), opened_picture(io.BytesIO(self._image_bytes(image))) as picture:
            return picture.width * picture.height

    def _image_bytes(self, image: int) -> bytes:
        view = self.content["bufferViews"][self.content["images"][image]["bufferView"]]
        first = int(view.get("byteOffset", 0))
        return self.binary[first : first + int(view["byteLength"])]

    def _image_named(self, image: int) -> contextlib.AbstractContextManager[None]:
        return as_file_error(self.path, f"has an unreadable image {image!s:.20}", "pack PNG or JPEG into it", OSError)


def read_glb(path: str | Path) -> Glb:
    """Read a .glb file.

    Raises:
        FileNotFoundError: the file does not exist.
        FileError: it is not binary glTF 2.0, or truncated.
    """
    path = Path(path)
    data = read_regular(path, LARGEST_GLB)
    with as_file_error(path, "is not a complete .glb file", "write it again", struct.error):
        magic, version, length = struct.unpack_from("<4sII", data)
        if magic != MAGIC or version != 2:
            raise FileError(path, "is not a binary glTF 2.0 file", "export it as .glb")
        if length > len(data):
            raise FileError(path, f"is truncated ({len(data)} of {length} bytes)", "write it again")
        chunks, at = {}, 12
        while at + 8 <= length:
            size, kind = struct.unpack_from("<I4s", data, at)
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        content = parse_json(chunks[JSON_CHUNK])
    if not isinstance(content, dict):
        raise FileError(path, "contains no glTF object", "write it again")
    return Glb(path, content, chunks.get(BINARY_CHUNK, b""), len(data))


SUBJECT_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
FARTHEST = 10.0
"""Largest distance of a vertex from the origin, metres; a stray vertex would move the cameras far away."""
LARGEST_BETA = 20.0
"""Standard deviations; larger betas put joints outside any body."""
OURS = "primdiffusion"
"""Key of the extras that contain betas and body."""


@dataclasses.dataclass(frozen=True, eq=False)
class SkinnedPerson:
    """A dressed human in the rest pose of the default body."""

    mesh: TexturedMesh
    betas: Float[np.ndarray, "n"]

    @property
    def body(self) -> BodyModel:
        """The default body."""
        return default_body()

    def points(self, skinning: Float[np.ndarray, "J 4 4"]) -> Float[np.ndarray, "n 3"]:
        """See `Figure.points`. Raises ValueError as `figure_from_mesh`."""
        return self._figure.points(skinning)

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> Draw:
        """See `Figure.posed`. Raises ValueError as `figure_from_mesh`."""
        return self._figure.posed(skinning)

    @functools.cached_property
    def _figure(self) -> Figure:
        return figure_from_mesh(self.mesh)


def find_people(folder: str | Path) -> dict[str, Path]:
    """Find the .glb files in a folder, sorted by name: NAME/person.glb or NAME.glb.

    Raises:
        FileNotFoundError: the folder does not exist or contains none.
    """
    folder = Path(folder)
    inner = [p for p in folder.iterdir() if p.is_dir() and p.name == "people"] if folder.is_dir() else []
    found: dict[str, Path] = {}
    for place in (folder, *inner):
        for path in [*place.glob("*/person.glb"), *place.glob("*.glb")]:
            name = path.parent.name if path.name == "person.glb" and path.parent != folder else path.stem
            if SUBJECT_NAME.fullmatch(name):
                found.setdefault(name, path)
    if not found:
        raise FileNotFoundError(f"{folder} contains no NAME/person.glb: make some with primdiffusion people")
    return dict(sorted(found.items()))


def read_person(path: str | Path) -> SkinnedPerson:
    """Read a human.

    Raises:
        FileNotFoundError: the file does not exist.
        FileError: it is not a complete .glb, not rigged with the 24 joints, or has no betas.
    """
    glb = read_glb(path)
    with as_file_error(path, "is not a human on the default body", "make it again"):
        return SkinnedPerson(TexturedMesh(_parts(glb)), _betas(glb))


def _betas(glb: Glb) -> Float[np.ndarray, "n"]:
    scenes = glb.content.get("scenes", [])
    places = [glb.content.get("asset", {}), *scenes]
    extras: Any = next((p["extras"][OURS] for p in places if OURS in (p.get("extras") or {})), None)
    if extras is None:
        raise FileError(glb.path, "has no betas", "give a file that primdiffusion people wrote")
    if extras.get("body", "default") != "default":
        raise FileError(glb.path, f"is rigged on the body {extras['body']!r:.60}", "rig it on the default body")
    betas = np.asarray(extras["betas"], np.float64)
    components = default_body().shape_basis.shape[-1]
    if betas.ndim != 1 or len(betas) > components or not (np.abs(betas) <= LARGEST_BETA).all():
        reason = f"has betas of shape {betas.shape}, not at most {components} within {LARGEST_BETA:g} of 0"
        raise FileError(glb.path, reason, "make the human again")
    return betas


def _parts(glb: Glb) -> tuple[TexturedPart, ...]:
    nodes, parts, corners = glb.content["nodes"], [], 0
    most_corners = min(MOST_CORNERS, UNBACKED_CORNERS + glb.size)
    textures = _Textures(glb)
    for node in nodes:
        if "mesh" not in node:
            continue
        if "skin" not in node:
            raise FileError(glb.path, f"has no skin for the mesh {node.get('name')!r:.60}", "make the human again")
        joints = _joints(glb, node["skin"])
        for number, primitive in enumerate(glb.content["meshes"][node["mesh"]]["primitives"]):
            name = str(node.get("name", f"part {len(parts)}")) + (f" {number}" if number else "")
            parts.append(_part(glb, name, primitive, joints, textures.of_material(primitive.get("material"))))
            corners += parts[-1].faces.size + parts[-1].vertices.size
            if len(parts) > MOST_PARTS or corners > most_corners:
                raise FileError(
                    glb.path,
                    f"has more than {MOST_PARTS} parts, or than the {most_corners} corners that its size allows",
                    "make a simpler human",
                )
    if not parts:
        raise FileError(glb.path, "contains no mesh", "make the human again")
    return tuple(parts)


def _joints(glb: Glb, skin: int) -> Int[np.ndarray, "n"]:
    """SMPL index of each joint of a skin."""
    names = [glb.content["nodes"][node].get("name") for node in glb.content["skins"][skin]["joints"]]
    if unknown := sorted({str(name) for name in names if name not in JOINT_NAMES}):
        raise FileError(glb.path, f"has joints {', '.join(unknown[:3])!s:.100}", f"rig it with SMPL's {J} joints")
    return np.array([JOINT_NAMES.index(name) for name in names], np.int32)


def _part(
    glb: Glb, name: str, primitive: dict[str, Any], joints: Int[np.ndarray, "n"], texture: UInt8[np.ndarray, "H W 4"]
) -> TexturedPart:
    attributes = primitive["attributes"]
    vertices = glb.array(attributes["POSITION"]).astype(np.float64)
    faces = glb.array(primitive["indices"]).astype(np.int64) if "indices" in primitive else np.arange(len(vertices))
    if primitive.get("mode", 4) != 4 or len(faces) % 3 or not ((faces >= 0) & (faces < len(vertices))).all():
        reason = f"has faces in {name!r:.60} that are not triangles of its vertices"
        raise FileError(glb.path, reason, "make the human again")
    faces = faces.reshape(-1, 3).astype(np.int32)
    uv = glb.array(attributes["TEXCOORD_0"]) if "TEXCOORD_0" in attributes else np.zeros((len(vertices), 2), np.float32)
    index = joints[glb.array(attributes["JOINTS_0"]).astype(np.int64)]
    weight = glb.array(attributes["WEIGHTS_0"]).astype(np.float64)
    total = weight.sum(1, keepdims=True)
    weighted = (weight >= 0).all() and (total > 0).all() and (total < LARGEST_NUMBER).all()
    if not (np.abs(vertices) < FARTHEST).all() or not weighted:
        raise FileError(
            glb.path,
            f"has vertices in {name!r:.60} that are not finite, without joints, or {FARTHEST:g} m from the origin",
            "make the human again",
        )
    if not (np.abs(uv) <= LARGEST_UV).all():
        raise FileError(glb.path, f"has texture coordinates out of range in {name!r:.60}", "make the human again")
    return TexturedPart(
        name=name,
        vertices=vertices,
        faces=faces,
        corner_uv=np.stack([uv[..., 0], 1 - uv[..., 1]], -1)[faces].astype(np.float32),  # glTF's v points down
        texture=texture,
        skin_index=index.astype(np.int32),
        skin_weight=weight / total,
    )


@dataclasses.dataclass(frozen=True)
class _Surface:
    """What determines a material's texture: materials of equal surfaces share one array."""

    image: int | None
    """None for a plain colour."""
    factor: tuple[float, ...]
    """On linear red, green, blue and alpha."""
    alpha_scale: float | None
    """Factor on alpha, at which the cutoff is one half, as the rasteriser tests; None for opaque materials."""


class _Textures:
    """The textures of a file, each decoded once, and only as many as a file of its size may have."""

    def __init__(self, glb: Glb) -> None:
        self._glb = glb
        self._most_texels = min(MOST_TEXELS, decoded_bytes(glb.size) // 4)
        self._texels = 0
        self._decoded: dict[_Surface, UInt8[np.ndarray, "H W 4"]] = {}

    def of_material(self, number: int | None) -> UInt8[np.ndarray, "H W 4"]:
        """Base colour times factor; opaque unless the material uses alpha. Raises FileError."""
        surface = _surface(self._glb, number)
        if surface not in self._decoded:
            self._texels += 1 if surface.image is None else self._glb.picture_texels(surface.image)
            if self._texels > self._most_texels:
                reason = f"has textures of more than the {self._most_texels} texels that its size allows"
                raise FileError(self._glb.path, reason, "make a simpler human")
            self._decoded[surface] = _texture(self._glb, surface)
        return self._decoded[surface]


def _surface(glb: Glb, number: int | None) -> _Surface:
    material = {} if number is None else glb.content["materials"][number]
    about = material.get("pbrMetallicRoughness", {})
    image = None
    if "baseColorTexture" in about:
        image = int(glb.content["textures"][about["baseColorTexture"]["index"]]["source"])
    red, green, blue, alpha = map(float, about.get("baseColorFactor", (1, 1, 1, 1)))
    if material.get("alphaMode", "OPAQUE") == "OPAQUE":
        return _Surface(image, (red, green, blue), None)
    cutoff = float(material.get("alphaCutoff", 0.5)) if material["alphaMode"] == "MASK" else 0.5
    return _Surface(image, (red, green, blue), alpha * 0.5 / max(cutoff, 1e-3))


def _texture(glb: Glb, surface: _Surface) -> UInt8[np.ndarray, "H W 4"]:
    picture = np.full((1, 1, 4), 255, np.uint8) if surface.image is None else glb.picture(surface.image)
    if surface.factor != (1, 1, 1):
        linear = decode_srgb(np.arange(256)[:, None] / 255.0) * np.array(surface.factor)
        _replace(picture, np.round(encode_srgb(np.clip(linear, 0, 1)) * 255).astype(np.uint8))
    if surface.alpha_scale is None:
        picture[..., 3] = 255
    else:
        scaled = np.arange(256) * surface.alpha_scale
        _replace(picture[..., 3:], np.round(np.clip(scaled, 0, 255)).astype(np.uint8)[:, None])
    return picture


def _replace(values: UInt8[np.ndarray, "H W n"], table: UInt8[np.ndarray, "256 c"]) -> None:
    """Replace the first values of each texel by the table's, in place and a row at a time."""
    for row in values:
        for channel in range(table.shape[1]):
            row[:, channel] = table[row[:, channel], channel]
