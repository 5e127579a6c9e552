"""State that the requests of a process share: the device and the loaded models."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch

from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.encoder.model import EncoderModel, load_encoder
from primdiffusion.runtime.device import best_device, device_info

T = TypeVar("T")


class Session:
    """Serves one request at a time."""

    def __init__(self) -> None:
        self.device = best_device()
        self._model: tuple[Path | None, DiffusionModel] | None = None
        self._encoder: tuple[Path | None, EncoderModel] | None = None
        self._cache: dict[Callable[[torch.device], Any], Any] = {}

    def device_info(self) -> dict[str, Any]:
        """Torch and the device as `ready` and `hello` report them."""
        return {"torch": torch.__version__, **device_info(self.device)}

    def model(self, checkpoint: Path | None) -> DiffusionModel:
        """Load a diffusion model (None: the default); the last one stays loaded."""
        if self._model is None or self._model[0] != checkpoint:
            self._model = None  # frees the old one first
            self._model = (checkpoint, load_checkpoint(checkpoint, self.device))
        return self._model[1]

    def encoder(self, checkpoint: Path | None) -> EncoderModel:
        """Load an encoder (None: the default); the last one stays loaded."""
        if self._encoder is None or self._encoder[0] != checkpoint:
            self._encoder = None
            self._encoder = (checkpoint, load_encoder(checkpoint, self.device))
        return self._encoder[1]

    def cached(self, kind: Callable[[torch.device], T]) -> T:
        """Return `kind(device)`, created at the first call."""
        if kind not in self._cache:
            self._cache[kind] = kind(self.device)
        return self._cache[kind]
