"""Read human.npz, the backend's result: without pickle, and checked before the scene is touched."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..formats.arrays import ArrayFileError, array_names, check_shapes, read_arrays
from ..formats.joints import JOINT_NAMES, PARENTS
from .shape_model import FIELDS, INTEGERS, ShapeModel, faulty_field

FORMAT_VERSION = 2
"""The newest that is read; version 1 has no shape model."""
VOXELS = 8
"""Voxels along a side of a primitive."""


class HumanFileError(ValueError):
    """A human.npz cannot be used; the message is one sentence with the remedy."""


@dataclasses.dataclass(frozen=True)
class HumanFile:
    """A generated human at rest, in the backend's axes (y up, metres); `convention` turns them into Blender's."""

    meta: dict[str, object]
    """Provenance: seed, steps, checkpoint, full_density, version."""
    betas: NDArray[np.float64]
    """Body shape [10]."""
    joints: NDArray[np.float64]
    """Rest joints [24, 3]."""
    vertices: NDArray[np.float64]
    """Shaped rest surface [V, 3]."""
    faces: NDArray[np.int64]
    """Triangles [F, 3]."""
    uv_corner: NDArray[np.float64]
    """Texture coordinates of each triangle corner [F, 3, 2], v up."""
    skin_weights: NDArray[np.float64]
    """Rows sum to one [V, 24]."""
    position: NDArray[np.float64]
    """Primitive centres [K, 3]."""
    rotation: NDArray[np.float64]
    """Local to world [K, 3, 3]; columns T, B, N."""
    half_extent: NDArray[np.float64]
    """Half sides along T, B, N [K, 3]."""
    primitive_weights: NDArray[np.float64]
    """Skinning of each primitive [K, 24]; rows sum to one."""
    rgb: NDArray[np.float32]
    """Linear colour [K, D, H, W, 3]; D along N, H along B, W along T."""
    density: NDArray[np.float32]
    """Opacity per metre [K, D, H, W], before the marcher's window."""
    shape_model: ShapeModel | None = None
    """How the human changes with the betas; None in files of format version 1."""


_SHAPES: dict[str, tuple[int | str, ...]] = {
    "betas": (10,), "joints": (24, 3), "vertices": ("V", 3), "faces": ("F", 3), "uv_corner": ("F", 3, 2),
    "skin_weights": ("V", 24), "position": ("K", 3), "rotation": ("K", 3, 3), "half_extent": ("K", 3),
    "primitive_weights": ("K", 24), "rgb": ("K", VOXELS, VOXELS, VOXELS, 3), "density": ("K", VOXELS, VOXELS, VOXELS),
}  # fmt: skip
_DTYPES: dict[str, type] = {"faces": np.int64, "rgb": np.float32, "density": np.float32}
_SAME_SURFACE = 1e-4
"""Metres the surface may be off what the shape model gives for the betas."""
_REMEDY = "generate the person again"


def read_human(path: str | Path) -> HumanFile:
    """Read and check a human.npz.

    Raises HumanFileError when the file is missing, truncated, of another version, or holds arrays of the wrong shape,
    NaN, weights that do not sum to one, or frames that are not rotations.
    """
    path = Path(path)
    if not path.is_file():
        raise HumanFileError(f"there is no human file at {str(path)!r}; {_REMEDY}")
    try:
        arrays = read_arrays(path, array_names(path))
    except (ArrayFileError, OSError) as error:
        raise HumanFileError(f"{path.name!r} is damaged or no human file ({error}); {_REMEDY}") from error
    version = int(_scalar(arrays, "format_version", path))
    if not 1 <= version <= FORMAT_VERSION:
        raise HumanFileError(
            f"{path.name!r} has format version {version}, this add-on reads 1 to {FORMAT_VERSION}; "
            "use an add-on and a backend of the same release"
        )
    try:
        meta = json.loads(str(_scalar(arrays, "meta", path)))
    except json.JSONDecodeError as error:
        raise HumanFileError(f"the field 'meta' of {path.name!r} is not JSON ({error}); {_REMEDY}") from error
    _check_skeleton(arrays, path)
    sizes: dict[str, int] = {}
    human = _checked_values(HumanFile(meta=meta, **_fields(arrays, path, _SHAPES, sizes)), path)
    if version == 1:
        return human
    fields = _fields(arrays, path, FIELDS, sizes)
    dtypes = {name: np.int32 if name in INTEGERS else np.float32 for name in FIELDS}
    model = ShapeModel(**{name: value.astype(dtypes[name]) for name, value in fields.items()})
    return dataclasses.replace(human, shape_model=_checked_shape(model, human, path))


def _scalar(arrays: dict[str, NDArray], name: str, path: Path) -> Any:
    value = _field(arrays, name, path)
    if value.size != 1:
        raise HumanFileError(f"the field {name!r} of {path.name!r} holds {value.size} values instead of one; {_REMEDY}")
    return value.reshape(())[()]


def _field(arrays: dict[str, NDArray], name: str, path: Path) -> NDArray:
    if name not in arrays:
        raise HumanFileError(f"{path.name!r} has no field {name!r}; {_REMEDY}")
    return arrays[name]


def _check_skeleton(arrays: dict[str, NDArray], path: Path) -> None:
    names = tuple(str(name) for name in _field(arrays, "joint_names", path).ravel())
    parents = tuple(int(parent) for parent in _field(arrays, "parents", path).ravel())
    if names != JOINT_NAMES or parents != PARENTS:
        raise HumanFileError(f"the skeleton of {path.name!r} is not SMPL's 24 joints; choose a body in SMPL format")


def _fields(
    arrays: dict[str, NDArray], path: Path, shapes: dict[str, tuple[int | str, ...]], sizes: dict[str, int]
) -> dict[str, NDArray]:
    """The arrays of `shapes`, checked, each with its dtype."""
    fields = {name: _field(arrays, name, path) for name in shapes}
    try:
        check_shapes(path, fields, shapes, sizes)
    except ArrayFileError as error:
        raise HumanFileError(f"{error}; {_REMEDY}") from error
    return {name: values.astype(_DTYPES.get(name, np.float64)) for name, values in fields.items()}


def _checked_values(human: HumanFile, path: Path) -> HumanFile:
    for name in _SHAPES:
        if not np.isfinite(getattr(human, name)).all():
            raise HumanFileError(f"the field {name!r} of {path.name!r} holds NaN or infinite values; {_REMEDY}")
    gram = np.swapaxes(human.rotation, -1, -2) @ human.rotation
    faults = {
        "faces": human.faces.min() < 0 or human.faces.max() >= len(human.vertices),
        "half_extent": human.half_extent.min() <= 0,
        "density": human.density.min() < 0,
        "rotation": np.abs(gram - np.eye(3)).max() > 1e-3 or np.linalg.det(human.rotation).min() < 0,
        "skin_weights": not _rows_are_weights(human.skin_weights),
        "primitive_weights": not _rows_are_weights(human.primitive_weights),
    }
    for name, faulty in faults.items():
        if faulty:
            raise HumanFileError(f"the field {name!r} of {path.name!r} holds impossible values; {_REMEDY}")
    return human


def _checked_shape(model: ShapeModel, human: HumanFile, path: Path) -> ShapeModel:
    name = faulty_field(model)
    if name is None and np.abs(model.rest(human.betas).vertices - human.vertices).max() > _SAME_SURFACE:
        name = "shape_basis"
    if name is not None:
        raise HumanFileError(f"the field {name!r} of {path.name!r} holds impossible values; {_REMEDY}")
    return model


def _rows_are_weights(weights: NDArray) -> bool:
    return bool(weights.min() >= 0 and np.abs(weights.sum(-1) - 1).max() < 1e-3)
