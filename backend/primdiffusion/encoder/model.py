"""A trained encoder: from views of a human to a payload; and its file, with weights in half precision."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyModel, BodyPose, default_body
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.reader import Views
from primdiffusion.diffusion.checkpoint import (
    ENCODER_FORMAT,
    anchor_tensors,
    check_finite,
    mismatches_named,
    read_tensors,
    stored_body_setup,
)
from primdiffusion.encoder.config import EncoderConfig, config_from_json
from primdiffusion.encoder.network import Encoder, motion_of
from primdiffusion.encoder.texture import erode, unproject_texture
from primdiffusion.encoder.unproject import Unprojected, extents_of_hull, unproject_texels, unproject_voxels
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.tensor_file import load_network, save, under
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.primitives.anchors import attach, default_anchors
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import Frames, K, Payload, Primitives

FORMAT_VERSION = 1


@dataclasses.dataclass(frozen=True)
class EncoderModel:
    """A trained encoder, as stored in a checkpoint of stage 1."""

    encoder: Encoder
    card: Mapping[str, Any]
    """Model card: description and training settings; JSON values."""
    body_setup: BodySetup | None = None
    """Body and anchors of the humans it encodes; None is the default body."""

    @property
    def config(self) -> EncoderConfig:
        """Settings of the encoder."""
        return self.encoder.config

    @property
    def body(self) -> BodyModel:
        """The body to which captures must be fitted."""
        return default_body() if self.body_setup is None else self.body_setup.body

    def encode(self, views: Views, betas: Float[Tensor, "n"]) -> Payload:
        """The payload of the human in `views` (unbatched, one pose); see `encode`."""
        return encode(self.encoder, views, betas, self.body_setup)

    def place(self, payload: Payload, betas: Float[Tensor, "n"], pose: BodyPose) -> Primitives:
        """Place the payload on the body that carries this encoder's boxes; on the payload's device."""
        frames = frames_of(self.config, betas.cpu(), pose.to("cpu"), self.body_setup)[1]
        return Primitives.place(frames.to(payload.density.device), payload)


@torch.no_grad()
def encode(encoder: Encoder, views: Views, betas: Float[Tensor, "n"], body_setup: BodySetup | None = None) -> Payload:
    """The payload of one human: unprojection and one forward pass, without gradients; on the encoder's device.

    Raises:
        ValueError: there are no views, they are batched, or pose or betas are not finite or do not match the body.
    """
    device = encoder.scale_out.bias.device
    views, betas = views.to("cpu"), betas.cpu()
    found = unproject_views(encoder.config, views, betas, body_setup)
    axis_angle = motion_of(views.pose.joint_rotation)[None].to(device)
    payload = encoder(stack([found]).to(device), axis_angle)
    return payload.map(lambda tensor: tensor[0].float())


def unproject_views(
    config: EncoderConfig, views: Views, betas: Float[Tensor, "n"], body_setup: BodySetup | None = None
) -> Unprojected:
    """Unproject the images of one human in one pose to the input of an encoder with this configuration; on the CPU."""
    body = default_body() if body_setup is None else body_setup.body
    if not torch.isfinite(betas).all() or betas.shape != body.shape_basis.shape[-1:]:
        expected, name = body.shape_basis.shape[-1], "default body" if body_setup is None else "encoder's body"
        raise ValueError(
            f"betas have the shape {tuple(betas.shape)}; the {name} needs {expected} finite numbers: captures of "
            "another body model must be fitted to this body first"
        )
    vertices, frames = frames_of(config, betas, views.pose, body_setup)
    if config.masks == "eroded":
        views = erode(views)
    extent = torch.tensor(config.extent).repeat(K, 1)
    if config.appearance == "texture":
        return dataclasses.replace(unproject_texture(views, vertices, body), extent=extent)
    if config.appearance == "texels":
        return dataclasses.replace(unproject_texels(views, vertices, config.facing, body), extent=extent)
    if config.thickness == "hull":
        largest = torch.tensor((*config.extent[:2], 1.0)).repeat(K, 1)
        extent = extents_of_hull(unproject_voxels(views, vertices, frames, largest, config.facing, body), config.extent)
    return unproject_voxels(views, vertices, frames, extent, config.facing, body)


def frames_of(
    config: EncoderConfig, betas: Float[Tensor, "n"], pose: BodyPose, body_setup: BodySetup | None = None
) -> tuple[Tensor, Frames]:
    """Vertices [V, 3] of the posed body and the boxes' frames on it; of mean shape if `frames` is "template"."""
    body, anchors = (default_body(), default_anchors()) if body_setup is None else (body_setup.body, body_setup.anchors)
    vertices = body.shape(betas_of_frames(config, betas)).pose(pose).vertices
    return vertices, attach(anchors, vertices, body.faces)


def betas_of_frames(config: EncoderConfig, betas: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """The shape of the body that carries the boxes: the subject's, or the mean shape if `frames` is "template"."""
    return torch.zeros_like(betas) if config.frames == "template" else betas


def default_encoder() -> Path:
    """Return the path of the encoder in the package."""
    return Path(str(resources.files("primdiffusion.weights") / "encoder.safetensors"))


def save_encoder(path: Path, model: EncoderModel, dtype: torch.dtype = torch.float16) -> None:
    """Write an encoder, whole or not at all; of its body only path and checksum of the files, and the anchors.

    Raises FileError for weights that are not finite, OSError.
    """
    tensors = {
        name: value.detach().cpu().to(dtype).contiguous().clone() for name, value in model.encoder.state_dict().items()
    }
    check_finite(path, tensors)
    body = {}
    if model.body_setup is not None:
        tensors |= anchor_tensors(model.body_setup.anchors)
        body["body"] = model.body_setup.files.to_json()
    metadata = {
        "format": ENCODER_FORMAT,
        "format_version": str(FORMAT_VERSION),
        "config": json.dumps(dataclasses.asdict(model.config)),
        "card": json.dumps(dict(model.card)),
        **body,
    }
    write_atomically(path, save(tensors, metadata=metadata))


def load_encoder(path: Path | str | None = None, device: torch.device | str = "cpu") -> EncoderModel:
    """Load an encoder in float32 (without a path: the one in the package).

    Raises FileNotFoundError for a missing file and FileError (a ValueError) for one that is truncated, of another
    format or version, does not match its own configuration or holds values that are not finite, and for a user's body
    file that is missing or has changed, which an imported one needs.
    """
    path = default_encoder() if path is None else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no encoder at {path}: give the path of a .safetensors file")
    tensors, metadata, _ = read_tensors(path, (ENCODER_FORMAT,))
    with mismatches_named(path):
        config = config_from_json(parse_json(metadata["config"]))
        anchors = {f"stand.{name}": value for name, value in under(tensors, "stand.").items()}
        weights = {name: value for name, value in tensors.items() if name not in anchors}
        encoder = load_network(lambda: Encoder(config), weights)
        card = parse_json(metadata["card"])
        body_setup = stored_body_setup(anchors, metadata["body"], path.parent) if "body" in metadata else None
    return EncoderModel(encoder.eval().requires_grad_(False).to(device), card, body_setup)
