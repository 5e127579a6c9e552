"""The imported checkpoint: a file like our own, made from the authors' and a body of the user's.

It holds the denoiser's tensors and, of the body, numbers of faces, places on them and sizes of boxes; the body itself
is named by path and fingerprint, and must be there, unchanged, to load it.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import Tensor

from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.checkpoint import FORMAT, FORMAT_VERSION
from primdiffusion.diffusion.model import BETAS, DiffusionModel, ShapePrior
from primdiffusion.diffusion.schedule import SCHEDULES, trailing_steps
from primdiffusion.diffusion.unet import SlabUNet, UNetConfig
from primdiffusion.geometry.surface import surface_points
from primdiffusion.human_file import LARGEST_BETA
from primdiffusion.primitives.body_setup import BodyFiles, BodySetup, BodySetupError, find_body_setup
from primdiffusion.released.conventions import FULL_DENSITY, ReleasedSlab, released_steps, rest_half_extent
from primdiffusion.released.schedule_buffers import SCHEDULE
from primdiffusion.staging import write_atomically

KIND = "released"
"""Of the architecture in the file's metadata."""
CHAINS = {"released": released_steps, "trailing": trailing_steps}
"""Which steps a sampler visits, by the name in the file."""
Chain = Literal["released", "trailing"]


@dataclasses.dataclass(frozen=True)
class Reference:
    """The subject whose first frame sets the sizes of boxes (SPEC 2), and whose shape imported people have."""

    betas: Float[Tensor, "10"]
    pose: BodyPose

    @classmethod
    def template(cls) -> Reference:
        """The mean body in the T pose, for those who do not have the dataset."""
        return cls(torch.zeros(BETAS), BodyPose.rest())


def reference_extents(body_setup: BodySetup, reference: Reference) -> Float[Tensor, "k 3"]:
    """Rest half extents (metres) as the released code computes them from its reference subject."""
    vertices = body_setup.body.shape(reference.betas).pose(reference.pose).vertices
    anchors = body_setup.anchors
    return rest_half_extent(surface_points(vertices, body_setup.body.faces, anchors.face, anchors.barycentric))


def write_imported(
    out: Path,
    denoiser: Mapping[str, Tensor],
    unet: UNetConfig,
    body_setup: BodySetup,
    reference: Reference,
    chain: Chain,
    card: Mapping[str, Any],
) -> None:
    """Writes the file whole or not at all; `denoiser` has the names of `SlabUNet`. Raises OSError."""
    tensors = {f"denoiser.{name}": value.float().contiguous() for name, value in denoiser.items()}
    tensors |= {
        "stand.face": body_setup.anchors.face,
        "stand.barycentric": body_setup.anchors.barycentric,
        "stand.rest_half_extent": reference_extents(body_setup, reference),
        "stand.betas": reference.betas.clamp(-LARGEST_BETA, LARGEST_BETA),
    }
    architecture = {
        "kind": KIND,
        "schedule": SCHEDULE,
        "full_density": FULL_DENSITY,
        "chain": chain,
        "body": body_setup.files.to_json(),
        "config": dataclasses.asdict(unet),
    }
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "architecture": json.dumps(architecture),
        "card": json.dumps(dict(card)),
    }
    write_atomically(out, save(tensors, metadata))


def released_model(
    tensors: Mapping[str, Tensor], architecture: Mapping[str, Any], card: Mapping[str, Any], folder: Path
) -> DiffusionModel:
    """The model in a file that `write_imported` made; `folder` is where the file lies.

    Raises BodySetupError where the body it needs is gone or changed; KeyError, TypeError or RuntimeError where the file
    contradicts itself.
    """
    config = architecture["config"]
    levels = {key: tuple(config[key]) for key in ("multipliers", "attention_levels")}
    with torch.device("meta"):
        network = SlabUNet(UNetConfig(**{**config, **levels}))
    prefix = "denoiser."
    weights = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    network.load_state_dict(weights, assign=True)
    network.eval().requires_grad_(False)
    body_setup = find_body_setup(BodyFiles.from_json(architecture["body"]), tensors["stand.rest_half_extent"], [folder])
    anchors = body_setup.anchors
    if not (
        torch.equal(anchors.face, tensors["stand.face"].long())
        and torch.allclose(anchors.barycentric, tensors["stand.barycentric"], atol=1e-5)
    ):
        raise BodySetupError(
            "the primitives lie elsewhere on the body than when the checkpoint was imported: import it again"
        )
    nothing = (
        torch.zeros(BETAS, 0),
        tensors["stand.betas"],
        torch.zeros(BETAS, BETAS),
        torch.full((BETAS,), LARGEST_BETA),
    )
    return DiffusionModel(
        denoiser=network,
        schedule=SCHEDULES[architecture["schedule"]](),
        codec=ReleasedSlab(),
        shapes=ShapePrior(*nothing),
        full_density=float(architecture["full_density"]),
        card=card,
        chain=CHAINS[architecture["chain"]],
        body_setup=body_setup,
    )
