"""Trains a network of a denoiser for so many seconds of the processor: models that are compared get equal time."""

from __future__ import annotations

import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.training.config import PhaseConfig
from primdiffusion.training.state import TrainingState
from torch import Tensor

PERSON_SHARE = 0.2
"""Share of the time that the network over person components gets; the other one gets the rest."""
SAVE_EVERY = 60.0
TRIED = 7
"""Steps that are timed to plan the others; the first two are warm-up."""


class Objective(Protocol):
    """What a network is trained by."""

    def loss(self, generator: torch.Generator) -> Tensor:
        """Loss of a random batch."""
        ...


Objectives = Callable[[str, PhaseConfig], Objective]
"""The objective of a network ("person", "local") with these settings."""


class Run(NamedTuple):
    """What the networks of a denoiser are trained with."""

    objectives: Objectives
    phases: Mapping[str, PhaseConfig]
    """Settings of each network; their steps follow from the time."""
    folder: Path
    seed: int


class Progress(NamedTuple):
    """How long a network was trained."""

    steps: int
    seconds: float


Export = Callable[[str, torch.nn.Module, Progress], None]
"""Called at intervals with the name of a network, the average of its weights, and its progress."""


def train(denoiser: PersonDenoiser, name: str, run: Run, seconds: float, export: Export) -> None:
    """Trains one network for so many seconds, interruptions not counted, and leaves its average in place.

    The rate falls over the planned steps; further ones have its last value.
    """
    network = getattr(denoiser, name).requires_grad_(True)
    plan, stored = run.folder / f"{name}.json", run.folder / f"{name}.state.safetensors"
    if not plan.is_file():
        plan.write_text(json.dumps(planned_steps(denoiser, name, run, seconds)))
    config = dataclasses.replace(run.phases[name], steps=json.loads(plan.read_text()))
    state = TrainingState(network, config, run.seed + 1)
    if stored.is_file():
        state.load(stored)
    objective = run.objectives(name, config)
    denoiser.network_dtype = torch.bfloat16 if config.bfloat16 else torch.float32
    network.train()
    mean, saved = 0.0, time.monotonic()

    def save_all() -> None:
        state.save(stored)
        print(name, state.step, "of", config.steps, f"{state.seconds:.0f} s, loss {mean:.4f}", flush=True)
        export(name, state.average, Progress(state.step, state.seconds))

    while state.seconds < seconds:
        began = time.process_time()
        loss = objective.loss(state.generator)
        state.update(loss)
        mean += (float(loss.detach()) - mean) / min(state.step, 200)
        state.seconds += time.process_time() - began
        if time.monotonic() - saved > SAVE_EVERY:
            saved = time.monotonic()
            save_all()
    save_all()
    setattr(denoiser, name, state.average)
    denoiser.network_dtype = torch.float32


def planned_steps(denoiser: PersonDenoiser, name: str, run: Run, seconds: float) -> int:
    """How many steps fit into the time, by a few of a network that is thrown away: the rate falls over as many."""
    config = dataclasses.replace(run.phases[name], steps=1000)
    network = getattr(denoiser, name)
    weights = {key: value.clone() for key, value in network.state_dict().items()}
    state = TrainingState(network, config, 0)
    objective = run.objectives(name, config)
    denoiser.network_dtype = torch.bfloat16 if config.bfloat16 else torch.float32
    times = []
    for _ in range(TRIED):
        began = time.process_time()
        state.update(objective.loss(state.generator))
        times.append(time.process_time() - began)
    network.load_state_dict(weights)
    return max(1, round(seconds / statistics.median(times[2:])))
