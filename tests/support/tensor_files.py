"""Files of synthetic humans: safetensors, written and read by numpy alone, without the product's code."""

import json
from pathlib import Path

import numpy as np

BODY = "body.safetensors"
_DTYPES = {"f": ("F32", "<f4"), "i": ("I32", "<i4"), "u": ("I32", "<i4")}
_NUMPY = {"F32": "<f4", "F16": "<f2", "I32": "<i4"}


def write_tensors(path: Path, arrays: dict[str, np.ndarray], metadata: dict[str, str]) -> None:
    header, data = {"__metadata__": metadata}, b""
    for name, array in arrays.items():
        dtype, kind = _DTYPES[array.dtype.kind]
        raw = np.ascontiguousarray(array, kind).tobytes()
        header[name] = {"dtype": dtype, "shape": list(array.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    content = path.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    metadata, arrays = header.pop("__metadata__"), {}
    for name, about in header.items():
        begin, end = about["data_offsets"]
        values = np.frombuffer(content[start + begin : start + end], _NUMPY[about["dtype"]])
        arrays[name] = values.reshape(about["shape"])
    return arrays, metadata


def write_human(path: Path, arrays: dict[str, np.ndarray], made: dict) -> Path:
    """The human's file, and the file of its body beside it; `arrays` are those of `synthetic.arrays`."""
    body = ("template", "shape_basis", "joint_template", "joint_basis", "faces", "uv_corner", "skin_weights", "face",
            "barycentric", "stencil_vertex", "stencil_du", "stencil_dv", "rest_half_extent", "pose_basis")  # fmt: skip
    metadata = {"format": "primdiffusion.body", "format_version": "1"}
    write_tensors(path.with_name(BODY), {name: arrays[name] for name in body if name in arrays}, metadata)
    payload = {
        "rgb": np.moveaxis(arrays["rgb"], -1, 1),
        "density": arrays["density"],
        "delta_scale": arrays["half_extent"] / arrays["rest_half_extent"],
        "betas": arrays["betas"],
        "rest_half_extent": arrays["rest_half_extent"],
    }
    metadata = {"format": "primdiffusion.human", "format_version": "2", "body": "{}", "provenance": json.dumps(made)}
    write_tensors(path, payload, metadata)
    return path
