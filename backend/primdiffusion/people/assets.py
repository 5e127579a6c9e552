"""A MakeHuman asset pack (CC0): validation, its proxies (.mhclo with .obj), and decoded files cached per process.

The pack is not part of this package. `open_assets` takes its folder as an argument or from the environment variable
PRIMDIFFUSION_ASSETS; the folder contains `clothes`, `hair`, `eyebrows`, `eyelashes`, `eyes` and `skins` as does `base`
in https://github.com/makehumancommunity/makehuman-assets. Images may be .png or .jpg.

A proxy is a mesh and its binding to the base mesh. A vertex of it is a blend of three base vertices plus an offset,

    p_i = sum_k w_ik v(r_ik) + R_i (scale * o_i),    scale_axis = |v(a) - v(b)|_axis / denominator,

so that clothes fit any body. R_i is the identity in the pose that the files were made for; the base mesh of this
package is in T pose, so the caller passes the rotation of each vertex's limb.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from primdiffusion.files.regular_files import FileError, as_file_error, read_regular, real_path
from primdiffusion.geometry.pictures import decoded, opened_picture

LARGEST_TEXT = 64 * 2**20
"""Bytes of a file."""
LARGEST_NUMBER = 1e6
MOST_VERTICES = 10**7


@dataclasses.dataclass(frozen=True, eq=False)
class ObjMesh:
    """A triangulated Wavefront mesh."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    corner_uv: Float[np.ndarray, "F 3 2"]


@dataclasses.dataclass(frozen=True, eq=False)
class Scale:
    """Size of the base along one axis: the distance of two of its vertices, divided by the denominator."""

    first: int
    second: int
    denominator: float


@dataclasses.dataclass(frozen=True, eq=False)
class Proxy:
    """Binding of one mesh to the base mesh."""

    name: str
    reference: Int[np.ndarray, "V 3"]
    weight: Float[np.ndarray, "V 3"]
    offset: Float[np.ndarray, "V 3"]
    scales: tuple[Scale | None, Scale | None, Scale | None]
    """Scales along x, y and z; None leaves the offset in the base's unit."""
    z_depth: int
    """Layer, larger is further out: hidden vertices are hidden on the body and on proxies of smaller depth."""
    delete_vertices: Int[np.ndarray, " D"]
    """Base vertices that the proxy hides."""

    def fit(
        self, base_vertices: Float[np.ndarray, "B 3"], turn: Float[np.ndarray, "V 3 3"] | None = None
    ) -> Float[np.ndarray, "V 3"]:
        """Fit the proxy's vertices to a base mesh, in the base's unit; `turn` rotates each vertex's offset."""
        return self.anchor(base_vertices) + self.displacement(base_vertices, turn)

    def anchor(self, base_vertices: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "V 3"]:
        """Blend the base vertices, without the offset."""
        return np.einsum("vk,vkc->vc", self.weight, base_vertices[self.reference])

    def displacement(
        self, base_vertices: Float[np.ndarray, "B 3"], turn: Float[np.ndarray, "V 3 3"] | None = None
    ) -> Float[np.ndarray, "V 3"]:
        """Scale and rotate the offsets, in the base's unit."""
        size = np.ones(3)
        for axis, scale in enumerate(self.scales):
            if scale is not None:
                extent = abs(base_vertices[scale.first, axis] - base_vertices[scale.second, axis])
                size[axis] = extent / scale.denominator
        scaled = self.offset * size
        return scaled if turn is None else np.einsum("vij,vj->vi", turn, scaled)

    def blend(self, per_vertex: Float[np.ndarray, "B C"]) -> Float[np.ndarray, "V C"]:
        """Blend a quantity of the base mesh to the proxy's vertices."""
        return np.einsum("vk,vkc->vc", self.weight, per_vertex[self.reference])

    def hidden_by(self, hidden_base: np.ndarray) -> np.ndarray:
        """Find the proxy's vertices bound to hidden base vertices only ([B] bool -> [V] bool)."""
        return hidden_base[self.reference].all(axis=1)


def parse_obj(text: str) -> ObjMesh:
    """Parse vertices, texture coordinates and faces; polygons become triangle fans; missing uv are (0, 0).

    Raises:
        ValueError: a face refers to a vertex that does not exist, or a number is out of range.
    """
    vertices: list[list[float]] = []
    coordinates: list[list[float]] = [[0.0, 0.0]]
    faces: list[tuple[int, int, int]] = []
    face_coordinates: list[tuple[int, int, int]] = []
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            vertices.append([float(word) for word in words[1:4]])
        elif words[0] == "vt":
            coordinates.append([float(word) for word in words[1:3]])
        elif words[0] == "f":
            corners = [word.split("/") for word in words[1:]]
            index = [int(corner[0]) - 1 for corner in corners]
            uv_index = [int(corner[1]) if len(corner) > 1 and corner[1] else 0 for corner in corners]
            for k in range(1, len(index) - 1):
                faces.append((index[0], index[k], index[k + 1]))
                face_coordinates.append((uv_index[0], uv_index[k], uv_index[k + 1]))
    if any(not abs(value) <= LARGEST_NUMBER for row in (*vertices, *coordinates) for value in row):
        raise ValueError(f"it holds numbers that are not finite or above {LARGEST_NUMBER:g}")
    if not faces or not vertices:
        raise ValueError("it has no faces or no vertices")
    face_array = np.array(faces, np.int32)
    uv_array = np.array(face_coordinates)
    if face_array.min() < 0 or face_array.max() >= len(vertices) or uv_array.max() >= len(coordinates):
        raise ValueError(
            f"a face refers to others than its {len(vertices)} vertices and {len(coordinates) - 1} texture coordinates"
        )
    return ObjMesh(np.array(vertices, np.float64), face_array, np.array(coordinates, np.float64)[uv_array])


def parse_mhclo(text: str) -> Proxy:
    """Parse a .mhclo file; unknown keys are ignored.

    Raises:
        ValueError: no vertices, a line with a wrong number of values, or a number out of range.
    """
    reference: list[tuple[int, int, int]] = []
    weight: list[list[float]] = []
    offset: list[list[float]] = []
    scales: dict[str, Scale] = {}
    deleted: list[int] = []
    name, z_depth, section = "", 50, ""
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        key = words[0]
        if key in ("verts", "delete_verts", "weights"):
            section = key
        elif key in ("x_scale", "y_scale", "z_scale"):
            scales[key[0]] = Scale(int(words[1]), int(words[2]), float(words[3]))
        elif key == "name":
            name = " ".join(words[1:])
        elif key == "z_depth":
            z_depth = int(words[1])
        elif key.isdigit() and section == "verts":
            if len(words) not in (1, 6, 9):
                raise ValueError(f"a line of a vertex has {len(words)} values, not 1, 6 or 9")
            index = [int(word) for word in words[:3]] if len(words) > 1 else [int(key)] * 3
            reference.append((index[0], index[1], index[2]))
            weight.append([float(word) for word in words[3:6]] if len(words) > 1 else [1.0, 0.0, 0.0])
            offset.append([float(word) for word in words[6:9]] if len(words) == 9 else [0.0, 0.0, 0.0])
        elif key.isdigit() and section == "delete_verts":
            deleted.extend(_vertex_ranges(words))
    if not reference:
        raise ValueError("it has no vertices after its line 'verts'")
    if any(not abs(value) <= LARGEST_NUMBER for row in (*weight, *offset) for value in row):
        raise ValueError(f"it holds numbers that are not finite or above {LARGEST_NUMBER:g}")
    return Proxy(
        name=name,
        reference=np.array(reference, np.int64),
        weight=np.array(weight),
        offset=np.array(offset),
        scales=(scales.get("x"), scales.get("y"), scales.get("z")),
        z_depth=z_depth,
        delete_vertices=np.unique(np.array(deleted, np.int64)),
    )


def _vertex_ranges(words: list[str]) -> list[int]:
    """Parse vertex indices such as `3 7 - 9`; ranges are inclusive."""
    numbers: list[int] = []
    in_range = False
    for word in words:
        if word == "-":
            in_range = True
        elif in_range:
            last = int(word)
            if last > MOST_VERTICES:
                raise ValueError(f"it deletes vertex {last}, more than there are")
            numbers.extend(range(numbers[-1] + 1, last + 1))
            in_range = False
        else:
            numbers.append(int(word))
    return numbers


def read_pair(mhclo: Path, obj: Path) -> tuple[Proxy, ObjMesh]:
    """Read a proxy and its mesh.

    Raises:
        FileError: the files are damaged or do not belong together.
    """
    with as_file_error(mhclo, "is not a binding of clothes", "fetch it again"):
        proxy = parse_mhclo(read_regular(mhclo, LARGEST_TEXT).decode("utf-8", errors="replace"))
    with as_file_error(obj, "is not a mesh of an asset pack", "fetch it again"):
        mesh = parse_obj(read_regular(obj, LARGEST_TEXT).decode("utf-8", errors="replace"))
    if len(proxy.reference) != len(mesh.vertices):
        reason = f"binds {len(proxy.reference)} vertices, but {obj.name} has {len(mesh.vertices)}"
        raise FileError(mhclo, reason, "fetch both again")
    return proxy, mesh


ENVIRONMENT_VARIABLE = "PRIMDIFFUSION_ASSETS"
SUBFOLDERS = ("clothes", "hair", "eyebrows", "eyelashes", "eyes", "skins")
SOURCE = "https://github.com/makehumancommunity/makehuman-assets"


@dataclasses.dataclass(frozen=True)
class Assets:
    """A validated asset folder; images and meshes are decoded on first use and cached."""

    root: Path

    def proxy(self, name: str) -> tuple[Proxy, ObjMesh]:
        """Load a proxy and its mesh by path without extension, such as "clothes/shoes01/shoes01"."""
        return _pair(self.root / f"{name}.mhclo", self.root / f"{name}.obj")

    def has_picture(self, name: str) -> bool:
        """Whether the folder has this image, in either format."""
        return _picture_path(self.root, name) is not None

    def picture(self, name: str, size: int) -> UInt8[np.ndarray, "H W 4"]:
        """Load an image by path without extension, at most `size` pixels wide: read-only sRGB and alpha.

        Raises:
            FileNotFoundError: the folder has no such image.
            FileError: it cannot be decoded.
        """
        path = _picture_path(self.root, name)
        if path is None:
            raise FileNotFoundError(
                f"{name}.png or .jpg is missing from the asset folder {self.root}: get it from {SOURCE} (with git-lfs)"
            )
        return _decoded(path, size)

    def pictures(self, folder: str, contains: str = "") -> tuple[str, ...]:
        """Names (without extension, sorted) of the images in a folder whose file name contains a word."""
        found = {
            f"{folder}/{path.stem}"
            for path in (self.root / folder).glob("*")
            if path.suffix in (".png", ".jpg") and contains in path.stem and _is_picture(path)
        }
        return tuple(sorted(found))


def open_assets(folder: str | os.PathLike[str] | None = None, required: tuple[str, ...] = ()) -> Assets:
    """Open and validate the asset folder.

    Args:
        folder: the asset folder; None for that of the environment variable PRIMDIFFUSION_ASSETS.
        required: meshes that must exist, as paths without extension; each needs a .mhclo and a .obj.

    Raises:
        FileNotFoundError: no folder was given, it does not exist, or subfolders or required files are missing.
    """
    named = folder if folder is not None else os.environ.get(ENVIRONMENT_VARIABLE)
    if not named:
        raise FileNotFoundError(
            f"no MakeHuman asset folder was given: pass one with --assets or set {ENVIRONMENT_VARIABLE}; "
            f"the pack is CC0: {SOURCE}, folder 'base'"
        )
    root = real_path(Path(named).expanduser())
    if not root.is_dir():
        raise FileNotFoundError(
            f"the MakeHuman asset folder {root} does not exist: pass the folder with {', '.join(SUBFOLDERS)}"
        )
    missing = [name for name in SUBFOLDERS if not (root / name).is_dir()]
    files = [f"{name}{ending}" for name in required for ending in (".mhclo", ".obj")]
    missing += [file for file in files if not (root / file).is_file()]
    if missing:
        listed = ", ".join(missing[:6]) + (", ..." if len(missing) > 6 else "")
        raise FileNotFoundError(
            f"missing from the MakeHuman asset folder {root}: {listed}; get the pack's folder 'base' from {SOURCE}"
        )
    return Assets(root)


@functools.lru_cache(maxsize=256)
def _pair(mhclo: Path, obj: Path) -> tuple[Proxy, ObjMesh]:
    return read_pair(mhclo, obj)


def _is_picture(path: Path) -> bool:
    """Whether a file is larger than the pointer that git-lfs leaves for files it has not fetched."""
    return path.is_file() and path.stat().st_size > 1024


def _picture_path(root: Path, name: str) -> Path | None:
    for ending in (".png", ".jpg"):
        path = root / f"{name}{ending}"
        if _is_picture(path):
            return path
    return None


@functools.lru_cache(maxsize=48)
def _decoded(path: Path, size: int) -> UInt8[np.ndarray, "H W 4"]:
    """Decode and shrink an image; shrinking weights colour by alpha, so that edges keep their colour."""
    with as_file_error(path, "cannot be decoded", "fetch it again", OSError), opened_picture(path) as picture:
        array = decoded(picture, "RGBA") if picture.width <= size else _shrunk(picture, size)
    array.setflags(write=False)
    return array


def _shrunk(picture: Image.Image, width: int) -> UInt8[np.ndarray, "H W 4"]:
    size = (width, max(1, round(picture.height * width / picture.width)))
    return np.array(picture.convert("RGBA").convert("RGBa").resize(size, Image.Resampling.BOX).convert("RGBA"))
