"""From views of a person to the person's payload, by a trained encoder."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.dataset import Views, stack
from primdiffusion.encoder.config import EncoderConfig
from primdiffusion.encoder.network import Encoder, motion_of
from primdiffusion.encoder.unproject import Unprojected, unproject_texels, unproject_voxels
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.primitives import Frames, Payload, Primitives


@dataclasses.dataclass(frozen=True)
class EncoderModel:
    """A trained encoder: what a checkpoint of stage 1 holds."""

    encoder: Encoder
    card: Mapping[str, Any]
    """What it is and how it was trained; JSON values."""

    @property
    def config(self) -> EncoderConfig:
        """Its settings."""
        return self.encoder.config

    def encode(self, views: Views, betas: Float[Tensor, "n"]) -> Payload:
        """The payload of the person in `views` (unbatched, of one pose); see `encode`."""
        return encode(self.encoder, views, betas)

    def place(self, payload: Payload, betas: Float[Tensor, "n"], pose: BodyPose) -> Primitives:
        """The payload on the body that this encoder's boxes sit on; on the payload's device."""
        frames = frames_of(self.config, betas.cpu(), pose.to("cpu"))[1]
        return Primitives.place(frames.to(payload.density.device), payload)


@torch.no_grad()
def encode(encoder: Encoder, views: Views, betas: Float[Tensor, "n"]) -> Payload:
    """The payload of one person: unprojection and one pass of the network, without gradients; on the encoder's device.

    Raises:
        ValueError: there are no views, they are batched, or pose or betas are not finite or of another body.
    """
    device = encoder.scale_out.bias.device
    views, betas = views.to("cpu"), betas.cpu()
    found = look_up(encoder.config, views, betas)
    axis_angle = motion_of(views.pose.joint_rotation)[None].to(device)
    payload = encoder(stack([found]).to(device), axis_angle)
    return payload.map(lambda tensor: tensor[0].float())


def look_up(config: EncoderConfig, views: Views, betas: Float[Tensor, "n"]) -> Unprojected:
    """What an encoder of this configuration reads of the pictures of one person in one pose; on the CPU."""
    if not torch.isfinite(betas).all() or betas.shape != default_body().shape_basis.shape[-1:]:
        expected = default_body().shape_basis.shape[-1]
        raise ValueError(
            f"betas have the shape {tuple(betas.shape)}; the default body needs {expected} finite numbers: captures of "
            "another body model must be fitted to the default body first"
        )
    vertices, frames = frames_of(config, betas, views.pose)
    frames = dataclasses.replace(frames, half_extent=frames.half_extent * vertices.new_tensor(config.extent))
    if config.appearance == "texels":
        return unproject_texels(views, vertices, config.facing)
    return unproject_voxels(views, vertices, frames, config.facing)


def frames_of(config: EncoderConfig, betas: Float[Tensor, "n"], pose: BodyPose) -> tuple[Tensor, Frames]:
    """The posed body's vertices [V, 3] and the boxes' frames on it; of mean shape with `frames` "template"."""
    body = default_body()
    vertices = body.shape(betas_of_frames(config, betas)).pose(pose).vertices
    return vertices, attach(default_anchors(), vertices, body.faces)


def betas_of_frames(config: EncoderConfig, betas: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """The shape of the body that the boxes sit on: the person's, or with `frames` "template" the mean one."""
    return torch.zeros_like(betas) if config.frames == "template" else betas
