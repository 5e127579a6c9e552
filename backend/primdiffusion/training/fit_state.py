"""What a run of stage 1 needs to go on exactly where it stopped, on any number of processes."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

import accelerate
import torch
from accelerate import Accelerator
from safetensors import SafetensorError, safe_open
from torch import Tensor

from primdiffusion.encoder.blocks import UntiedConv
from primdiffusion.encoder.network import Encoder
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.state import TrainingState


class FitState(TrainingState):
    """`TrainingState` whose gradients go through accelerate; `place["position"]` is the place in the data, as JSON."""

    def __init__(self, encoder: Encoder, config: FitConfig, accelerator: Accelerator) -> None:
        self.place_rate = config.place_rate
        super().__init__(encoder.to(accelerator.device), config, config.seed)
        self.accelerator = accelerator
        self.prepared, self.optimiser = accelerator.prepare(self.network, self.optimiser)
        """The network as it is called in training."""

    def _groups(self) -> list[dict[str, object]]:
        """A place's own bias is met once a picture, a weight at every place: at one rate the weights run away."""
        biases = [m.bias for m in self.network.modules() if isinstance(m, UntiedConv)]
        known = {id(bias) for bias in biases}
        others = [parameter for parameter in self.network.parameters() if id(parameter) not in known]
        return [{"params": others, "factor": 1.0}, {"params": biases, "factor": self.place_rate}]

    @property
    def encoder(self) -> Encoder:
        """With averaged weights: what is measured and kept."""
        assert isinstance(self.average, Encoder)
        return self.average

    def _gradient(self, loss: Tensor) -> float:
        self.accelerator.backward(loss)
        norm = self.accelerator.clip_grad_norm_(self.prepared.parameters(), self.config.gradient_clip)
        return float("nan") if norm is None else float(norm)

    @staticmethod
    def saved_step(path: Path) -> int:
        """The step of a saved state; 0 where there is none. Raises ValueError for a damaged file."""
        if not path.exists():
            return 0
        try:
            with safe_open(path, framework="pt") as file:
                return int(file.metadata()["step"])
        except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged ({error}): start a new run folder") from error


def versions() -> dict[str, str]:
    """What ran: Python, torch, accelerate, and of a checkout its commit, "-dirty" where files differ from it."""
    found = {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "accelerate": accelerate.__version__,
        "machine": platform.machine(),
    }
    here = Path(__file__)
    try:
        _git(here.parent, "ls-files", "--error-unmatch", here.name)  # an environment may lie in another checkout
        return {**found, "commit": _git(here.parent, "describe", "--always", "--dirty", "--exclude", "*")}
    except (OSError, subprocess.SubprocessError):
        return found


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=True
    )  # fmt: skip
    return done.stdout.strip()
