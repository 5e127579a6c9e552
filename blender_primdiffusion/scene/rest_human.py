"""A human at rest, read from its own file; and its body, from which its shape follows: the default one, or the one in a
file beside the human's."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.arrays import MOST_BODY_VALUES, check_shapes, read_arrays
from ..files.regular_files import FileError, as_file_error, exists_in_its_folder
from ..formats.body_layout import body_data, half_extents, read_layout, stencils
from ..formats.human_layout import provenance_of
from .human import LARGEST_BETA
from .human_file import (
    GENERATE_AGAIN,
    FileVersion,
    HumanPayload,
    body_arrays,
    file_version,
    payload_in,
    read_sizes,
    read_tensors,
)
from .overlap import max_overlap
from .payload import BODY_FILE, session_file
from .shape import FIELDS, OPTIONAL_FIELDS, Rest, ShapeModel, faulty_field
from .volumes import Grids, bake


def shape_model_of(person: bpy.types.Object) -> ShapeModel:
    """The model by which the human's body follows its shape. Raises as `session_file` and `body_of_file`."""
    return body_of_file(session_file(person))


def body_of_file(person: Path) -> ShapeModel:
    """The body of the human in a file: the default one, or that of BODY_FILE beside it; cached.

    Raises FileNotFoundError where BODY_FILE is missing, ValueError for a damaged file, OSError.
    """
    if read_sizes(file_version(person)).rest_half_extent is None:
        return default_body()
    path = person.with_name(BODY_FILE)
    if not exists_in_its_folder(path):
        raise FileNotFoundError(
            f"the body's file is missing: {str(path)!r}; put it back beside the human's file, or generate the human "
            "again"
        )
    return _read_body(file_version(path))


@functools.lru_cache(maxsize=4)
def _read_body(file: FileVersion) -> ShapeModel:
    path = file.path
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
    stored, layout = read_arrays(body_data("body.npz"), keys), read_layout(body_data("layout.npz"))
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
        offset, half = self.grids().drawn_box()
        centre = self.rest.position + np.einsum("kij,kj->ki", self.rest.rotation, offset)
        betas = np.round(self.payload.betas.astype(np.float64), 6).tolist()
        most = max_overlap(centre, self.rest.rotation, half)
        return json.dumps({**self.made, "betas": betas, "most_overlapping": most})


def read_human(person: Path, remedy: str = GENERATE_AGAIN) -> RestHuman:
    """Read a human and its body; `remedy` says what to do about a damaged file.

    Raises FileNotFoundError where a file is missing, ValueError for a damaged one, a newer one and one on another body,
    OSError.
    """
    if not person.is_file():
        raise FileNotFoundError(f"there is no human file at {str(person)!r}; generate the human again")
    tensors = read_tensors(person, remedy)
    payload = payload_in(tensors, person.name, remedy)
    if np.abs(payload.betas).max() > LARGEST_BETA:
        raise FileError(person, f"has betas above {LARGEST_BETA}", remedy)
    with as_file_error(person, "is damaged", remedy):
        made = provenance_of(tensors.metadata)
    model = body_of_file(person)
    if len(payload.density) != len(model.face):
        reason = f"holds {len(payload.density)} primitives instead of its body's {len(model.face)}"
        raise FileError(person, reason, remedy)
    return RestHuman(made, payload, model, model.rest(payload.betas.astype(np.float64)))
