"""Trains the paper's Table 2 baseline, diffusion on 64^3 voxels, on the people and for the time of our model.

`python benchmarks/diffusion_voxel.py --people DIR --out DIR --minutes 45` makes the grids of the people that
`primdiffusion train` trains on (with its holdout and seed) into DIR/grids, fits codec and closed-form prior, and trains
the person network for a fifth of the time and the U-Net for the rest. Minutes are the processor's while it trains; what
is made before does not count. The same line goes on where it stopped; DIR/voxel.safetensors, which is what diffusion.py
takes, is there from the first minute of the U-Net and states how long it was trained.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from equal_time import PERSON_SHARE, Objectives, Progress, Run, train
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.formats.whole_files import written_whole
from primdiffusion.geometry.srgb import decode_srgb
from primdiffusion.people.payloads import rest_frames
from primdiffusion.training.config import PhaseConfig, PriorConfig
from primdiffusion.training.latents import LatentSet, split_people, vocabulary_of
from primdiffusion.training.losses import PersonObjective, RestObjective
from primdiffusion.training.prior import fit_prior, fit_shapes
from primdiffusion.training.stored_people import find_people, read_outline, read_person
from safetensors.torch import load_file, save
from torch import Tensor
from voxel_baseline import (
    SCHEDULE,
    VoxelCodec,
    VoxelModel,
    fit_voxel_codec,
    save_voxel_model,
    voxel_denoiser,
)
from voxel_grid import voxelise

CHANNELS = 64
"""Numbers of a cell, as many as a primitive has in our codec."""
PERSON = PhaseConfig(steps=1, batch=256)
LOCAL = PhaseConfig(steps=1, batch=16, blend=0.2, weight_decay=0.0, levels="log_normal", bfloat16=True)
"""The default model's phases; steps follow from the time."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=Path, required=True, help="folder of payloads")
    parser.add_argument("--out", type=Path, required=True, help="folder for grids, states and model")
    parser.add_argument("--holdout", type=float, default=0.08)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=45.0)
    parser.add_argument("--batch", type=int, default=LOCAL.batch, help="of the U-Net")
    parser.add_argument("--threads", type=int, default=1)
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
    done: dict[str, Progress] = {}

    def export(name: str, network: torch.nn.Module, progress: Progress) -> None:
        done[name] = progress
        trained_one = getattr(denoiser, name)
        setattr(denoiser, name, network)
        card = {
            "people": len(people),
            "geometries": len(people.betas),
            "minutes": round(sum(part.seconds for part in done.values()) / 60, 1),
            "threads": arguments.threads,
            "steps": {part: progress.steps for part, progress in done.items()},
            "batch": {part: phase.batch for part, phase in phases.items()},
            "schedule": SCHEDULE,
        }
        model = VoxelModel(denoiser, codec, shapes, full_density, card)
        save_voxel_model(arguments.out / "voxel.safetensors", model)
        setattr(denoiser, name, trained_one)
        print(json.dumps(card), flush=True)

    train(denoiser, "person", run, 60 * arguments.minutes * PERSON_SHARE, export)
    train(denoiser, "local", run, 60 * arguments.minutes * (1 - PERSON_SHARE), export)


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


def read_betas(path: Path) -> np.ndarray:
    """A stored person's shape, without its voxels."""
    with np.load(path, allow_pickle=False) as file:
        return file["betas"]


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
    prior = fit_prior(people, codec, vocabulary, PriorConfig())  # pyright: ignore[reportArgumentType] - mirrors alike
    records = {"codec": codec, "people": people, "prior": prior}
    contents = {
        f"{part}.{name}": value.contiguous() for part, one in records.items() for name, value in vars(one).items()
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
    main()
