"""Training state on any number of processes: exact resumption, and stopping together."""

from __future__ import annotations

import datetime
from pathlib import Path

import torch
from accelerate import Accelerator
from accelerate.utils import InitProcessGroupKwargs
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from primdiffusion.training.state import OptimiserConfig, TrainingState

PATIENCE = datetime.timedelta(hours=3)
"""How long processes wait for the main process, which alone evaluates, renders and prepares data."""


def accelerator_of(mixed_precision: str = "no") -> Accelerator:
    """Return the accelerator of this process; on the CPU where there is no GPU."""
    patience = InitProcessGroupKwargs(timeout=PATIENCE)
    return Accelerator(mixed_precision=mixed_precision, cpu=not torch.cuda.is_available(), kwargs_handlers=[patience])


class AcceleratedState(TrainingState):
    """`TrainingState` whose gradients go through accelerate: averaged over all processes."""

    def __init__(self, network: nn.Module, config: OptimiserConfig, seed: int, accelerator: Accelerator) -> None:
        super().__init__(network.to(accelerator.device), config, seed)
        self.accelerator = accelerator
        self.prepared, self.optimiser = accelerator.prepare(self.network, self.optimiser)
        """The network as called in training, wrapped by accelerate."""

    def _gradient(self, loss: Tensor) -> float:
        self.accelerator.backward(loss)
        norm = self.accelerator.clip_grad_norm_(self.prepared.parameters(), self.config.gradient_clip)
        return float("nan") if norm is None else float(norm)

    @staticmethod
    def saved_step(path: Path) -> int:
        """The step of a saved state; 0 without one. Raises ValueError for a damaged file."""
        if not path.exists():
            return 0
        try:
            with safe_open(path, framework="pt") as file:
                return int(file.metadata()["step"])
        except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged ({error}): start a new run folder") from error


def agreed(accelerator: Accelerator, stop: bool) -> bool:
    """Return whether any process asks to stop: all must leave a loop after the same step."""
    if accelerator.num_processes == 1:
        return stop
    requests = accelerator.gather(torch.tensor([stop], device=accelerator.device))
    return bool(torch.as_tensor(requests).any())
