"""Imported checkpoints: this package's format, made from the authors' checkpoint and the user's body files.

The file contains the denoiser's tensors, and anchors and box sizes of the body. The body files are referenced by path
and checksum, and must exist unchanged to load the checkpoint.
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
"""`kind` of the architecture in the file's metadata."""
CHAINS = {"released": released_steps, "trailing": trailing_steps}
"""Timestep schedules by their names in the file."""
Chain = Literal["released", "trailing"]


@dataclasses.dataclass(frozen=True)
class Reference:
    """The subject whose first frame determines box sizes (SPEC 2), and whose betas generated humans get."""

    betas: Float[Tensor, "10"]
    pose: BodyPose

    @classmethod
    def template(cls) -> Reference:
        """The mean body in T pose, for use without the dataset."""
        return cls(torch.zeros(BETAS), BodyPose.rest())


def reference_extents(body_setup: BodySetup, reference: Reference) -> Float[Tensor, "k 3"]:
    """Compute rest half extents (metres) from a reference subject, as the released code does."""
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
    """Write the file, atomically; `denoiser` uses the names of `SlabUNet`. Raises OSError."""
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
    """Build the model of a file from `write_imported`; `folder` is the folder of the file.

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
        raise BodySetupError("the anchors differ from those that the checkpoint was imported with: import it again")
    fixed_betas = (
        torch.zeros(BETAS, 0),
        tensors["stand.betas"],
        torch.zeros(BETAS, BETAS),
        torch.full((BETAS,), LARGEST_BETA),
    )
    return DiffusionModel(
        denoiser=network,
        schedule=SCHEDULES[architecture["schedule"]](),
        codec=ReleasedSlab(),
        shapes=ShapePrior(*fixed_betas),
        full_density=float(architecture["full_density"]),
        card=card,
        chain=CHAINS[architecture["chain"]],
        body_setup=body_setup,
    )
