"""Write checkpoints and encoders in this package's format from the authors' checkpoint and the user's body files.

A file contains the tensors of the denoiser or the encoder, and anchors and box sizes of the body (SPEC 1, 2, 3). The
body files are referenced by path and checksum, and must exist unchanged to load it.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import LARGEST_BETA, BodyPose
from primdiffusion.diffusion.checkpoint import FORMAT, FORMAT_VERSION, RELEASED, anchor_tensors
from primdiffusion.diffusion.model import BETAS
from primdiffusion.diffusion.unet import UNetConfig
from primdiffusion.encoder.config import RELEASED as RELEASED_ENCODER
from primdiffusion.encoder.model import EncoderModel, save_encoder
from primdiffusion.encoder.network import Encoder
from primdiffusion.files.tensor_file import save
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.geometry.surface import surface_points
from primdiffusion.primitives.anchors import released_half_extent
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import RELEASED_FULL_DENSITY

SCHEDULE = "sqrt_linear"
"""Name of the released schedule in `SCHEDULES`."""
FULL_DENSITY = RELEASED_FULL_DENSITY
VOLUME_RADIUS = 10.0
"""Metres: the marcher's unit, so that its scale 10 / h is the reciprocal half extent of a box of h metres (SPEC 2)."""
ENLARGED_BELOW, ENLARGED_BY = 350.0, 70.0
"""At inference, scales below the first are lowered by the second: boxes beyond 28.6 mm grow (SPEC 1.12)."""


def rest_half_extent(position: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """Half extents (metres) of primitives at the reference positions (metres), enlarged as at inference."""
    scale = VOLUME_RADIUS / released_half_extent(position)
    return VOLUME_RADIUS / torch.where(scale < ENLARGED_BELOW, scale - ENLARGED_BY, scale)


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


def sized(body_setup: BodySetup, reference: Reference) -> BodySetup:
    """The body setup with the rest half extents of `reference_extents`."""
    extents = reference_extents(body_setup, reference)
    return dataclasses.replace(body_setup, anchors=dataclasses.replace(body_setup.anchors, rest_half_extent=extents))


def write_imported(
    out: Path,
    denoiser: Mapping[str, Tensor],
    unet: UNetConfig,
    body_setup: BodySetup,
    reference: Reference,
    card: Mapping[str, Any],
) -> None:
    """Write the file, atomically; `denoiser` uses the names of `SlabUNet`. Raises OSError."""
    tensors = {f"denoiser.{name}": value.float().contiguous() for name, value in denoiser.items()}
    tensors |= anchor_tensors(sized(body_setup, reference).anchors)
    tensors["stand.betas"] = reference.betas.clamp(-LARGEST_BETA, LARGEST_BETA)
    architecture = {
        "kind": RELEASED,
        "schedule": SCHEDULE,
        "full_density": FULL_DENSITY,
        "chain": "released",
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


def write_encoder(
    out: Path, parameters: Mapping[str, Tensor], body_setup: BodySetup, reference: Reference, card: Mapping[str, Any]
) -> None:
    """Write stage 1 as an encoder, atomically, in float32; `parameters` are those of `encoder_tensors`.

    Raises OSError.
    """
    with torch.device("meta"):
        encoder = Encoder(RELEASED_ENCODER)
    encoder.load_state_dict(dict(parameters), assign=True)
    save_encoder(out, EncoderModel(encoder, card, sized(body_setup, reference)), torch.float32)
