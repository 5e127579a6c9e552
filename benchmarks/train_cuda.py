"""Milliseconds of a training step of the default preset's local network on a CUDA device, on people drawn at random.

`march_cuda.py --train` calls it. The step is that of `primdiffusion train`, from the model that ships with the package:
as it is there, where losses, gradients and Muon are recorded, and launched one by one.

`python benchmarks/train_cuda.py` on any machine counts the operators of a step, which are about the launches on a
device, and those among them that are recorded.
"""

# ruff: noqa: E402 - packages that the machine lacks are replaced before they are imported
from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from unittest.mock import MagicMock

import torch
from torch.utils._python_dispatch import TorchDispatchMode

for missing in ("tyro", "trimesh", "trimesh.geometry", "trimesh.triangles", "trimesh.graph", "igl"):
    try:
        __import__(missing)
    except ImportError:  # of command lines and meshes; nothing here calls them
        sys.modules[missing] = MagicMock()

from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.codec import CellCodec
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.render.cuda import graph as cuda_graph
from primdiffusion.training.config import NetworkTraining, TrainingConfig
from primdiffusion.training.latents import LatentSet
from primdiffusion.training.losses import RestObjective
from primdiffusion.training.muon import MuonAdamW
from primdiffusion.training.state import TrainingState, accelerator_of

MODEL = Path(__file__).resolve().parents[1] / "backend/primdiffusion/weights/default.safetensors"
PEOPLE, BATCHES, STEPS = 64, (16, 64), 10


class Training:
    """The local network in training, as at the start of a run."""

    def __init__(self, batch: int, people: int = PEOPLE) -> None:
        accelerator = accelerator_of()
        device = accelerator.device
        model = load_checkpoint(MODEL)
        denoiser, codec, generator = model.denoiser, model.codec, torch.Generator().manual_seed(0)
        assert isinstance(denoiser, PersonDenoiser)
        assert isinstance(codec, CellCodec)
        latents, condition = denoiser.prior.sample(people, generator), denoiser.prior.sample_kinds(people, generator)
        drawn = LatentSet(
            latents.half(), torch.arange(people) // 4, torch.zeros(people // 4, 10), condition, torch.tensor(people)
        ).to(device)
        denoiser.float().eval().requires_grad_(False).to(device)
        settings = TrainingConfig.__dataclass_fields__["local"].default_factory()
        assert isinstance(settings, NetworkTraining)
        settings = dataclasses.replace(settings, batch=batch)
        assert denoiser.local is not None
        network = denoiser.local.requires_grad_(True)
        self.state = TrainingState(network, settings, accelerator, MuonAdamW(network, settings.learning_rate, 0.0))
        denoiser.local = self.state.prepared
        denoiser.network_dtype = torch.bfloat16 if device.type == "cuda" else torch.float32
        self.state.prepared.train()
        self.objective = RestObjective(denoiser, drawn, codec.codec.to(device), model.vocabulary, settings)
        self.generator = torch.Generator(device).manual_seed(0)

    def step(self) -> None:
        """As in `primdiffusion.training.loop`."""
        loss = self.objective.loss(self.generator)
        float(loss.detach())
        self.state.update(loss)

    def gradients(self) -> Callable[[], None]:
        """Loss and gradients of one batch again and again."""
        batch = self.objective.batch(self.generator)
        return lambda: self.objective._recorded(*batch).backward()


def median_ms(call: Callable[[], object], repeats: int = 15, warm_up: int = 4) -> float:
    """By the clock, with the device idle before and after."""
    times = []
    for number in range(warm_up + repeats):
        torch.cuda.synchronize()
        began = time.perf_counter()
        call()
        torch.cuda.synchronize()
        if number >= warm_up:
            times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times)


def training_figures(kernels_ms: Callable[[Callable[[], object]], tuple[float, str]]) -> dict[str, float]:
    """Of the whole step and its parts, recorded and not, and how far the weights are apart after some steps."""
    figures: dict[str, float] = {}
    for batch in BATCHES:
        weights = []
        for name in ("", "_eager"):
            cuda_graph.ENABLED = not name
            try:
                training = Training(batch)
                for _ in range(STEPS):
                    training.step()
                weights.append(torch.cat([parameter.flatten() for parameter in training.state.network.parameters()]))
                of = f"{name}_of_{batch}_ms"
                figures[f"cuda_train_step{of}"] = median_ms(training.step)
                figures[f"cuda_train_gradients{of}"] = median_ms(training.gradients())
                figures[f"cuda_train_optimiser{of}"] = median_ms(training.state.optimiser.step)
            finally:
                cuda_graph.ENABLED = True
            if not name:
                figures[f"cuda_train_batch_of_{batch}_ms"] = median_ms(
                    lambda training=training: training.objective.batch(training.generator)
                )
                figures[f"cuda_train_kernels_of_{batch}_ms"], table = kernels_ms(training.step)
                print(table)
            print(figures, flush=True)
        figures[f"cuda_train_weights_apart_of_{batch}"] = float((weights[0] - weights[1]).abs().max())
    figures["cuda_train_step_ms"] = figures[f"cuda_train_step_of_{BATCHES[-1]}_ms"]
    return figures


class Operators(TorchDispatchMode):
    """Counts those that launch something: no views, no memory."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        view = any(found.alias_info is not None and not found.alias_info.is_write for found in func._schema.returns)
        self.count += not view and "empty" not in func.__name__
        return func(*args, **(kwargs or {}))


def main() -> None:
    training = Training(16)
    training.step()
    parts = {
        "drawing a batch": lambda: training.objective.batch(training.generator),
        "loss and gradients, recorded": training.gradients(),
        "Muon, recorded": training.state.optimiser.optimizer._muon.step,
    }
    for name, call in parts.items():
        with Operators() as counted:
            call()
        print(f"{name}: {counted.count} operators")


if __name__ == "__main__":
    main()
