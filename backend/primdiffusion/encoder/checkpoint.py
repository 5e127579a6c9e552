"""The file of a trained encoder: weights in half precision, its configuration and a card, as one safetensors file."""

from __future__ import annotations

import dataclasses
import json
from importlib import resources
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from primdiffusion.diffusion.checkpoint import ENCODER_FORMAT, CheckpointError
from primdiffusion.encoder.config import config_from_json
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.encoder.network import Encoder
from primdiffusion.staging import write_atomically

FORMAT_VERSION = 1


def default_encoder() -> Path:
    """Where the package's own encoder is."""
    return Path(str(resources.files("primdiffusion.weights") / "encoder.safetensors"))


def save_encoder(path: Path, model: EncoderModel) -> None:
    """Write an encoder, whole or not at all. Raises CheckpointError for weights that are not finite, OSError."""
    tensors = {
        name: value.detach().cpu().half().contiguous().clone() for name, value in model.encoder.state_dict().items()
    }
    _check_finite(path, tensors)
    metadata = {
        "format": ENCODER_FORMAT,
        "format_version": str(FORMAT_VERSION),
        "config": json.dumps(dataclasses.asdict(model.config)),
        "card": json.dumps(dict(model.card)),
    }
    write_atomically(path, save(tensors, metadata=metadata))


def load_encoder(path: Path | str | None = None, device: torch.device | str = "cpu") -> EncoderModel:
    """An encoder ready to use, in float32; without a path the package's own.

    Raises FileNotFoundError for a missing file and CheckpointError (a ValueError) for one that is truncated, of another
    format or version, does not match its own configuration or holds values that are not finite.
    """
    path = default_encoder() if path is None else Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no encoder at {path}: give the path of a .safetensors file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - safe_open is no mapping
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path} is truncated or no safetensors file ({error}): download or train it again"
        ) from error
    if metadata.get("format") != ENCODER_FORMAT:
        given = metadata.get("format")
        raise CheckpointError(
            f"{path} is a safetensors file of format {given!r}, not {ENCODER_FORMAT!r}: choose another file"
        )
    if metadata.get("format_version") != str(FORMAT_VERSION):
        version = metadata.get("format_version")
        raise CheckpointError(
            f"{path} has format version {version}, this program reads {FORMAT_VERSION}: use the matching release"
        )
    _check_finite(path, tensors)
    try:
        encoder = Encoder(config_from_json(json.loads(metadata["config"])))
        encoder.load_state_dict({key: value.float() for key, value in tensors.items()})
        card = json.loads(metadata["card"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        raise CheckpointError(
            f"{path} does not match its own description ({reason}): download or train it again"
        ) from error
    return EncoderModel(encoder.eval().requires_grad_(False).to(device), card)


def _check_finite(path: Path, tensors: dict[str, Tensor]) -> None:
    for key, value in tensors.items():
        if not torch.isfinite(value).all():
            raise CheckpointError(f"{path}: weights {key!r} hold NaN or infinite values: download or train them again")
