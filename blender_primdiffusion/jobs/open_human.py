"""Open .human files on the default body without a child: its `human_npz` in numpy."""

from __future__ import annotations

import functools
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..formats.answers import HumanAnswer
from ..formats.arrays import read_arrays
from ..formats.body_layout import half_extents, read_layout, stencils
from ..formats.human_metadata import provenance_of
from ..formats.joints import JOINT_NAMES, PARENTS
from ..places import body_data
from ..scene.human import LARGEST_BETA, NPZ_FILE, PERSON_FILE
from ..scene.human_file import HumanTensors, payload_in, read_tensors, with_motion, write_tensors
from ..scene.human_npz import FORMAT_VERSION
from ..scene.shape import ShapeModel


def opened(source: Path, folder: Path) -> HumanAnswer | None:
    """Write human.npz and the human's own file, without a motion, into `folder`; the answer is that of `human_npz`.

    None for files that only the backend can read: humans on a body of the user's files, and files of other kinds.
    Raises ValueError for a damaged human, OSError.
    """
    began = time.monotonic()
    try:
        human = read_tensors(source)
    except ValueError:
        return None
    if "body" in human.metadata:
        return None
    arrays = arrays_in(human, source.name)
    npz, person = folder / NPZ_FILE, folder / PERSON_FILE
    np.savez(npz, **arrays)
    write_tensors(person, with_motion(human, None))
    return HumanAnswer(human=npz, person=person, seconds=time.monotonic() - began)


def rest_arrays(source: Path) -> dict[str, Any]:
    """The arrays of human.npz of a .human file on the default body, as the backend's `export_for_blender` writes them.

    Raises ValueError for a damaged file or a newer one, OSError.
    """
    return arrays_in(read_tensors(source), source.name)


def arrays_in(human: HumanTensors, name: str) -> dict[str, Any]:
    """As `rest_arrays`, of a file of this name that was read."""
    payload, (model, body) = payload_in(human, name), default_body()
    if len(payload.density) != len(model.face):
        raise ValueError(f"{name!r} holds {len(payload.density)} primitives instead of {len(model.face)}")
    if np.abs(payload.betas).max() > LARGEST_BETA:
        raise ValueError(f"{name!r} is damaged (betas above {LARGEST_BETA}); generate the human again")
    try:
        provenance_of(human.metadata)
    except ValueError as error:
        raise ValueError(f"{name!r} is damaged: {error}") from error
    rest = model.rest(payload.betas)
    return {
        "format_version": np.int64(FORMAT_VERSION),
        "meta": np.array(human.metadata["provenance"]),
        "joint_names": np.array(JOINT_NAMES),
        "parents": np.array(PARENTS),
        "betas": payload.betas,
        "joints": rest.joints.astype(np.float32),
        "vertices": rest.vertices.astype(np.float32),
        "position": rest.position.astype(np.float32),
        "rotation": rest.rotation.astype(np.float32),
        "half_extent": body["rest_half_extent"] * payload.delta_scale,
        "rgb": np.moveaxis(payload.rgb, 1, -1).astype(np.float16),
        "density": payload.density,
        **body,
    }


@functools.cache
def default_body() -> tuple[ShapeModel, dict[str, NDArray]]:
    """The default body's shape model, and the arrays of human.npz that are the same for all humans on it."""
    keys = ("v_template", "shapedirs", "J_regressor", "weights", "f", "vt", "ft")
    stored, layout = read_arrays(body_data("body.npz"), keys), read_layout(body_data("layout.npz"))
    template, basis, faces = stored["v_template"], stored["shapedirs"], stored["f"].astype(np.int32)
    vertex, du, dv = stencils(faces, layout["texel_face"], layout["texel_barycentric"])
    support, regressor = template.astype(np.float64)[vertex], stored["J_regressor"].astype(np.float64)
    planes = (np.einsum("km,kmx->kx", weight, support) for weight in (du, dv))
    corners = faces[layout["cell_face"]]
    arrays = {
        "faces": faces,
        "skin_weights": stored["weights"],
        "template": template,
        "shape_basis": basis,
        "joint_template": regressor @ template,
        "joint_basis": np.einsum("jv,vcn->jcn", regressor, basis, optimize=True),
        "face": layout["cell_face"].astype(np.int32),
        "barycentric": layout["cell_barycentric"],
        "stencil_vertex": vertex.astype(np.int32),
        "stencil_du": du,
        "stencil_dv": dv,
        "rest_half_extent": half_extents(*planes, layout["cell_chart"]),
        "uv_corner": stored["vt"][stored["ft"]],
        "primitive_weights": np.einsum("kc,kcj->kj", layout["cell_barycentric"], stored["weights"][corners]),
    }
    single = {name: a.astype(np.float32) if a.dtype == np.float64 else a for name, a in arrays.items()}
    return ShapeModel.from_arrays(single), single
