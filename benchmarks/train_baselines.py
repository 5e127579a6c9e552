"""Trains the models of the paper's Table 2 for equal time: primitives (ours), one latent vector a human, 64^3 voxels.

`python benchmarks/train_baselines.py primitives --model ours --people DIR --out DIR --minutes 12`, and the same with
`--model latents`, prepare codec, latents and prior as `primdiffusion train` does with its default settings, and train
the person network for a fifth of the time and the U-Net for the rest. What is prepared does not count, and can be
shared by both (--prepared). DIR/model.safetensors states the minutes.

`python benchmarks/train_baselines.py voxels --people DIR --out DIR --minutes 45` makes the grids of the people that
`primdiffusion train` trains on (with its holdout and seed) into DIR/grids, fits codec and closed-form prior, and trains
both networks likewise. DIR/voxel.safetensors, which is what diffusion.py takes, is there from the first minute of the
U-Net and states how long it was trained.

Minutes are the processor's while it trains; what is made before does not count. The same command continues where it
stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from primdiffusion.files.whole_files import written_whole
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.people.payloads import rest_frames
from primdiffusion.people.stored_people import PersonFolder, find_people, read_outline, read_person
from primdiffusion.training.cells import CellTask, prepare
from primdiffusion.training.config import PhaseConfig, PriorConfig, TrainingConfig
from primdiffusion.training.latents import LatentSet, split_people, vocabulary_of
from primdiffusion.training.loop import step_seed
from primdiffusion.training.losses import PersonObjective, RestObjective
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

PERSON_SHARE = 0.2
"""Share of the time that the network over person components gets; the other one gets the rest."""
SAVE_EVERY = 60.0
TRIED = 7
"""Steps that are timed to plan the others; the first two are warm-up."""
CHANNELS = 64
"""Numbers of a cell, as many as a primitive has in our codec."""
PERSON = PhaseConfig(steps=1, batch=256)
LOCAL = PhaseConfig(steps=1, batch=16, blend=0.2, weight_decay=0.0, levels="log_normal", bfloat16=True)
"""The default model's phases; steps follow from the time."""


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
        plan.write_text(json.dumps(planned_steps(denoiser, name, run, seconds)), encoding="utf-8")
    config = dataclasses.replace(run.phases[name], steps=json.loads(plan.read_text(encoding="utf-8")))
    state = TrainingState(network, config, accelerator_of())
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
        loss = objective.loss(numbers(run.seed + 1, name, state.step))
        state.update(loss)
        mean += (float(loss.detach()) - mean) / min(state.step, 200)
        state.seconds += time.process_time() - began
        if time.monotonic() - saved > SAVE_EVERY:
            saved = time.monotonic()
            save_all()
    save_all()
    setattr(denoiser, name, state.average)
    denoiser.network_dtype = torch.float32


def numbers(seed: int, name: str, step: int) -> torch.Generator:
    """The random numbers of a step: a run that goes on draws those that it would have drawn."""
    seed = step_seed(seed, name, step, 0)
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


def planned_steps(denoiser: PersonDenoiser, name: str, run: Run, seconds: float) -> int:
    """How many steps fit into the time, by a few of a network that is thrown away: the rate falls over as many."""
    config = dataclasses.replace(run.phases[name], steps=1000)
    network = getattr(denoiser, name)
    weights = {key: value.clone() for key, value in network.state_dict().items()}
    state = TrainingState(network, config, accelerator_of())
    objective = run.objectives(name, config)
    denoiser.network_dtype = torch.bfloat16 if config.bfloat16 else torch.float32
    times = []
    for _ in range(TRIED):
        began = time.process_time()
        state.update(objective.loss(numbers(run.seed, name, state.step)))
        times.append(time.process_time() - began)
    network.load_state_dict(weights)
    return max(1, round(seconds / statistics.median(times[2:])))


def train_both(
    denoiser: PersonDenoiser,
    run: Run,
    people: LatentSet,
    minutes: float,
    threads: int,
    save: Callable[[dict[str, object]], None],
) -> None:
    """Trains the person network, then the U-Net; `save` is called at intervals with what the model's card says."""
    done: dict[str, Progress] = {}

    def export(name: str, network: torch.nn.Module, progress: Progress) -> None:
        done[name] = progress
        trained_one = getattr(denoiser, name)
        setattr(denoiser, name, network)
        about = {
            "people": len(people),
            "geometries": len(people.betas),
            "minutes": round(sum(part.seconds for part in done.values()) / 60, 1),
            "threads": threads,
            "steps": {part: progress.steps for part, progress in done.items()},
            "batch": {part: phase.batch for part, phase in run.phases.items()},
        }
        save(about)
        setattr(denoiser, name, trained_one)
        print(json.dumps(about), flush=True)

    train(denoiser, "person", run, 60 * minutes * PERSON_SHARE, export)
    train(denoiser, "local", run, 60 * minutes * (1 - PERSON_SHARE), export)


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
    """Trains both networks of a model; the prepared parts are those of `config.run`."""
    people = PersonFolder(config.data)
    prepared = prepare(config, people, *split_people(range(len(people.names)), config.holdout, config.seed))
    task = CellTask(config, prepared, torch.device("cpu"))
    denoiser = task.denoiser

    def objective(name: str, phase: PhaseConfig) -> Objective:
        if name == "local" and kind == "latents":
            return DecoderObjective(denoiser, prepared.train, prepared.codec, phase)
        return task.objective(name)

    def save(about: dict[str, object]) -> None:
        named = {"name": f"{kind}, of a comparison on equal time", "baseline": kind}
        card = {**named, "full_density": prepared.full_density, **about}
        save_checkpoint(out / "model.safetensors", dataclasses.replace(task.model(), card=card), str(config.schedule))

    run = Run(objective, task.phases, out, config.seed)
    train_both(denoiser, run, prepared.train, minutes, threads, save)


def voxels() -> None:
    parser = parser_of("Trains the voxel baseline.")
    parser.add_argument("--grids-only", action="store_true", help="make the grids, train nothing")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    paths = find_people(arguments.people)
    make_grids(paths, arguments.out / "grids")
    if arguments.grids_only:
        return
    train_paths, _ = split_people(paths, arguments.holdout, arguments.seed)
    vocabulary = vocabulary_of(each for path in train_paths for each in read_outline(path).known())
    codec, people, prior = prepared(train_paths, vocabulary, arguments.out)
    torch.manual_seed(arguments.seed)
    denoiser, shapes = voxel_denoiser(prior, codec), fit_shapes(people, prior)
    objectives = objective_of(denoiser, people, codec, vocabulary)
    phases = {"person": PERSON, "local": dataclasses.replace(LOCAL, batch=arguments.batch)}
    run = Run(objectives, phases, arguments.out, arguments.seed)
    full_density = read_person(train_paths[0]).full_density

    def save(about: dict[str, object]) -> None:
        model = VoxelModel(denoiser, codec, shapes, full_density, {**about, "schedule": SCHEDULE})
        save_voxel_model(arguments.out / "voxel.safetensors", model)

    train_both(denoiser, run, people, arguments.minutes, arguments.threads, save)


def make_grids(paths: Sequence[Path], folder: Path) -> None:
    """The grids of everybody that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [path for path in paths if not (folder / path.name).is_file()]
    for number, path in enumerate(missing):
        person = read_person(path)
        voxels = person.voxels.movedim(-1, -4).float() / 255
        rgb, density = decode_srgb(voxels[:, :, :3]), voxels[0, :, 3] * person.full_density
        grids = voxelise(rest_frames(person.betas.numpy()), rgb, density, person.full_density)
        with written_whole(folder / path.name) as unfinished, unfinished.open("wb") as file:
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
    with written_whole(stored) as unfinished:
        unfinished.write_bytes(save(contents))
    return codec, people, prior


def encoded(
    paths: Sequence[Path], vocabulary: AttributeVocabulary, codec: VoxelCodec, grids: Iterator[Tensor]
) -> LatentSet:
    """Everybody's latents and what is said of them, as of primitives."""
    latents, conditions, betas = [], [], []
    for path, one in zip(paths, grids, strict=True):
        person = read_person(path)
        latents.append(codec.encode(one).half())
        conditions += [vocabulary.encode(attributes) for attributes in person.attributes]
        betas.append(person.betas)
    geometry = torch.arange(len(paths)).repeat_interleave(torch.tensor([len(one) for one in latents]))
    detailed = torch.tensor(len(conditions))
    return LatentSet(torch.cat(latents), geometry, torch.stack(betas), torch.stack(conditions), detailed)


def objective_of(
    denoiser: PersonDenoiser, people: LatentSet, codec: VoxelCodec, vocabulary: AttributeVocabulary
) -> Objectives:
    """The losses that our model is trained by."""

    def of(name: str, config: PhaseConfig) -> PersonObjective | RestObjective:
        if name == "local":
            return RestObjective(denoiser, people, codec, vocabulary, config)  # pyright: ignore[reportArgumentType]
        coefficients = torch.cat([denoiser.prior.split(chunk.float())[0] for chunk in people.latents.split(128)])
        # As in `training.cells`: components vary more over the people they are fitted to than over new ones.
        coefficients *= denoiser.component_std / coefficients.square().mean(0).sqrt()
        return PersonObjective(denoiser, coefficients, people, vocabulary, config)

    return of


if __name__ == "__main__":
    record.run(primitives, primitives=primitives, voxels=voxels)
