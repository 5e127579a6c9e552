"""Files of a human: `.human.safetensors`, and `body.safetensors` for Blender. Neither contains pickles.

A `.human.safetensors` file contains the tensors rgb, density, delta_scale and betas, and the metadata `format`,
`format_version` and `provenance`, a JSON object with these entries, among others:

    seed, steps, sampler, guidance, attributes      how the human was sampled
    checkpoint, checkpoint_sha256, full_density     the model
    version                                         the version of PrimDiffusion
    edits                                           later edits, oldest first: objects with a name "edit"

A human on a body of the user's files has format version 2, the tensor rest_half_extent, and the metadata `body`: paths
and checksums of these files, never their content. A compact file has format version 3, and rgb and density in eight
bits (see `formats.human_layout`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch

from primdiffusion.body.model import LARGEST_BETA, BodyModel
from primdiffusion.files import tensor_file
from primdiffusion.files.regular_files import FileError, as_file_error
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.formats.human_layout import (
    COMPACT_SCALES,
    COMPACT_VERSION,
    LARGEST_VALUE,
    check_provenance,
    from_eight_bits,
    provenance_of,
    to_eight_bits,
    version_fault,
)
from primdiffusion.human import Human
from primdiffusion.primitives.anchors import Anchors
from primdiffusion.primitives.body_setup import BodyFiles, BodySetup, find_body_setup
from primdiffusion.primitives.primitives import K, Payload, S
from primdiffusion.runtime.device import GRID_THREADS, fixed_threads

FORMAT = "primdiffusion.human"
FORMAT_VERSION = 1
"""Version for humans on the default body."""
FORMAT_VERSION_ON_FILES = 2
"""Version for humans on a body of the user's files."""
BODY_FORMAT = "primdiffusion.body"
LARGEST_FILE = 256 * 2**20
_FLOATS = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
SHAPES = {"rgb": (K, 3, S, S, S), "density": (K, S, S, S), "delta_scale": (K, 3), "betas": (10,)}
"""Tensors of a .human.safetensors file."""
_EXTENTS = {"rest_half_extent": (K, 3)}
"""Further arrays of a human on a body of the user's files, and their shapes."""
_KNOWN = (*SHAPES, *_EXTENTS)
"""Whatever else a file holds, such as a motion, is not read."""


class NoPersonError(FileError):
    """A safetensors file without a human."""


def save_human(path: str | Path, human: Human, *, compact: bool = False) -> None:
    """Write the human atomically: losslessly in 8.4 MB, or `compact` in 2.1 MB, with 8-bit colours and densities.

        >>> pd.save_human("anna.human.safetensors", human)
        >>> pd.save_human("small.human.safetensors", human, compact=True)

    Raises ValueError for NaN, betas out of range and a provenance that is not JSON; OSError.
    """
    _check_values(human.validate())
    check_provenance(human.provenance)
    payload = human.payload
    tensors = {"rgb": payload.rgb, "density": payload.density, "delta_scale": payload.delta_scale, "betas": human.betas}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    metadata = {
        "format": FORMAT,
        "format_version": str(format_version(human)),
        "provenance": json.dumps(dict(human.provenance), allow_nan=False),
    }
    if human.body_setup is not None:
        tensors["rest_half_extent"] = human.body_setup.anchors.rest_half_extent.detach().cpu().contiguous()
        metadata |= {"body": human.body_setup.files.to_json()}
    if compact:
        rgb, density, scales = to_eight_bits(payload.rgb.cpu().numpy(), payload.density.cpu().numpy())
        tensors |= {"rgb": torch.from_numpy(rgb), "density": torch.from_numpy(density)}
        metadata |= {"format_version": str(COMPACT_VERSION), COMPACT_SCALES: scales}
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(tensor_file.save(tensors, metadata))


def format_version(human: Human) -> int:
    """Return the lowest format version that can store this human."""
    return FORMAT_VERSION if human.body_setup is None else FORMAT_VERSION_ON_FILES


def load_human(path: str | Path) -> Human:
    """Read and validate a `.human.safetensors` file.

        >>> anna = pd.load_human("anna.human.safetensors")
        >>> anna.payload.rgb.equal(human.payload.rgb)
        True

    Raises FileNotFoundError, and FileError (a ValueError) for a file that is damaged, newer or of another kind.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no human file {path}: check the path, or generate a human")
    with as_file_error(path, "is damaged or no safetensors file", "generate the human again", OSError):
        file = tensor_file.TensorFile(path, LARGEST_FILE)
        tensors, metadata = file.finite_tensors(_KNOWN), file.metadata
    _check_format(path, metadata)
    tensors = _expanded(path, tensors, metadata)
    _check_shapes(path, tensors)
    tensors |= {name: tensors[name].float() for name in SHAPES}
    payload = Payload(tensors["rgb"], tensors["density"], tensors["delta_scale"])
    with as_file_error(path, "does not contain a valid human", "generate it again"):
        body_setup = _body_setup(path, metadata, tensors) if "body" in metadata else None
        human = Human(payload, tensors["betas"], provenance_of(metadata), body_setup).validate()
        _check_values(human)
    return human


def _check_format(path: Path, metadata: Mapping[str, str]) -> None:
    if metadata.get("format") != FORMAT:
        raise NoPersonError(path, "is a safetensors file without a human", "choose a .human.safetensors file")
    if fault := version_fault(metadata):
        raise FileError(path, *fault)


def _body_setup(path: Path, metadata: Mapping[str, str], tensors: Mapping[str, torch.Tensor]) -> BodySetup:
    extents = tensors.get("rest_half_extent", torch.empty(0))
    try:
        return find_body_setup(BodyFiles.from_json(metadata["body"]), extents, [path.parent])
    except FileError as e:
        raise FileError(path, f"needs its body, but {e.path} {e.reason}", e.remedy) from e


def _expanded(path: Path, tensors: dict[str, torch.Tensor], metadata: Mapping[str, str]) -> dict[str, torch.Tensor]:
    """Tensors of a compact file in float32, others as they are."""
    if COMPACT_SCALES not in metadata:
        return tensors
    with as_file_error(path, "does not contain a valid human", "generate it again"):
        stored = {name: tensors[name].numpy() for name in ("rgb", "density") if name in tensors}
        expanded = from_eight_bits(stored, metadata[COMPACT_SCALES])
    return {**tensors, **{name: torch.from_numpy(values) for name, values in expanded.items()}}


def _check_shapes(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    for name, shape in {**SHAPES, **_EXTENTS}.items():
        if name not in tensors:
            if name in _EXTENTS:
                continue
            raise FileError(path, f"does not contain a valid human ({name} is missing)", "generate it again")
        if tuple(tensors[name].shape) != shape or tensors[name].dtype not in _FLOATS:
            given = f"{tensors[name].dtype} {tuple(tensors[name].shape)}"
            raise FileError(
                path, f"does not contain a valid human ({name} is {given}, not {shape})", "generate it again"
            )
        if name in _EXTENTS and float(tensors[name].abs().max()) > LARGEST_VALUE:
            raise FileError(
                path, f"does not contain a valid human ({name} holds impossible values)", "generate it again"
            )


def _check_values(human: Human) -> None:
    for name, values in vars(human.payload).items():
        if float(values.abs().max()) > LARGEST_VALUE or (name == "density" and float(values.min()) < 0):
            raise ValueError(f"{name!r} holds impossible values")
    largest = float(human.betas.abs().max())
    if largest > LARGEST_BETA:
        raise ValueError(f"the largest beta is {largest:.3g}, but bodies are only valid up to {LARGEST_BETA:g}")


@fixed_threads(GRID_THREADS)
def save_body(path: str | Path, body: BodyModel, anchors: Anchors) -> None:
    """Write `body.safetensors`, by which Blender places a human on a body of the user's files. Raises OSError.

    Metres, y up, facing z. The dependence on betas: template [V,3] and shape_basis [V,3,10] of the surface,
    joint_template [24,3] and joint_basis [24,3,10]. The surface: faces [F,3], uv_corner [F,3,2] (v up), skin_weights
    [V,24]. The inputs of `attach`: face [K], barycentric [K,3], stencil_vertex [K,m], stencil_du [K,m], stencil_dv
    [K,m], rest_half_extent [K,3]. A body with pose-dependent correctives also has pose_basis [U,3,207] (SMPL eq. 9) of
    the U vertices that stencil_vertex and face use, in ascending order.
    """
    basis = body.shape_basis[..., : SHAPES["betas"][0]]
    regressor = body.joint_regressor.double()
    used = torch.cat([anchors.stencil_vertex.flatten(), body.faces[anchors.face].flatten()]).unique()
    arrays = {
        **({"pose_basis": body.pose_basis[used]} if body.pose_basis.numel() else {}),
        "template": body.template,
        "shape_basis": basis,
        "joint_template": (regressor @ body.template.double()).float(),
        "joint_basis": torch.einsum("jv,vcn->jcn", regressor, basis.double()).float(),
        "faces": body.faces.to(torch.int32),
        "uv_corner": body.uv[body.uv_faces],
        "skin_weights": body.skin_weights,
        "face": anchors.face.to(torch.int32),
        "barycentric": anchors.barycentric,
        "stencil_vertex": anchors.stencil_vertex.to(torch.int32),
        "stencil_du": anchors.stencil_du,
        "stencil_dv": anchors.stencil_dv,
        "rest_half_extent": anchors.rest_half_extent,
    }
    plain = {name: value.detach().cpu().contiguous() for name, value in arrays.items()}
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(tensor_file.save(plain, {"format": BODY_FORMAT, "format_version": "1"}))
