""".human files: a human as the backend saves it (safetensors); and what a file holds, a human at rest on its body: the
default one, or the one in a file beside it.

Both programs find tensors in a file by `files.tensor_layout`; numpy is enough to read and write them.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import json
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.arrays import MOST_BODY_VALUES, all_finite, check_shapes, read_arrays
from ..files.regular_files import FileError, as_file_error, exists_in_its_folder, read_regular
from ..files.tensor_layout import DTYPES, LENGTH_BYTES, read_layout
from ..files.whole_files import atomic_path
from ..formats.body_layout import body_data, half_extents, stencils
from ..formats.body_layout import read_layout as read_body_layout
from ..formats.human_layout import (
    COMPACT_SCALES,
    LARGEST_VALUE,
    from_eight_bits,
    provenance_of,
    version_fault,
)
from .human import BETA_COUNT, BODY_FILE, LARGEST_BETA, LARGEST_PERSON, session_file
from .shape import FIELDS, OPTIONAL_FIELDS, Rest, ShapeModel, faulty_field
from .volumes import Grids, bake

_METADATA = "__metadata__"
_EIGHT_BIT = ("rgb", "density")
"""Arrays that compact files hold in eight bits."""
_FLOATS = ("F64", "F32", "F16", "BF16")
_PAYLOAD: dict[str, tuple[int | str, ...]] = {
    "rgb": ("K", 3, 8, 8, 8), "density": ("K", 8, 8, 8), "delta_scale": ("K", 3), "betas": (BETA_COUNT,),
    "rest_half_extent": ("K", 3),
}  # fmt: skip
GENERATE_AGAIN = "generate the human again"
"""What to do about a damaged file of a human in the scene, or of one that the backend has just written."""
CHOOSE_ANOTHER = "choose a .human file, or export the human again"
"""What to do about one that the user has chosen."""


@dataclasses.dataclass(frozen=True)
class HumanTensors:
    """The content of a .human file."""

    metadata: dict[str, str]
    arrays: dict[str, tuple[str, tuple[int, ...], bytes | memoryview]]
    """Safetensors' dtype, shape and bytes by name; those of a file that was read are views of its content."""


def read_tensors(path: Path, remedy: str = GENERATE_AGAIN) -> HumanTensors:
    """Read a .human file. Raises ValueError, with this remedy, for a file of another kind or a damaged one, OSError."""
    data = read_regular(path, LARGEST_PERSON)
    with as_file_error(path, "contains no human", remedy):
        layout = read_layout(io.BytesIO(data))
    if layout.metadata.get("format") != "primdiffusion.human":
        raise FileError(path, "contains no human but something else", remedy)
    arrays = {name: (one.dtype, one.shape, layout.raw(data, name)) for name, one in layout.tensors.items()}
    return HumanTensors(layout.metadata, arrays)


def body_arrays(path: Path) -> dict[str, NDArray]:
    """The arrays of a body's file. Raises ValueError for a file of another kind or a damaged one, OSError."""
    data = read_regular(path, LARGEST_PERSON)
    layout = read_layout(io.BytesIO(data))
    if layout.metadata.get("format") != "primdiffusion.body":
        raise ValueError("it contains no body")
    return {name: layout.array(data, name) for name in layout.tensors}


@dataclasses.dataclass(frozen=True, eq=False)
class HumanPayload:
    """What fills a human's boxes, and how large they are, as the backend's `Payload` and `Human` say."""

    rgb: NDArray[np.float32]
    """Linear colour [K, 3, 8, 8, 8]; voxels in the order D, H, W = along N, B, T."""
    density: NDArray[np.float32]
    """Opacity per metre [K, 8, 8, 8], without the marcher's window."""
    delta_scale: NDArray[np.float32]
    """Factors on the rest half extents [K, 3]."""
    betas: NDArray[np.float32]
    """The body's shape [10]."""
    rest_half_extent: NDArray[np.float32] | None
    """[K, 3], metres; None on the default body."""


def read_payload(path: Path) -> HumanPayload:
    """Read what is drawn of a .human file. Raises ValueError for a damaged file or a newer one, OSError."""
    return payload_in(read_tensors(path), path.name)


def payload_in(human: HumanTensors, name: str, remedy: str = GENERATE_AGAIN) -> HumanPayload:
    """As `read_payload`, of a file of this name that was read."""
    if fault := version_fault(human.metadata):
        raise FileError(repr(name), *fault)
    shapes = {field: shape for field, shape in _PAYLOAD.items() if field in human.arrays or field != "rest_half_extent"}
    with as_file_error(repr(name), "is damaged", remedy):
        stored = expanded(human).arrays
        if wrong := [field for field in shapes if stored[field][0] not in _FLOATS]:
            raise ValueError(f"{wrong[0]!r} holds no numbers")
        arrays = {field: _loaded(*stored[field]).astype(np.float32, copy=False) for field in shapes}
        check_shapes(name, arrays, shapes, {})
        if wrong := [field for field, values in arrays.items() if not all_finite(values)]:
            raise ValueError(f"{wrong[0]!r} holds NaN or infinite numbers")
        if wrong := [field for field, values in arrays.items() if np.abs(values).max() > LARGEST_VALUE]:
            raise ValueError(f"{wrong[0]!r} holds impossible values")
        if arrays["density"].min(initial=0) < 0:
            raise ValueError("'density' holds impossible values")
    return HumanPayload(**{"rest_half_extent": None, **arrays})


@functools.lru_cache(maxsize=64)
def read_sizes(path: Path) -> HumanPayload:
    """As `read_payload`, without colours and densities (empty arrays); cached, since a `session_file` never changes."""
    payload, nothing = read_payload(path), np.empty(0, np.float32)
    extents = payload.rest_half_extent
    return dataclasses.replace(
        payload,
        rgb=nothing,
        density=nothing,
        delta_scale=payload.delta_scale.copy(),  # views would keep the whole file in memory
        betas=payload.betas.copy(),
        rest_half_extent=None if extents is None else extents.copy(),
    )


def reshaped(human: HumanTensors, betas: NDArray, growth: NDArray | None) -> HumanTensors:
    """The human with another shape [10] and its boxes scaled by `growth` [K, 3], if given.

    Raises ValueError where the file holds another number of boxes.
    """
    arrays = {**human.arrays, "betas": _stored(np.asarray(betas, np.float32))}
    if growth is not None:
        dtype, shape, raw = human.arrays.get("delta_scale", ("", (), b""))
        if dtype != "F32" or shape != growth.shape:
            given, expected = f"{dtype}{list(shape)}", f"F32{list(growth.shape)}"
            raise FileError("the human's file", f"holds sizes of boxes as {given}, not {expected}", GENERATE_AGAIN)
        arrays["delta_scale"] = _stored((_loaded(dtype, shape, raw) * growth).astype(np.float32))
    return HumanTensors(human.metadata, arrays)


def expanded(human: HumanTensors) -> HumanTensors:
    """A compact file's human with colours and densities as floats. Raises ValueError or KeyError for a damaged one."""
    if COMPACT_SCALES not in human.metadata:
        return human
    metadata = {name: text for name, text in human.metadata.items() if name != COMPACT_SCALES}
    metadata["format_version"] = "2" if "body" in metadata else "1"
    stored = {name: _loaded(*human.arrays[name]) for name in _EIGHT_BIT}
    floats = from_eight_bits(stored, human.metadata[COMPACT_SCALES])
    return HumanTensors(metadata, {**human.arrays, **{name: _stored(values) for name, values in floats.items()}})


def write_tensors(path: Path, human: HumanTensors) -> None:
    """Write a .human file, which appears whole or not at all. Raises OSError."""
    header: dict[str, object] = {_METADATA: human.metadata}
    offset = 0
    sizes = {name: np.dtype(DTYPES.get(dtype, "u1")).itemsize for name, (dtype, _, _) in human.arrays.items()}
    ordered = sorted(human.arrays, key=lambda name: (-sizes[name], name))  # widest first, so that all are aligned
    for name in ordered:
        dtype, shape, raw = human.arrays[name]
        header[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": [offset, offset + len(raw)]}
        offset += len(raw)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % LENGTH_BYTES)
    with atomic_path(path) as unfinished, unfinished.open("wb") as file:
        file.write(len(text).to_bytes(LENGTH_BYTES, "little") + text)
        for name in ordered:
            file.write(human.arrays[name][2])


def _stored(array: NDArray) -> tuple[str, tuple[int, ...], bytes | memoryview]:
    return "F32", array.shape, np.ascontiguousarray(array, "<f4").tobytes()


def _loaded(dtype: str, shape: tuple[int, ...], raw: bytes | memoryview) -> NDArray:
    """An array as a view of its bytes; of bfloat16, which numpy does not have, as float32."""
    array = np.frombuffer(raw, DTYPES[dtype]).reshape(shape)
    return (array.astype("<u4") << 16).view("<f4") if dtype == "BF16" else array


def shape_model_of(person: bpy.types.Object) -> ShapeModel:
    """The model by which the human's body follows its shape. Raises as `session_file` and `session_body`."""
    return session_body(session_file(person))


def session_body(person: Path) -> ShapeModel:
    """The body of the human in a `session_file`, which never changes: cached. Raises as `body_beside`."""
    return default_body() if read_sizes(person).rest_half_extent is None else _session_body(person)


@functools.lru_cache(maxsize=4)
def _session_body(person: Path) -> ShapeModel:
    return body_beside(person, read_sizes(person))


def body_beside(person: Path, payload: HumanPayload) -> ShapeModel:
    """The body of the human in a file: the default one, or that of BODY_FILE beside it.

    Raises FileNotFoundError where BODY_FILE is missing, ValueError for a damaged file, OSError.
    """
    if payload.rest_half_extent is None:
        return default_body()
    path = person.with_name(BODY_FILE)
    if not exists_in_its_folder(path):
        raise FileNotFoundError(
            f"the body's file is missing: {str(path)!r}; put it back beside the human's file, or generate the human "
            "again"
        )
    with as_file_error(path, "is not a body or is damaged", "generate the human again"):
        arrays = body_arrays(path)
        if sum(values.size for values in arrays.values()) > MOST_BODY_VALUES:
            raise ValueError(f"it holds more than {MOST_BODY_VALUES} values")
        given = {name: shape for name, shape in OPTIONAL_FIELDS.items() if name in arrays}
        check_shapes(path.name, arrays, FIELDS | given, {})
        model = ShapeModel.from_arrays(arrays)
        if fault := faulty_field(model):
            raise ValueError(f"the field {fault!r} holds impossible values")
    return model


@functools.cache
def default_body() -> ShapeModel:
    """The body that comes with the extension; made in a tenth of a second, once."""
    keys = ("v_template", "shapedirs", "J_regressor", "weights", "f", "vt", "ft")
    stored, layout = read_arrays(body_data("body.npz"), keys), read_body_layout(body_data("layout.npz"))
    template, basis, faces = stored["v_template"], stored["shapedirs"], stored["f"].astype(np.int32)
    vertex, du, dv = stencils(faces, layout["texel_face"], layout["texel_barycentric"])
    support, regressor = template.astype(np.float64)[vertex], stored["J_regressor"].astype(np.float64)
    planes = (np.einsum("km,kmx->kx", weight, support) for weight in (du, dv))
    return ShapeModel.from_arrays(
        {
            "template": template,
            "shape_basis": basis,
            "joint_template": regressor @ template,
            "joint_basis": np.einsum("jv,vcn->jcn", regressor, basis, optimize=True),
            "faces": faces,
            "face": layout["cell_face"],
            "barycentric": layout["cell_barycentric"],
            "stencil_vertex": vertex,
            "stencil_du": du,
            "stencil_dv": dv,
            "skin_weights": stored["weights"],
            "rest_half_extent": half_extents(*planes, layout["cell_chart"]),
            "uv_corner": stored["vt"][stored["ft"]],
        }
    )


@dataclasses.dataclass(frozen=True, eq=False)
class RestHuman:
    """A human at rest, in the backend's axes (y up, metres); `convention` turns them into Blender's."""

    made: dict[str, Any]
    """Provenance: seed, steps, checkpoint, full_density, version."""
    payload: HumanPayload
    model: ShapeModel
    rest: Rest
    """The model at the payload's betas."""

    def grids(self) -> Grids:
        """The voxels of its volumes."""
        half_extent = self.rest_half_extent * self.payload.delta_scale
        return bake(self.payload.density, np.moveaxis(self.payload.rgb, 1, -1), half_extent)

    @property
    def rest_half_extent(self) -> NDArray[np.float64]:
        """Half sides of the boxes before their delta scale [K, 3], metres."""
        own = self.payload.rest_half_extent
        return np.asarray(self.model.rest_half_extent if own is None else own, np.float64)

    def provenance(self) -> str:
        """JSON for the custom property `human.MARK`."""
        return json.dumps({**self.made, "betas": np.round(self.payload.betas.astype(np.float64), 6).tolist()})


def read_human(person: Path, remedy: str = GENERATE_AGAIN) -> RestHuman:
    """Read a human and its body; `remedy` says what to do about a damaged file.

    Raises FileNotFoundError where a file is missing, ValueError for a damaged one, a newer one and one on another body,
    OSError.
    """
    if not person.exists():
        raise FileNotFoundError(f"there is no human file at {str(person)!r}; generate the human again")
    tensors = read_tensors(person, remedy)
    payload = payload_in(tensors, person.name, remedy)
    if np.abs(payload.betas).max() > LARGEST_BETA:
        raise FileError(person, f"has betas above {LARGEST_BETA}", remedy)
    with as_file_error(person, "is damaged", remedy):
        made = provenance_of(tensors.metadata)
    model = body_beside(person, payload)
    if len(payload.density) != len(model.face):
        reason = f"holds {len(payload.density)} primitives instead of its body's {len(model.face)}"
        raise FileError(person, reason, remedy)
    return RestHuman(made, payload, model, model.rest(payload.betas.astype(np.float64)))
