"""The body of a human, from which its shape follows: the default one, or the one in a file beside the human's."""

from __future__ import annotations

import functools
from pathlib import Path

import bpy
import numpy as np

from ..formats.arrays import MOST_BODY_VALUES, check_shapes, read_arrays
from ..formats.body_layout import body_data, half_extents, read_layout, stencils
from ..formats.regular_files import as_file_error, exists_in_its_folder
from .human import BODY_FILE, person_file
from .human_file import FileVersion, body_arrays, file_version, read_sizes
from .shape import FIELDS, OPTIONAL_FIELDS, ShapeModel, faulty_field


def shape_model_of(collection: bpy.types.Collection) -> ShapeModel:
    """The model by which the human's body follows its shape. Raises as `person_file` and `body_of_file`."""
    return body_of_file(person_file(collection))


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
