"""Trains the models of the paper's Table 2 for equal time: primitives (ours), one latent vector a human, 64^3 voxels.

`python benchmarks/train_baselines.py primitives --model ours --people DIR --out DIR --minutes 12`, and the same with
`--model latents`, prepare codec, latents and prior as `primdiffusion train` does with its default settings, and train
the U-Net. What is prepared does not count, and can be shared by both (--prepared). DIR/model.safetensors states the
minutes.

`python benchmarks/train_baselines.py voxels --people DIR --out DIR --minutes 45` makes the grids of the people that
`primdiffusion train` trains on (with its holdout and seed) into DIR/grids, fits codec and closed-form prior, and trains
the U-Net likewise. DIR/voxel.safetensors, which is what diffusion.py takes, is there from the first minute and states
how long it was trained.

Minutes are the processor's while it trains; what is made before does not count. The same command continues where it
stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import record
import torch
from latent_baseline import DecoderObjective
from primdiffusion.diffusion.checkpoint import save_checkpoint
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.schedule import schedule_name
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.people.payloads import rest_frames
from primdiffusion.people.stored_people import PersonFolder, find_payloads, read_outline, read_payloads
from primdiffusion.training.cells import CellTask, prepare
from primdiffusion.training.config import NetworkTraining, PriorConfig, TrainingConfig
from primdiffusion.training.latents import LatentSet, split_people, vocabulary_of
from primdiffusion.training.loop import step_seed
from primdiffusion.training.losses import RestObjective
from primdiffusion.training.prior import fit_prior, fit_shapes
from primdiffusion.training.state import TrainingState, accelerator_of
from safetensors.torch import load_file, save
from torch import Tensor
from voxel_baseline import (
    SCHEDULE,
    VoxelCodec,
    VoxelModel,
    fit_voxel_codec,
    save_voxel_model,
    voxel_denoiser,
    voxelise,
)

SAVE_EVERY = 60.0
TRIED = 7
"""Steps that are timed to plan the others; the first two are warm-up."""
CHANNELS = 64
"""Numbers of a cell, as many as a primitive has in our codec."""
LOCAL = NetworkTraining(steps=1, batch=16, blend_fraction=0.2, weight_decay=0.0, levels="log_normal", bfloat16=True)
"""Training of the default model; steps follow from the time."""


class Objective(Protocol):
    """What a network is trained by."""

    def loss(self, generator: torch.Generator) -> Tensor:
        """Loss of a random batch."""
        ...


class Run(NamedTuple):
    """What the U-Net of a denoiser is trained with."""

    denoiser: PersonDenoiser
    objective: Objective
    config: NetworkTraining
    """Settings of the training; steps follow from the time."""
    people: LatentSet
    folder: Path
    seed: int
    threads: int


Save = Callable[[dict[str, object]], None]
"""Called at intervals, while the average of the weights is in place, with what the model's card says."""


def train(run: Run, minutes: float, save: Save) -> None:
    """Train for so many minutes, interruptions not counted, and leave the average of the weights in place.

    The rate falls over the planned steps; further ones have its last value.
    """
    denoiser, seconds = run.denoiser, 60 * minutes
    network = _network(denoiser).requires_grad_(True)
    plan, stored = run.folder / "local.json", run.folder / "local.state.safetensors"
    if not plan.is_file():
        plan.write_text(json.dumps(planned_steps(run, seconds)), encoding="utf-8")
    config = dataclasses.replace(run.config, steps=json.loads(plan.read_text(encoding="utf-8")))
    state = TrainingState(network, config, accelerator_of())
    if stored.is_file():
        state.load(stored)
    denoiser.network_dtype = torch.bfloat16 if config.bfloat16 else torch.float32
    network.train()
    mean, saved = 0.0, time.monotonic()

    def save_all() -> None:
        state.save(stored)
        print(state.step, "of", config.steps, f"{state.seconds:.0f} s, loss {mean:.4f}", flush=True)
        denoiser.local = state.average  # pyright: ignore[reportAttributeAccessIssue]
        about = {
            "people": len(run.people),
            "geometries": len(run.people.betas),
            "minutes": round(state.seconds / 60, 1),
            "threads": run.threads,
            "steps": {"local": state.step},
            "batch": {"local": config.batch},
        }
        save(about)
        denoiser.local = network  # pyright: ignore[reportAttributeAccessIssue]
        print(json.dumps(about), flush=True)

    while state.seconds < seconds:
        began = time.process_time()
        loss = run.objective.loss(numbers(run.seed + 1, state.step))
        state.update(loss)
        mean += (float(loss.detach()) - mean) / min(state.step, 200)
        state.seconds += time.process_time() - began
        if time.monotonic() - saved > SAVE_EVERY:
            saved = time.monotonic()
            save_all()
    save_all()
    denoiser.local = state.average  # pyright: ignore[reportAttributeAccessIssue]
    denoiser.network_dtype = torch.float32


def numbers(seed: int, step: int) -> torch.Generator:
    """The random numbers of a step: a run that goes on draws those that it would have drawn."""
    seed = step_seed(seed, "local", step, 0)
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


def planned_steps(run: Run, seconds: float) -> int:
    """How many steps fit into the time, by a few of a network that is thrown away: the rate falls over as many."""
    config, network = dataclasses.replace(run.config, steps=1000), _network(run.denoiser)
    weights = {key: value.clone() for key, value in network.state_dict().items()}
    state = TrainingState(network, config, accelerator_of())
    run.denoiser.network_dtype = torch.bfloat16 if config.bfloat16 else torch.float32
    times = []
    for _ in range(TRIED):
        began = time.process_time()
        state.update(run.objective.loss(numbers(run.seed, state.step)))
        times.append(time.process_time() - began)
    network.load_state_dict(weights)
    return max(1, round(seconds / statistics.median(times[2:])))


def _network(denoiser: PersonDenoiser) -> torch.nn.Module:
    assert denoiser.local is not None
    return denoiser.local


def parser_of(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--people", type=Path, required=True, help="folder of payloads")
    parser.add_argument("--out", type=Path, required=True, help="folder for states and model")
    parser.add_argument("--holdout", type=float, default=0.08)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=45.0)
    parser.add_argument(
        "--batch", type=int, default=LOCAL.batch, help="of the U-Net; fewer give more steps in little time"
    )
    parser.add_argument("--threads", type=int, default=1)
    return parser


def primitives() -> None:
    parser = parser_of("Trains our model or the latent baseline.")
    parser.add_argument("--model", choices=("ours", "latents"), required=True)
    parser.add_argument("--prepared", type=Path, help="folder for codec, latents and prior; --out if omitted")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    folder = arguments.prepared or arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    config = TrainingConfig(data=arguments.people, run=folder, holdout=arguments.holdout, seed=arguments.seed)
    config = dataclasses.replace(config, local=dataclasses.replace(config.local, batch=arguments.batch))
    train_model(config, arguments.model, arguments.out, arguments.minutes, arguments.threads)


def train_model(config: TrainingConfig, kind: str, out: Path, minutes: float, threads: int) -> None:
    """Trains the network of a model; the prepared parts are those of `config.run`."""
    people = PersonFolder(config.data)
    prepared = prepare(config, people, *split_people(range(len(people.names)), config.holdout, config.seed))
    task = CellTask(config, prepared, torch.device("cpu"))
    denoiser = task.denoiser

    objective: Objective = task.objective
    if kind == "latents":
        objective = DecoderObjective(denoiser, prepared.train, prepared.codec, task.settings)

    def save(about: dict[str, object]) -> None:
        named = {"name": f"{kind}, of a comparison on equal time", "baseline": kind}
        card = {**named, "full_density": prepared.full_density, **about}
        model = dataclasses.replace(task.model(), card=card)
        save_checkpoint(out / "model.safetensors", model, schedule_name(model.schedule))

    train(Run(denoiser, objective, task.settings, prepared.train, out, config.seed, threads), minutes, save)


def voxels() -> None:
    parser = parser_of("Trains the voxel baseline.")
    parser.add_argument("--grids-only", action="store_true", help="make the grids, train nothing")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    paths = find_payloads(arguments.people)
    make_grids(paths, arguments.out / "grids")
    if arguments.grids_only:
        return
    train_paths, _ = split_people(paths, arguments.holdout, arguments.seed)
    vocabulary = vocabulary_of(each for path in train_paths for each in read_outline(path).known())
    codec, people, prior = prepared(train_paths, vocabulary, arguments.out)
    torch.manual_seed(arguments.seed)
    denoiser, shapes = voxel_denoiser(prior, codec), fit_shapes(people, prior)
    settings = dataclasses.replace(LOCAL, batch=arguments.batch)
    objective = RestObjective(denoiser, people, codec, vocabulary, settings)  # pyright: ignore[reportArgumentType]
    full_density = read_payloads(train_paths[0]).full_density

    def save(about: dict[str, object]) -> None:
        model = VoxelModel(denoiser, codec, shapes, full_density, {**about, "schedule": SCHEDULE})
        save_voxel_model(arguments.out / "voxel.safetensors", model)

    run = Run(denoiser, objective, settings, people, arguments.out, arguments.seed, arguments.threads)
    train(run, arguments.minutes, save)


def make_grids(paths: Sequence[Path], folder: Path) -> None:
    """The grids of everybody that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [path for path in paths if not (folder / path.name).is_file()]
    for number, path in enumerate(missing):
        person = read_payloads(path)
        voxels = person.voxels.movedim(-1, -4).float() / 255
        rgb, density = decode_srgb(voxels[:, :, :3]), voxels[0, :, 3] * person.full_density
        grids = voxelise(rest_frames(person.betas.numpy()), rgb, density, person.full_density)
        with atomic_path(folder / path.name) as unfinished, unfinished.open("wb") as file:
            np.savez_compressed(file, grids=grids.numpy())
        if number % 50 == 0:
            print("grids", number, "of", len(missing), flush=True)


def prepared(
    paths: Sequence[Path], vocabulary: AttributeVocabulary, folder: Path
) -> tuple[VoxelCodec, LatentSet, PersonPrior]:
    """Codec, latents and prior; read back from the folder when they are there."""

    def grids() -> Iterator[Tensor]:
        for path in paths:
            with np.load(folder / "grids" / path.name) as file:
                yield torch.from_numpy(file["grids"])

    stored = folder / "prepared.safetensors"
    if stored.is_file():
        parts = {"codec": {}, "people": {}, "prior": {}}
        for key, value in load_file(stored).items():
            part, name = key.split(".")
            parts[part][name] = value
        return VoxelCodec(**parts["codec"]), LatentSet(**parts["people"]), PersonPrior(**parts["prior"])
    codec = fit_voxel_codec(grids, CHANNELS)
    print("codec of", len(codec.cells), "cells", flush=True)
    people = encoded(paths, vocabulary, codec, grids())
    print("latents", tuple(people.latents.shape), flush=True)
    whole = torch.zeros(len(codec.cells), dtype=torch.int64)
    prior = fit_prior(people, codec, vocabulary, PriorConfig(), whole)  # pyright: ignore[reportArgumentType] - mirrors alike
    records = {"codec": codec, "people": people, "prior": prior}
    contents = {
        f"{part}.{field.name}": getattr(one, field.name).contiguous()
        for part, one in records.items()
        for field in dataclasses.fields(one)
    }
    with atomic_path(stored) as unfinished:
        unfinished.write_bytes(save(contents))
    return codec, people, prior


def encoded(
    paths: Sequence[Path], vocabulary: AttributeVocabulary, codec: VoxelCodec, grids: Iterator[Tensor]
) -> LatentSet:
    """Everybody's latents and what is said of them, as of primitives."""
    latents, conditions, betas = [], [], []
    for path, one in zip(paths, grids, strict=True):
        person = read_payloads(path)
        latents.append(codec.encode(one).half())
        conditions += [vocabulary.encode(attributes) for attributes in person.attributes]
        betas.append(person.betas)
    geometry = torch.arange(len(paths)).repeat_interleave(torch.tensor([len(one) for one in latents]))
    detailed = torch.tensor(len(conditions))
    return LatentSet(torch.cat(latents), geometry, torch.stack(betas), torch.stack(conditions), detailed)


if __name__ == "__main__":
    record.run(primitives, primitives=primitives, voxels=voxels)
