"""Binary glTF 2.0 files: their JSON and the arrays and pictures in them.

Nothing outside the file is opened, whatever it names. Sparse accessors and compressed meshes are not read.
"""

from __future__ import annotations

import dataclasses
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image

MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\x00"
NUMBERS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GlbError(ValueError):
    """A file that is no binary glTF, is damaged, or uses what is not read here."""


@dataclasses.dataclass(frozen=True, eq=False)
class Glb:
    """A file in memory."""

    path: Path
    content: dict[str, Any]
    """The JSON."""
    binary: bytes

    def array(self, accessor: int) -> NDArray:
        """The numbers of an accessor, [count] or [count, width]; normalised integers as float32 of 0 ... 1.

        Raises:
            GlbError: it is not there, reaches out of the file, or is sparse.
        """
        try:
            about = self.content["accessors"][accessor]
            if "sparse" in about or accessor < 0:
                raise GlbError(f"{self.path}: accessor {accessor} is sparse, which is not read: export without")
            view = self.content["bufferViews"][about["bufferView"]]
            number, width, count = np.dtype(NUMBERS[about["componentType"]]), WIDTHS[about["type"]], int(about["count"])
            first = int(view.get("byteOffset", 0)) + int(about.get("byteOffset", 0))
            stride = int(view.get("byteStride", 0)) or number.itemsize * width
            if min(first, count - 1, stride - number.itemsize * width) < 0:
                raise ValueError("negative size")
            raw = np.frombuffer(self.binary, np.uint8, (count - 1) * stride + number.itemsize * width, first)
        except GlbError:
            raise
        except (LookupError, TypeError, ValueError) as e:
            raise GlbError(f"{self.path}: accessor {accessor} is damaged ({e}): export the file again") from e
        rows = np.lib.stride_tricks.as_strided(raw, (count, number.itemsize * width), (stride, 1))
        values = np.ascontiguousarray(rows).view(number)
        if about.get("normalized") and number.kind in "iu":
            values = np.maximum(values.astype(np.float32) / np.iinfo(number).max, -1)
        return values[:, 0] if width == 1 else values

    def picture(self, image: int) -> UInt8[np.ndarray, "H W 4"]:
        """An image, sRGB-encoded with straight alpha.

        Raises:
            GlbError: it is not there, not in the file, or no picture.
        """
        try:
            view = self.content["bufferViews"][self.content["images"][image]["bufferView"]]
            first = int(view.get("byteOffset", 0))
            data = self.binary[first : first + int(view["byteLength"])]
            with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as picture:
                return np.asarray(picture.convert("RGBA"))
        except (LookupError, TypeError, ValueError, OSError, SyntaxError, Image.DecompressionBombError) as e:
            raise GlbError(f"{self.path}: image {image} cannot be read ({e}): pack PNG or JPEG into the file") from e


def read_glb(path: str | Path) -> Glb:
    """A .glb file.

    Raises:
        FileNotFoundError: there is none.
        GlbError: it is something else, or cut short.
    """
    path = Path(path)
    data = path.read_bytes()
    try:
        magic, version, length = struct.unpack_from("<4sII", data)
        if magic != MAGIC or version != 2:
            raise GlbError(f"{path} is no binary glTF 2.0 file: export it as .glb")
        if length > len(data):
            raise GlbError(f"{path} is cut short, {len(data)} of {length} bytes: write it again")
        chunks, at = {}, 12
        while at + 8 <= length:
            size, kind = struct.unpack_from("<I4s", data, at)
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        content = json.loads(chunks[JSON_CHUNK])
    except (struct.error, KeyError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as e:
        raise GlbError(f"{path} is no whole .glb file ({e}): write it again") from e
    if not isinstance(content, dict):
        raise GlbError(f"{path} holds no glTF object: write it again")
    return Glb(path, content, chunks.get(BINARY_CHUNK, b""))
