"""The file of a human's body, from which its shape follows: `body_<hash>.npz`, beside the humans' folders."""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np

from ..formats.arrays import MOST_BODY_VALUES, check_shapes, read_arrays
from ..formats.regular_files import exists_in_its_folder
from ..formats.removing import remove_file
from ..formats.whole_files import replacing
from .blend_values import stored_name
from .human import VolumeWriteError, folders_of
from .shape import FIELDS, INTEGERS, OPTIONAL_FIELDS, ShapeModel, faulty_field

BODY_FILE = "primdiffusion_body_file"
"""Custom property of a human's collection: the name of its body's file."""
BODY_NPZ = re.compile(r"body_[0-9a-f]{12}\.npz")
"""Names that BODY_FILE may hold; the hash is of the content."""
_SMALL, _SMALL_LIMIT = np.uint16, 2**16
"""Integers in files, where they fit: bodies have fewer vertices and faces."""


def shape_model_of(collection: bpy.types.Collection) -> ShapeModel:
    """The model by which the human's body follows its shape. Raises ValueError or FileNotFoundError."""
    path = body_file(collection)
    if path is None:
        raise ValueError(
            f"the human {collection.name!r} was made by an earlier version and cannot be reshaped: generate the "
            "human again, or vary it"
        )
    return read_body_file(path)


def stored_body_name(collection: bpy.types.Collection) -> str | None:
    """The name of the body's file; None for a human of an earlier version, whose collection does not name one."""
    return stored_name(collection, BODY_FILE, BODY_NPZ)


def body_file(collection: bpy.types.Collection) -> Path | None:
    """The file of the human's body, or where it should be; None where `stored_body_name` is."""
    name = stored_body_name(collection)
    if name is None:
        return None
    paths = [folder / name for near in folders_of(collection) for folder in (near.parent, near)]
    return next((path for path in paths if exists_in_its_folder(path)), paths[0])


def body_file_name(model: ShapeModel) -> str:
    """The name of a shape model's file."""
    digest = hashlib.sha256()
    for values in model.arrays().values():
        digest.update(np.ascontiguousarray(values).tobytes())
    return f"body_{digest.hexdigest()[:12]}.npz"


@contextmanager
def saved_body_file(model: ShapeModel, folder: Path) -> Iterator[str]:
    """Write the model's file in `folder` if it is not there, yield its name, and remove it again if the block fails.

    Raises VolumeWriteError.
    """
    path = folder / body_file_name(model)
    made = not path.exists()
    if made:
        _write(path, model)
    try:
        yield path.name
    except BaseException:
        if made:
            remove_file(path, path.parent)
        raise


@contextmanager
def saved_body(collection: bpy.types.Collection, model: ShapeModel | None, folder: Path) -> Iterator[None]:
    """As `saved_body_file`; the collection refers to the file when the block ends well.

    Without a model (human.npz of format version 1) nothing is written, and the human cannot be reshaped.
    """
    if model is None:
        yield
        return
    with saved_body_file(model, folder) as name:
        yield
        collection[BODY_FILE] = name


def body_files() -> set[str]:
    """Names of the body files that humans of this .blend use, linked ones included."""
    return {name for collection in bpy.data.collections if (name := stored_body_name(collection)) is not None}


@functools.lru_cache(maxsize=4)
def read_body_file(path: Path) -> ShapeModel:
    """The shape model in a file; cached, since a file of this name never changes.

    Raises FileNotFoundError, or ValueError for a damaged file.
    """
    if not exists_in_its_folder(path):
        raise FileNotFoundError(
            f"the body's file is missing: {str(path)!r}; put it back beside the humans' folders, or generate the "
            "human again"
        )
    try:
        arrays = read_arrays(path, tuple(FIELDS), tuple(OPTIONAL_FIELDS), most_values=MOST_BODY_VALUES)
        shapes = FIELDS | {name: shape for name, shape in OPTIONAL_FIELDS.items() if name in arrays}
        check_shapes(path, arrays, shapes, {})
        model = ShapeModel.from_arrays(arrays)
        fault = faulty_field(model)
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(
            f"the body's file {str(path)!r} is damaged ({error!s:.160}); generate the human again"
        ) from error
    if fault is not None:
        raise ValueError(f"the field {fault!r} of {str(path)!r} holds impossible values; generate the human again")
    return model


def _write(path: Path, model: ShapeModel) -> None:
    arrays = model.arrays()
    for name in INTEGERS:
        if arrays[name].max() < _SMALL_LIMIT:
            arrays[name] = arrays[name].astype(_SMALL)
    try:
        with replacing(path) as unfinished, unfinished.open("wb") as file:
            np.savez(file, **arrays)  # compressing takes half a second, and Blender waits
    except OSError as error:
        raise VolumeWriteError(
            f"the body's file could not be written to {str(path.parent)!r} ({error}); save the .blend in a folder with "
            "write permission and free space"
        ) from error
