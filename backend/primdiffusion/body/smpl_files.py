"""Load body models in SMPL's file format: the user's own SMPL files, or any body in the same layout.

SMPL is licensed by its authors and never part of this package. Its files hold no texture coordinates, which the layout
of primitives needs, so these come from a second file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from primdiffusion.body.model import BodyModel, J
from primdiffusion.files.arrays import all_finite, array_names, read_arrays, read_npy
from primdiffusion.files.regular_files import FileError, check_regular, check_size, read_regular
from primdiffusion.files.smpl_pickle import as_array, read_pickle

LARGEST_BODY_FILE = 512 * 2**20
"""SMPL with 300 shape components takes 250 MB."""
LARGEST_OBJ = 32 * 2**20
MOST_FACES, MOST_NUMBERS = 100_000, 32_000_000
"""Faces of a body, and numbers in one of its arrays: five and two times SMPL-X's. They become larger types."""
LARGEST_BODY_M = 1000.0
SHAPE_COMPONENTS = 10
"""Shape components loaded by default, of the up to 300 in SMPL files."""
POSE_FEATURES = (J - 1) * 9
_ROOT_MARKS = (-1, 2**32 - 1, 2**64 - 1)
"""Encodings of "no parent": -1, or -1 converted to an unsigned integer."""


def load_body(path: str | Path, uv: str | Path | tuple[Path, Path]) -> BodyModel:
    """Load a body (float32) from an SMPL .pkl or .npz, with the first ten of its 10 to 300 shape components.

    Args:
        path: the body model. Pickles are read by `smpl_pickle` and cannot run code.
        uv: texture coordinates: an .obj with the body's vertex indices, an .npz with vt [T, 2] and ft [F, 3], or
            the pair (vt.npy, ft.npy).

    Raises:
        FileNotFoundError: a file does not exist.
        FileError: a file is truncated, lacks an array, or holds one of the wrong shape, type or range, or a pickle
            names a global that arrays do not need.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"There is no body model at {path}; give the path of an SMPL .pkl or .npz file.")
    arrays = _ArrayFile(Path(path))
    template = arrays.real("v_template", ("V", 3))
    vertex_count = len(template)
    if np.abs(template).max() > LARGEST_BODY_M:
        raise arrays.wrong("v_template", f"has vertices more than {LARGEST_BODY_M:g} m away")
    faces = arrays.whole("f", ("F", 3), vertex_count)
    shape_basis = arrays.real("shapedirs", (vertex_count, 3, "N"))[..., :SHAPE_COMPONENTS]
    pose_basis = arrays.real("posedirs", (vertex_count, 3, POSE_FEATURES))
    skin_weights = arrays.real("weights", (vertex_count, J))
    if skin_weights.min() < -1e-4 or np.abs(skin_weights.sum(1) - 1).max() > 1e-2:
        raise arrays.wrong("weights", "has rows that are not weights (non-negative, with sum 1)")
    regressor = arrays.real("J_regressor", (J, vertex_count))
    coordinates, coordinate_faces = _texture_coordinates(uv, faces)
    return BodyModel(
        template=torch.from_numpy(template),
        shape_basis=torch.from_numpy(np.ascontiguousarray(shape_basis)),
        pose_basis=torch.from_numpy(pose_basis if pose_basis.any() else pose_basis[..., :0]),
        joint_regressor=torch.from_numpy(regressor),
        skin_weights=torch.from_numpy(skin_weights),
        parents=torch.from_numpy(_parents(arrays)),
        faces=torch.from_numpy(faces),
        uv=torch.from_numpy(coordinates),
        uv_faces=torch.from_numpy(coordinate_faces),
    )


class _ArrayFile:
    """Named arrays of one file, validated on access."""

    def __init__(self, file: Path) -> None:
        self.file = file
        if file.suffix not in (".pkl", ".npz"):
            raise FileError(file, f"ends in {file.suffix!r}, not in .pkl or .npz", "give a body model in SMPL's format")
        check_size(file, check_regular(file).st_size, LARGEST_BODY_FILE)
        self._pickled = read_pickle(file, LARGEST_BODY_FILE) if file.suffix == ".pkl" else None
        self._names = set(array_names(file)) if self._pickled is None else set(self._pickled)

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def wrong(self, name: str, complaint: str) -> FileError:
        remedy = "use an unchanged SMPL file or one in the same format"
        return FileError(self.file, f"cannot be used ({name!r} {complaint})", remedy)

    def raw(self, name: str) -> np.ndarray:
        if name not in self:
            raise self.wrong(name, "is missing")
        try:
            if self._pickled is not None:
                return as_array(self._pickled[name])
            return read_arrays(self.file, (name,))[name]
        except FileError:
            raise
        except (ValueError, OSError) as error:
            raise self.wrong(name, f"cannot be read: {error!s:.120}") from error

    def shaped(self, name: str, shape: tuple[int | str, ...]) -> np.ndarray:
        array = self.raw(name)
        right = array.ndim == len(shape) and all(
            size == wanted if isinstance(wanted, int) else size > 0
            for size, wanted in zip(array.shape, shape, strict=True)
        )
        if not right:
            wanted = " x ".join(map(str, shape))
            raise self.wrong(name, f"has shape {' x '.join(map(str, array.shape))} where {wanted} is needed")
        if array.size > MOST_NUMBERS:
            raise self.wrong(name, f"holds {array.size} numbers, more than {MOST_NUMBERS}")
        if array.dtype.kind not in "biuf":
            raise self.wrong(name, f"holds {array.dtype} where numbers are needed")
        return array

    def real(self, name: str, shape: tuple[int | str, ...]) -> np.ndarray:
        with np.errstate(over="ignore"):  # infinite numbers are rejected below
            array = np.array(self.shaped(name, shape), np.float32)
        if not all_finite(array):
            raise self.wrong(name, "holds NaN or infinite numbers")
        return array

    def whole(self, name: str, shape: tuple[int | str, ...], limit: int) -> np.ndarray:
        array = self.shaped(name, shape)
        if len(array) > MOST_FACES:
            raise self.wrong(name, f"has {len(array)} rows, more than {MOST_FACES}")
        number = np.array(array, np.int64)
        if not np.array_equal(number, array) or number.min() < 0 or number.max() >= limit:
            raise self.wrong(name, f"holds numbers that are not whole and from 0 to {limit - 1}")
        return number


def _parents(arrays: _ArrayFile) -> np.ndarray:
    parents, joints = np.array(arrays.shaped("kintree_table", (2, J)), np.float64)
    parents = np.where(np.isin(parents, np.array(_ROOT_MARKS, np.float64)), -1, parents).astype(np.int64)
    in_order = (parents[0] == -1) and (parents[1:] >= 0).all() and (parents < np.arange(J)).all()
    if not np.array_equal(joints, np.arange(J)) or not in_order:
        raise arrays.wrong("kintree_table", "is not a tree of joints in which parents come first")
    return parents


def _texture_coordinates(uv: str | Path | tuple[Path, Path], faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    given = tuple(map(Path, uv if isinstance(uv, tuple) else (uv,)))
    source = given[-1]
    if len(given) == 2:
        coordinates, coordinate_faces = map(_numpy_file, given)
    elif source.suffix == ".npz":
        held = _ArrayFile(source)
        coordinates, coordinate_faces = held.raw("vt"), held.raw("ft")
    else:
        coordinates, coordinate_faces = _obj_texture_coordinates(source, faces)
    numbers = coordinates.dtype.kind in "iuf" and coordinate_faces.dtype.kind in "iuf"
    if not numbers or coordinates.ndim != 2 or coordinates.shape[1] != 2 or coordinate_faces.shape != faces.shape:
        raise FileError(
            source,
            f"has texture coordinates of shapes {coordinates.shape} and {coordinate_faces.shape}, which do not fit a "
            f"body of {len(faces)} faces",
            f"give numbers T x 2 and {len(faces)} x 3, in the body's face order",
        )
    coordinate_faces = coordinate_faces.astype(np.int64)
    if not all_finite(coordinates) or coordinate_faces.min() < 0 or coordinate_faces.max() >= len(coordinates):
        raise FileError(
            source, "has texture coordinates that are NaN or numbered out of range", "use the body's own UV file"
        )
    return coordinates.astype(np.float32), coordinate_faces


def _numpy_file(file: Path) -> np.ndarray:
    array = read_npy(file)
    if array.dtype.kind not in "iuf":
        raise FileError(file, "does not hold one array of numbers", "give the pair (vt.npy, ft.npy)")
    return array


def _obj_texture_coordinates(file: Path, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read texture coordinates from an OBJ with the body's triangles, in any order."""
    coordinates: list[list[float]] = []
    corner_of_face: dict[frozenset[int], dict[int, int]] = {}
    try:
        for line in read_regular(file, LARGEST_OBJ).decode("latin1").splitlines():
            key, _, rest = line.partition(" ")
            if key == "vt":
                coordinates.append([float(number) for number in rest.split()[:2]])
            elif key == "f":
                corner_numbers = [[int(number) - 1 for number in corner.split("/")[:2]] for corner in rest.split()]
                corners = {vertex: coordinate for vertex, coordinate in corner_numbers}
                corner_of_face[frozenset(corners)] = corners
        coordinate_faces = [[corner_of_face[frozenset(face)][v] for v in face] for face in faces.tolist()]
        return np.array(coordinates), np.array(coordinate_faces)
    except (ValueError, TypeError, IndexError, OverflowError) as error:
        reason = f"is not an OBJ with texture coordinates in every face ({error!s:.100})"
        raise FileError(file, reason, "use the OBJ made for this body") from error
    except KeyError as error:
        reason = f"lacks a face of the body (vertices {sorted(error.args[0])}, counted from 0)"
        raise FileError(file, reason, "use the OBJ made for this body") from error
