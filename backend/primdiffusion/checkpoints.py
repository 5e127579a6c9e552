"""Load a diffusion model from a checkpoint of either kind: trained here, or imported from the released weights."""

from __future__ import annotations

from pathlib import Path

import torch

from primdiffusion.diffusion.checkpoint import build_model, default_checkpoint, mismatches_named, read_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.released.imported import KIND, released_model


def load_checkpoint(path: Path | str | None = None, device: torch.device | str = "cpu") -> DiffusionModel:
    """Return a model ready to sample, in float32; without a path the package's default.

    Raises FileNotFoundError for a missing file and CheckpointError (a ValueError) for one that is truncated, of another
    format or version, does not match its own architecture or holds values that are not finite. An imported one
    (`released`) also raises BodySetupError (a ValueError) if the user's body file that it needs is missing or changed.
    """
    path = default_checkpoint() if path is None else Path(path)
    tensors, architecture, card = read_checkpoint(path)
    with mismatches_named(path):
        if architecture["kind"] == KIND:
            model = released_model(tensors, architecture, card, path.parent)
        else:
            model = build_model(tensors, architecture, card)
    return model.to(device)
