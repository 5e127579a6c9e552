"""The shape of a human in the scene, and the file of the body that it belongs to.

`armature[BETAS]` is the shape, which the engine draws; it may be animated. `reshape` moves bones, body mesh and volumes
along. The body's file, body_<hash>.npz beside the humans' folders, holds its ShapeModel, so that reshaping needs no
backend. Humans on the same body share one file; its name is a hash of its content, so a file never changes.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.arrays import read_arrays
from .files import VolumeWriteError, folders_of
from .human import BETA_COUNT, BETAS, MARK, armature_of
from .shape_model import FIELDS, INTEGERS, SAME_BETAS, ShapeModel, faulty_field

BODY_FILE = "primdiffusion_body_file"
"""Custom property of a human's collection: the name of its body's file."""
BODY_NPZ = re.compile(r"body_[0-9a-f]{12}\.npz")
_SMALL, _SMALL_LIMIT = np.uint16, 2**16
"""Integers in files, where they fit: bodies have fewer vertices and faces."""


def betas_of(collection: bpy.types.Collection) -> NDArray[np.float64]:
    """The human's shape [10] as the engine draws it now. Raises ValueError where it is no list of ten numbers."""
    armature = armature_of(collection)
    given = armature[BETAS] if BETAS in armature else generated_betas(collection)
    try:
        betas = np.array(list(given), np.float64)
    except (TypeError, ValueError):
        betas = np.empty(0)
    if betas.shape != (BETA_COUNT,) or not np.isfinite(betas).all():
        raise ValueError(
            f"the custom property {BETAS!r} on the armature of {collection.name!r} is no list of {BETA_COUNT} numbers: "
            "delete it"
        )
    return betas


def generated_betas(collection: bpy.types.Collection) -> NDArray[np.float64]:
    """The shape [10] that the human was generated with, or got from its last edit.

    Raises ValueError where the collection's provenance is damaged.
    """
    try:
        betas = np.array(json.loads(collection[MARK])["betas"], np.float64)
    except (ValueError, KeyError, TypeError):
        betas = np.empty(0)
    if betas.shape != (BETA_COUNT,):
        raise ValueError(
            f"the custom property {MARK!r} of {collection.name!r} was changed by hand and holds no shape: undo that, "
            "or generate the person again"
        )
    return betas


def has_custom_shape(collection: bpy.types.Collection) -> bool:
    """Whether the shape differs from the one in the human's file: the user has set it."""
    try:
        return not np.allclose(betas_of(collection), generated_betas(collection), atol=SAME_BETAS)
    except ValueError:
        return True


def shape_model_of(collection: bpy.types.Collection) -> ShapeModel:
    """The model by which the human's body follows its shape. Raises ValueError or FileNotFoundError."""
    if BODY_FILE not in collection:
        raise ValueError(
            f"the person {collection.name!r} was made by an earlier version and cannot be reshaped: generate the "
            "person again, or vary it"
        )
    name = str(collection[BODY_FILE])
    paths = [folder / name for near in folders_of(collection) for folder in (near.parent, near)]
    return read_body_file(next((path for path in paths if path.is_file()), paths[0]))


def body_file_name(model: ShapeModel) -> str:
    """The name of a shape model's file."""
    digest = hashlib.sha256()
    for name in FIELDS:
        digest.update(np.ascontiguousarray(getattr(model, name)).tobytes())
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
            path.unlink(missing_ok=True)
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
    return {str(collection[BODY_FILE]) for collection in bpy.data.collections if BODY_FILE in collection}


@functools.lru_cache(maxsize=4)
def read_body_file(path: Path) -> ShapeModel:
    """The shape model in a file; cached, since a file of this name never changes.

    Raises FileNotFoundError, or ValueError for a damaged file.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"the body's file is missing: {str(path)!r}; put it back beside the people's folders, or generate the "
            "person again"
        )
    try:
        arrays = read_arrays(path, tuple(FIELDS))
        dtypes = {name: np.int32 if name in INTEGERS else np.float32 for name in FIELDS}
        model = ShapeModel(**{name: arrays[name].astype(dtypes[name]) for name in FIELDS})
        fault = faulty_field(model)
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(f"the body's file {str(path)!r} is damaged ({error}); generate the person again") from error
    if fault is not None:
        raise ValueError(f"the field {fault!r} of {str(path)!r} holds impossible values; generate the person again")
    return model


def _write(path: Path, model: ShapeModel) -> None:
    arrays = {name: getattr(model, name) for name in FIELDS}
    for name in INTEGERS:
        if arrays[name].max() < _SMALL_LIMIT:
            arrays[name] = arrays[name].astype(_SMALL)
    unfinished = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".writing_", suffix=".npz", delete=False) as file:
            unfinished = Path(file.name)
            np.savez_compressed(file, **arrays)
        os.replace(unfinished, path)
    except OSError as error:
        if unfinished is not None:
            unfinished.unlink(missing_ok=True)
        raise VolumeWriteError(
            f"the body's file could not be written to {str(path.parent)!r} ({error}); save the .blend in a folder with "
            "write permission and free space"
        ) from error
