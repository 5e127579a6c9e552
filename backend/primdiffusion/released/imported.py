"""Imported checkpoints: this package's format, made from the authors' checkpoint and the user's body files.

The file contains the denoiser's tensors, and anchors and box sizes of the body. The body files are referenced by path
and checksum, and must exist unchanged to load the checkpoint. The authors' conventions are converted (SPEC 1, 2, 3).
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
from primdiffusion.diffusion.checkpoint import FORMAT, FORMAT_VERSION, under, unet_config
from primdiffusion.diffusion.model import BETAS, DiffusionModel, ShapePrior, WholeSlab
from primdiffusion.diffusion.schedule import SCHEDULES, leading_steps, trailing_steps
from primdiffusion.diffusion.unet import SlabUNet, UNetConfig
from primdiffusion.geometry.surface import surface_points
from primdiffusion.human_file import LARGEST_BETA
from primdiffusion.primitives.anchors import released_half_extent
from primdiffusion.primitives.body_setup import BodyFiles, BodySetup, BodySetupError, find_body_setup
from primdiffusion.primitives.primitives import Payload
from primdiffusion.primitives.slab import RELEASED_FULL_DENSITY
from primdiffusion.staging import write_atomically

SCHEDULE = "sqrt_linear"
"""Name of the released schedule in `SCHEDULES`."""
FULL_DENSITY = RELEASED_FULL_DENSITY
VOLUME_RADIUS = 10.0
"""Metres: the marcher's unit, so that its scale 10 / h is the reciprocal half extent of a box of h metres (SPEC 2)."""
ENLARGED_BELOW, ENLARGED_BY = 350.0, 70.0
"""At inference, scales below the first are lowered by the second: boxes beyond 28.6 mm grow (SPEC 1.12)."""
SMALLEST_DELTA_S = 0.2
"""Released values are never clamped (SPEC 1.13). Usual values are around 1; a box of five times its rest size is an
outlier, and 0 has no reciprocal."""
_B_AXIS = -2
"""The voxels' axes D, H, W run along N, B, T."""
KIND = "released"
"""`kind` of the architecture in the file's metadata."""
Chain = Literal["released", "trailing"]


@dataclasses.dataclass(frozen=True)
class ReleasedSlab(WholeSlab):
    """A slab whose boxes have B = T x N, and delta_s that divides their size (SPEC 1.1, 1.8).

    Conversion flips voxels along B, so that frames stay in SO(3), and delta_scale = 1 / delta_s.
    """

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Unpack and clamp."""
        payload = super().to_payload(x0, full_density)
        return Payload(
            payload.rgb.flip(_B_AXIS),
            payload.density.flip(_B_AXIS),
            1 / payload.delta_scale.clamp_min(SMALLEST_DELTA_S),
        )

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Pack; the inverse for boxes up to five times their rest size. Raises ValueError for boxes without size."""
        if not (payload.delta_scale > 0).all():
            raise ValueError(
                "a delta scale is 0 or less, but released slabs store its reciprocal: refine this human again"
            )
        flipped = Payload(payload.rgb.flip(_B_AXIS), payload.density.flip(_B_AXIS), 1 / payload.delta_scale)
        return super().from_payload(flipped, full_density)


def rest_half_extent(position: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """Half extents (metres) of primitives at the reference positions (metres), enlarged as at inference."""
    scale = VOLUME_RADIUS / released_half_extent(position)
    return VOLUME_RADIUS / torch.where(scale < ENLARGED_BELOW, scale - ENLARGED_BY, scale)


def released_steps(length: int, steps: int) -> list[int]:
    """Timesteps of the released sampler: 991, 981, ... 1 for 100 of 1000 (SPEC 3), or all of T-1 ... 0.

    Raises ValueError between T / 2 and T: such a chain would begin far below the initial noise level.
    """
    if steps == length:
        return list(reversed(range(length)))
    if length // 2 < steps < length:
        raise ValueError(f"steps is {steps}: the released chain takes up to {length // 2} steps, or all {length}")
    return leading_steps(length, steps)


CHAINS = {"released": released_steps, "trailing": trailing_steps}
"""Timestep schedules by their names in the file."""


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
    with torch.device("meta"):
        network = SlabUNet(unet_config(architecture["config"]))
    network.load_state_dict(under(tensors, "denoiser."), assign=True)
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
