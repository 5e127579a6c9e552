"""Read humans from the skinned .glb files that `primdiffusion people` writes (`people/gltf.py`): no other glTF."""

from __future__ import annotations

import dataclasses
import functools
import io
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.files.arrays import LARGEST_NUMBER
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import as_file_error, read_regular
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.pictures import MOST_PIXELS, decoded, decoded_bytes, opened_picture
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.rasterise import Draw, Figure, figure_from_mesh

NUMBERS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
LARGEST_GLB = 256 * 2**20
MOST_PARTS, MOST_CORNERS, MOST_TEXELS = 100, 20_000_000, 2 * MOST_PIXELS
"""Limits of a human."""
UNBACKED_CORNERS = 1_000_000
"""Corners and vertices however small the file is; beyond, one for each byte: parts may share accessors."""
LARGEST_UV = 1e4
"""Repeats of a texture."""
SUBJECT_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
FARTHEST = 10.0
"""Largest distance of a vertex from the origin, metres; a stray vertex would move the cameras far away."""
LARGEST_CAPTURED_BETA = 20.0
"""Standard deviations; larger betas put joints outside any body."""


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
    """Find the humans of `primdiffusion people` in a folder: NAME/person.glb, sorted by name.

    Raises:
        FileNotFoundError: the folder does not exist or contains none.
    """
    found = {path.parent.name: path for path in sorted(Path(folder).glob("*/person.glb"))}
    found = {name: path for name, path in found.items() if SUBJECT_NAME.fullmatch(name)}
    if not found:
        raise FileNotFoundError(f"{folder} contains no NAME/person.glb: make some with primdiffusion people")
    return found


def read_person(path: str | Path) -> SkinnedPerson:
    """Read a human.

    Raises:
        FileNotFoundError: the file does not exist.
        FileError: it is damaged, or not a human of `primdiffusion people`.
    """
    data = read_regular(path, LARGEST_GLB)
    with as_file_error(path, "is not a human of `primdiffusion people`", "make it again", struct.error, OSError):
        glb = _Glb(data)
        return SkinnedPerson(TexturedMesh(_parts(glb)), _betas(glb.content["asset"]["extras"]["primdiffusion"]))


class _Glb:
    """A .glb file in memory. What damaged content raises is for `as_file_error`."""

    def __init__(self, data: bytes) -> None:
        magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
        if (magic, version, kind) != (b"glTF", 2, b"JSON") or length != len(data):
            raise ValueError("it is not a whole binary glTF 2.0 file")
        self.content: Any = parse_json(data[20 : 20 + size])
        self._binary, self._textures = data[28 + size :], {}
        self._texels = min(MOST_TEXELS, decoded_bytes(length) // 4)
        self.most_corners = min(MOST_CORNERS, UNBACKED_CORNERS + length)

    def array(self, accessor: int) -> NDArray:
        """Values of an accessor, [count] or [count, width]."""
        about = self.content["accessors"][accessor]
        first = self.content["bufferViews"][about["bufferView"]]["byteOffset"]
        width = WIDTHS[about["type"]]
        values = np.frombuffer(self._binary, NUMBERS[about["componentType"]], about["count"] * width, first)
        return values if width == 1 else values.reshape(-1, width)

    def texture(self, material: int) -> UInt8[np.ndarray, "H W 4"]:
        """The picture of a material, sRGB-encoded with straight alpha; one array for all materials that share it."""
        surface = self.content["materials"][material]["pbrMetallicRoughness"]
        image = self.content["textures"][surface["baseColorTexture"]["index"]]["source"]
        if image not in self._textures:
            view = self.content["bufferViews"][self.content["images"][image]["bufferView"]]
            raw = self._binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
            with opened_picture(io.BytesIO(raw)) as picture:
                self._texels -= picture.width * picture.height
                if self._texels < 0:
                    raise ValueError("it has more texels than a file of its size may have")
                self._textures[image] = decoded(picture, "RGBA")
        return self._textures[image]


def _betas(about: Any) -> Float[np.ndarray, "n"]:
    if about.get("body", "default") != "default":
        raise ValueError(f"it is rigged on the body {about['body']!r:.60}, not the default body")
    betas, components = np.asarray(about["betas"], np.float64), default_body().shape_basis.shape[-1]
    if betas.ndim != 1 or len(betas) > components or not (np.abs(betas) <= LARGEST_CAPTURED_BETA).all():
        raise ValueError(f"its betas are not at most {components} numbers within {LARGEST_CAPTURED_BETA:g} of 0")
    return betas


def _parts(glb: _Glb) -> tuple[TexturedPart, ...]:
    nodes, accessors = glb.content["nodes"], glb.content["accessors"]
    if [nodes[joint]["name"] for joint in glb.content["skins"][0]["joints"]] != list(JOINT_NAMES):
        raise ValueError("its joints are not those of the default body")
    meshes = [(node["name"], glb.content["meshes"][node["mesh"]]["primitives"][0]) for node in nodes if "mesh" in node]
    if not 0 < len(meshes) <= MOST_PARTS:
        raise ValueError(f"it has {len(meshes)} parts, not 1 to {MOST_PARTS}")
    shown = [number for _, one in meshes for number in (one["indices"], one["attributes"]["POSITION"])]
    if sum(accessors[number]["count"] for number in shown) > glb.most_corners:
        raise ValueError(f"it has more than the {glb.most_corners} corners and vertices that its size allows")
    return tuple(_part(glb, str(name), primitive) for name, primitive in meshes)


def _part(glb: _Glb, name: str, primitive: Any) -> TexturedPart:
    attributes = {key: glb.array(accessor) for key, accessor in primitive["attributes"].items()}
    vertices, uv = attributes["POSITION"].astype(np.float64), attributes["TEXCOORD_0"]
    index, weight = attributes["JOINTS_0"].astype(np.int32), attributes["WEIGHTS_0"].astype(np.float64)
    faces = glb.array(primitive["indices"]).reshape(-1, 3).astype(np.int64)
    count = len(vertices)
    if [array.shape for array in (vertices, uv, index, weight)] != [(count, width) for width in (3, 2, 4, 4)]:
        raise ValueError(f"{name!r:.60} has not one position, texture coordinate, and four joints a vertex")
    if not ((faces >= 0) & (faces < count)).all() or not ((index >= 0) & (index < len(JOINT_NAMES))).all():
        raise ValueError(f"{name!r:.60} has faces or joints that are not there")
    total = weight.sum(1, keepdims=True)
    weighted = (weight >= 0).all() and (total > 0).all() and (total < LARGEST_NUMBER).all()
    if not ((np.abs(vertices) < FARTHEST).all() and weighted and (np.abs(uv) <= LARGEST_UV).all()):
        raise ValueError(f"{name!r:.60} has positions, weights or texture coordinates out of range")
    return TexturedPart(
        name=name,
        vertices=vertices,
        faces=faces.astype(np.int32),
        corner_uv=np.stack([uv[..., 0], 1 - uv[..., 1]], -1)[faces].astype(np.float32),  # glTF's v points down
        texture=glb.texture(primitive["material"]),
        skin_index=index,
        skin_weight=weight / total,
    )
