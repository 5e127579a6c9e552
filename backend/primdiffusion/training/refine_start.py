"""People to start refining from when there is no better one: the bare body, or a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.capture.people_files import read_person
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.human import Human
from primdiffusion.people.payloads import rest_frames
from primdiffusion.primitives.from_mesh import from_mesh

GREY = (128, 128, 128, 255)
"""sRGB-encoded."""


def bare_body(betas: Float[Tensor, "n"]) -> Human:
    """The default body with these betas, grey, so that captures alone suffice; takes about 3 s.

    Raises ValueError for more betas than the body has.
    """
    body = default_body()
    skin = TexturedPart(
        name="body",
        vertices=body.shape(betas).vertices.double().numpy(),
        faces=body.faces.numpy().astype(np.int32),
        corner_uv=body.uv[body.uv_faces].numpy(),
        texture=np.array([[GREY]], np.uint8),
        skin_index=np.zeros((len(body.template), 1), np.int32),
        skin_weight=np.ones((len(body.template), 1)),
    )
    return _as_human(TexturedMesh((skin,)), betas, "the bare body")


def meshed_person(path: str | Path) -> Human:
    """A person of `primdiffusion people`, a .glb in the rest pose of the default body; takes about 3 s.

    Raises:
        FileNotFoundError, GlbError: as `read_person`.
        UnusableMesh: the mesh is empty.
    """
    person = read_person(path)
    return _as_human(person.mesh, torch.from_numpy(person.betas).float(), Path(path).name)


def _as_human(mesh: TexturedMesh, betas: Float[Tensor, "n"], origin: str) -> Human:
    payload = from_mesh(mesh, rest_frames(betas.double().numpy()))
    return Human(payload, betas, {"start": origin}).validate()
