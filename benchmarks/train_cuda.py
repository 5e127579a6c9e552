"""Milliseconds of a training step of the default preset's local network on a CUDA device, on random latents.

`march_cuda.py --train` calls it. Sizes are those of the model that ships with the package; values are random. The whole
step is that of `primdiffusion train`; parts of it show where its time goes, and what a graph of them takes.
"""

# ruff: noqa: E402 - packages that the machine lacks are replaced before they are imported
from __future__ import annotations

import dataclasses
import functools
import statistics
import sys
import time
from collections.abc import Callable
from unittest.mock import MagicMock

import torch
from torch import Tensor

for missing in ("tyro", "trimesh", "trimesh.geometry", "trimesh.triangles", "trimesh.graph", "igl"):
    try:
        __import__(missing)
    except ImportError:  # of command lines and meshes; nothing here calls them
        sys.modules[missing] = MagicMock()

from primdiffusion.diffusion.codec import VALUES, LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import DenoiserConfig, PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.schedule import SCHEDULES
from primdiffusion.render.cuda import graph as cuda_graph
from primdiffusion.training.config import TrainingConfig
from primdiffusion.training.latents import LatentSet
from primdiffusion.training.losses import RestObjective, weighted_error
from primdiffusion.training.muon import MuonAdamW
from primdiffusion.training.state import TrainingState, accelerator_of

CHANNELS, DRAWN, COMPONENTS, GROUPS, KINDS, ATTRIBUTES, CELLS = 320, 64, 192, 29, 72, 40, 1024
PEOPLE, BATCH = 256, 64


def random_denoiser() -> PersonDenoiser:
    """Of the shipped model's sizes."""
    torch.manual_seed(0)
    basis = torch.linalg.qr(torch.randn(DRAWN * CELLS, COMPONENTS))[0].T.contiguous()
    axes = torch.linalg.qr(torch.randn(GROUPS, COMPONENTS, COMPONENTS))[0]
    prior = PersonPrior.of_whole_body(
        mean=torch.zeros(CHANNELS, 32, 32), basis=basis, parity=torch.ones(COMPONENTS),
        rest_variance=torch.rand(CHANNELS, 32, 32) + 0.01,
        log_weight=torch.full((GROUPS, KINDS), 1 / GROUPS / KINDS).log(),
        centre=torch.randn(GROUPS, KINDS, COMPONENTS), axes=axes, variance=torch.rand(GROUPS, COMPONENTS) + 0.01,
        kind=(torch.rand(GROUPS, KINDS, ATTRIBUTES) < 0.2).float(),
    )  # fmt: skip
    return PersonDenoiser(DenoiserConfig(), prior, SCHEDULES["fine_linear"]())


def random_people(device: torch.device) -> LatentSet:
    condition = (torch.rand(PEOPLE, ATTRIBUTES) < 0.2).float()
    latents = torch.randn(PEOPLE, CHANNELS, 32, 32, device=device).half()
    geometry = torch.arange(PEOPLE, device=device) // 4
    return LatentSet(
        latents, geometry, torch.zeros(PEOPLE // 4, 10, device=device), condition.to(device),
        torch.tensor(PEOPLE, device=device),
    )  # fmt: skip


def random_codec() -> LinearCodec:
    parity = torch.where(torch.rand(6, CHANNELS) < 0.5, -1.0, 1.0)
    return LinearCodec(torch.zeros(CELLS, VALUES), torch.zeros(6, CHANNELS, VALUES), parity, torch.arange(CELLS) % 6)


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


def training_figures() -> dict[str, float]:
    """Of the whole step, of its loss, of the network alone with and without a graph, and of the optimiser."""
    accelerator = accelerator_of()
    device = accelerator.device
    denoiser = random_denoiser().eval().requires_grad_(False).to(device)
    settings = TrainingConfig.__dataclass_fields__["local"].default_factory()
    settings = dataclasses.replace(settings, batch=BATCH)
    network = denoiser.local.requires_grad_(True)
    state = TrainingState(network, settings, accelerator, MuonAdamW(network, settings.learning_rate, 0.0))
    denoiser.local, denoiser.network_dtype = state.prepared, torch.bfloat16
    state.prepared.train()
    vocabulary = AttributeVocabulary({f"a{i}": tuple("abcdefgh") for i in range(5)}, {})
    objective = RestObjective(denoiser, random_people(device), random_codec().to(device), vocabulary, settings)
    generator = torch.Generator(device).manual_seed(0)

    def step() -> None:
        loss = objective.loss(generator)
        float(loss.detach())
        state.update(loss)

    figures = {"cuda_train_step_ms": median_ms(step)}
    print(figures, flush=True)
    figures["cuda_train_loss_ms"] = median_ms(lambda: objective.loss(generator))
    figures["cuda_train_optimiser_ms"] = median_ms(state.optimiser.step)
    print(figures, flush=True)

    rest = torch.randn(BATCH, CHANNELS, 32, 32, device=device)
    inputs = (rest, torch.randn(BATCH, COMPONENTS, device=device), torch.full((BATCH,), 200, device=device))
    parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]

    def passes(rest: Tensor, coefficients: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        guess, std, correction = denoiser.rest_parts(rest, coefficients, t)
        loss = weighted_error((guess - rest) / std + correction, std)
        return loss.detach(), *torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True)

    figures["cuda_train_network_ms"] = median_ms(lambda: passes(*inputs))
    print(figures, flush=True)
    recorded = cuda_graph.Recorded(passes)
    figures["cuda_train_network_graph_ms"] = median_ms(functools.partial(recorded, *inputs))
    return figures
