"""State of a network in training on any number of processes, saved so that a run can be resumed exactly."""

from __future__ import annotations

import copy
import datetime
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from accelerate import Accelerator
from accelerate.utils import InitProcessGroupKwargs
from torch import Tensor, nn

from primdiffusion.files import tensor_file
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.runtime.device import best_device
from primdiffusion.training.config import OptimiserSettings
from primdiffusion.training.muon import ADAM_BETAS, MuonAdamW

PATIENCE = datetime.timedelta(hours=3)
"""Longest wait for the main process, which alone evaluates, renders and prepares data."""


class TrainingState:
    """A network with optimiser, weight average and number of steps; saved and loaded as one file.

    Gradients go through accelerate: they are averaged over all processes.
    """

    def __init__(
        self,
        network: nn.Module,
        settings: OptimiserSettings,
        accelerator: Accelerator,
        optimiser: torch.optim.Optimizer | None = None,
    ) -> None:
        """Move a network to its device; the default optimiser is `adamw` of all its parameters."""
        self.network, self.settings, self.accelerator = network.to(accelerator.device), settings, accelerator
        self.average = copy.deepcopy(network).eval().requires_grad_(False)
        optimiser = optimiser or adamw(settings, network.parameters())
        self._kind = "muon" if isinstance(optimiser, MuonAdamW) else "adamw"
        self.prepared, self.optimiser = accelerator.prepare(self.network, optimiser)
        """The network as called in training, wrapped by accelerate."""
        self.step, self.seconds = 0, 0.0
        self.place: dict[str, str] = {}
        """Further state of the run, saved in the file's metadata and restored by `load`."""

    def update(self, loss: Tensor) -> float:
        """Take one optimiser step and update the average; returns the gradient's norm before clipping.

        Raises ValueError if the gradient is not finite.
        """
        rate = self.settings.learning_rate * learning_rate_factor(self.step, self.settings.steps)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["factor"]
        self.optimiser.zero_grad(set_to_none=True)
        self.accelerator.backward(loss)
        norm = self.accelerator.clip_grad_norm_(self.prepared.parameters(), self.settings.gradient_clip)
        if norm is None or not norm < math.inf:
            raise ValueError(
                f"the gradient at step {self.step} is not finite: lower the learning rate in a new run folder"
            )
        self.optimiser.step()
        decay = min(self.settings.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            means, now = tuple(self.average.parameters()), tuple(self.network.parameters())
            torch._foreach_lerp_(means, now, 1 - decay)  # pyright: ignore[reportPrivateImportUsage]
        self.step += 1
        return float(norm)

    def save(self, path: Path) -> None:
        """Write everything to one safetensors file, atomically.

        Raises ValueError, leaving the file as it was, if a weight is not finite; OSError.
        """
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        tensors |= {f"average.{k}": v for k, v in self.average.state_dict().items()}
        for index, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{index}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        if bad := _not_finite(tensors):
            raise ValueError(
                f"{bad} is not finite after step {self.step}: lower the learning rate in a new run folder; {path} "
                "was not overwritten"
            )
        self.place["optimiser"] = self._kind
        place = {"step": str(self.step), "seconds": repr(self.seconds), **self.place}
        write_atomically(
            path, tensor_file.save({k: v.detach().contiguous() for k, v in tensors.items()}, metadata=place)
        )

    def load(self, path: Path) -> None:
        """Restore a saved state; ValueError if it belongs to another network or optimiser, or is damaged."""
        with as_file_error(
            path, "does not fit this network or is damaged", "start a new run folder", OSError, RuntimeError
        ):
            tensors, place = tensor_file.read(path)
            step, seconds = int(place.pop("step")), float(place.pop("seconds"))
            for name, module in (("network", self.network), ("average", self.average)):
                module.load_state_dict(tensor_file.under(tensors, f"{name}."))
            self._load_moments(tensor_file.under(tensors, "optimiser."))
        if (before := place.get("optimiser", self._kind)) != self._kind:
            raise ValueError(
                f"{path} was trained with {before}, but this device trains with {self._kind} (Muon needs "
                "bfloat16): resume on a device like the first, or begin a new run with --start-from"
            )
        self.step, self.seconds, self.place = step, seconds, place

    def _load_moments(self, tensors: dict[str, Tensor]) -> None:
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            index, name = key.split(".")
            moments.setdefault(int(index), {})[name] = value
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})


def adamw(
    settings: OptimiserSettings, parameters: Iterable[nn.Parameter], *others: tuple[list, float]
) -> torch.optim.AdamW:
    """AdamW of a network's parameters; `others` are further ones, each with a factor on their learning rate."""
    groups = [{"params": list(group), "factor": factor} for group, factor in ((parameters, 1.0), *others)]
    return torch.optim.AdamW(groups, lr=settings.learning_rate, weight_decay=settings.weight_decay, betas=ADAM_BETAS)


def saved_step(path: Path) -> int:
    """The step of a saved state; 0 without one. Raises ValueError for a damaged file."""
    if not path.exists():
        return 0
    with as_file_error(path, "is damaged", "start a new run folder", OSError):
        return int(tensor_file.TensorFile(path).metadata["step"])


def learning_rate_factor(step: int, steps: int) -> float:
    """A linear rise over 100 steps times a cosine from 1 to 0.1 over `steps`."""
    cosine = 0.5 + 0.5 * math.cos(math.pi * min(1.0, step / steps))
    return min(1.0, (step + 1) / 100) * (0.1 + 0.9 * cosine)


def _not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    return next((key for key, value in tensors.items() if not torch.isfinite(value).all()), None)


def accelerator_of(mixed_precision: str = "no") -> Accelerator:
    """Return the accelerator of this process, on `best_device`; ValueError if a chosen device is not available."""
    patience = InitProcessGroupKwargs(timeout=PATIENCE)
    on_cpu = best_device().type == "cpu"
    return Accelerator(mixed_precision=mixed_precision, cpu=on_cpu, kwargs_handlers=[patience])


def any_process_stops(accelerator: Accelerator, stop: bool) -> bool:
    """Return whether any process asks to stop: all must leave a loop after the same step."""
    if accelerator.num_processes == 1:
        return stop
    requests = accelerator.gather(torch.tensor([stop], device=accelerator.device))
    return bool(torch.as_tensor(requests).any())
