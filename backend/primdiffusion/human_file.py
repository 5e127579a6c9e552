"""People as files: `.human.safetensors` to keep them, `human.npz` to hand them to Blender. No pickle in either."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import safetensors
import safetensors.torch
import torch

from primdiffusion.body.model import JOINT_NAMES, default_body
from primdiffusion.human import Human
from primdiffusion.primitives.anchors import anchor_skin_weights, attach, default_anchors
from primdiffusion.primitives.primitives import K, Payload, S
from primdiffusion.staging import written_whole

FORMAT = "primdiffusion.human"
FORMAT_VERSION = 1
"""Of both files; readers refuse a higher one."""
SHAPES = {"rgb": (K, 3, S, S, S), "density": (K, S, S, S), "delta_scale": (K, 3), "betas": (10,)}
"""What a .human.safetensors file holds."""


class HumanFileError(ValueError):
    """A file that holds no person this version can read."""


def save_human(path: str | Path, human: Human) -> None:
    """Writes the person whole or not at all, every bit as it is in memory. Raises ValueError for NaN, OSError."""
    human.validate()
    payload = human.payload
    tensors = {"rgb": payload.rgb, "density": payload.density, "delta_scale": payload.delta_scale, "betas": human.betas}
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "provenance": json.dumps(dict(human.provenance)),
    }
    with written_whole(path) as unfinished:
        unfinished.write_bytes(safetensors.torch.save(tensors, metadata))


def load_human(path: str | Path) -> Human:
    """The person in a `.human.safetensors` file, validated.

    Raises FileNotFoundError, or HumanFileError (a ValueError) for a file that is damaged, newer or of another kind.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no person in {path}: check the path, or generate one")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  safe_open is no mapping
    except safetensors.SafetensorError as e:
        raise HumanFileError(f"{path} is damaged or no safetensors file ({e}): generate the person again") from e
    if metadata.get("format") != FORMAT or not set(SHAPES) <= set(tensors):
        raise HumanFileError(f"{path} is a safetensors file but holds no person: choose a .human.safetensors file")
    if metadata.get("format_version") != str(FORMAT_VERSION):
        given = metadata.get("format_version")
        raise HumanFileError(f"{path} has format {given}, this version reads {FORMAT_VERSION}: update PrimDiffusion")
    for name, shape in SHAPES.items():
        if tuple(tensors[name].shape) != shape or not tensors[name].is_floating_point():
            given = f"{tensors[name].dtype} {tuple(tensors[name].shape)}"
            raise HumanFileError(f"{path} holds no whole person ({name} is {given}, not {shape}): generate it again")
    payload = Payload(tensors["rgb"], tensors["density"], tensors["delta_scale"])
    try:
        return Human(payload, tensors["betas"], json.loads(metadata["provenance"])).validate()
    except (ValueError, KeyError) as e:
        raise HumanFileError(f"{path} holds no whole person: {e}") from e


def export_for_blender(path: str | Path, human: Human) -> None:
    """Writes `human.npz`: the person in the T pose at their betas, and how all of it follows 24 joints.

    Plain arrays in metres, y up, facing z. Body: vertices [V,3], faces [F,3], uv_corner [F,3,2] (v up), skin_weights
    [V,24], joints [24,3], parents [24], joint_names [24]. Primitives: position [K,3], rotation [K,3,3] local to rest
    (columns T, B, N), half_extent [K,3] with the delta scale in it, primitive_weights [K,24], rgb [K,8,8,8,3] float16
    linear and density [K,8,8,8] (1/m, without the window), voxels in the order D, H, W = along N, B, T. meta: JSON.
    """
    human.validate()
    body, anchors = default_body(), default_anchors()
    shaped = body.shape(human.betas)
    frames = attach(anchors, shaped.vertices, body.faces)
    arrays = {
        "betas": human.betas,
        "parents": body.parents,
        "joints": shaped.joints,
        "vertices": shaped.vertices,
        "faces": body.faces.to(torch.int32),
        "uv_corner": body.uv[body.uv_faces],
        "skin_weights": body.skin_weights,
        "position": frames.position,
        "rotation": frames.rotation,
        "half_extent": frames.half_extent * human.payload.delta_scale,
        "primitive_weights": anchor_skin_weights(anchors, body),
        "rgb": human.payload.rgb.movedim(1, -1).to(torch.float16),
        "density": human.payload.density,
    }
    plain = {name: value.detach().cpu().contiguous().numpy() for name, value in arrays.items()}
    with written_whole(path) as unfinished, unfinished.open("wb") as file:
        np.savez(
            file,
            format_version=np.int64(FORMAT_VERSION),
            meta=np.array(json.dumps(dict(human.provenance))),
            joint_names=np.array(JOINT_NAMES),
            **plain,
        )
