"""What the requests of a process share: the device, and the models of the last ones, which stay in memory.

Imports torch, and with it most of what requests need, so that a child has loaded that before the first one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from primdiffusion import person_folder  # noqa: F401  loaded before the first request
from primdiffusion.checkpoints import load_checkpoint
from primdiffusion.commands import frame_drawer, step_pictures  # noqa: F401
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.machine import best_device, device_info

if TYPE_CHECKING:
    from primdiffusion.encoder.encode import EncoderModel

T = TypeVar("T")


class Session:
    """Serves one request after the other."""

    def __init__(self) -> None:
        self.device = best_device()
        self._model: tuple[Path | None, DiffusionModel] | None = None
        self._encoder: tuple[Path | None, EncoderModel] | None = None
        self._kept: dict[Callable[[torch.device], Any], Any] = {}

    def device_info(self) -> dict[str, Any]:
        """As `ready` and `hello` state it."""
        return device_info(self.device)

    def model(self, checkpoint: Path | None) -> DiffusionModel:
        """The diffusion model of a file, or the default one; the last one asked for stays loaded."""
        if self._model is None or self._model[0] != checkpoint:
            self._model = None  # frees the old one first
            self._model = (checkpoint, load_checkpoint(checkpoint, self.device))
        return self._model[1]

    def encoder(self, checkpoint: Path | None) -> EncoderModel:
        """The encoder of a file, or the default one; the last one asked for stays loaded."""
        from primdiffusion.encoder.checkpoint import load_encoder  # children that only generate start sooner

        if self._encoder is None or self._encoder[0] != checkpoint:
            self._encoder = None
            self._encoder = (checkpoint, load_encoder(checkpoint, self.device))
        return self._encoder[1]

    def kept(self, kind: Callable[[torch.device], T]) -> T:
        """The session's own `kind(device)`, made the first time it is asked for."""
        if kind not in self._kept:
            self._kept[kind] = kind(self.device)
        return self._kept[kind]
