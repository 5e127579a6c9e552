"""Trains our model, or the latent baseline, on few people for so many minutes of the processor.

`python benchmarks/diffusion_primitives.py --model ours --people DIR --out DIR --minutes 12`, and the same with `--model
latents`, prepare codec, latents and prior as `primdiffusion train` does with its default settings, and train the person
network for a fifth of the time and the U-Net for the rest. What is prepared does not count, and can be shared by both
(--prepared). The same line goes on where it stopped; DIR/model.safetensors states the minutes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import torch
from equal_time import PERSON_SHARE, Objective, Progress, Run, train
from latent_baseline import DecoderObjective
from primdiffusion.diffusion.checkpoint import save_checkpoint
from primdiffusion.training.cells import CellTrainee, prepare
from primdiffusion.training.config import PhaseConfig, TrainingConfig
from primdiffusion.training.latents import split_people
from primdiffusion.training.shards import open_people
from torch import Tensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", choices=("ours", "latents"), required=True)
    parser.add_argument("--people", type=Path, required=True, help="folder of payloads")
    parser.add_argument("--out", type=Path, required=True, help="folder for states and model")
    parser.add_argument("--prepared", type=Path, help="folder for codec, latents and prior; --out if omitted")
    parser.add_argument("--holdout", type=float, default=0.08)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=45.0)
    parser.add_argument("--batch", type=int, default=16, help="of the U-Net; fewer give more steps in little time")
    parser.add_argument("--threads", type=int, default=1)
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
    people = open_people(config.data)
    prepared = prepare(config, people, *split_people(range(len(people.names)), config.holdout, config.seed))
    trainee = CellTrainee(config, prepared, torch.device("cpu"))
    denoiser = trainee.denoiser

    def objective(name: str, phase: PhaseConfig) -> Objective:
        if name == "local" and kind == "latents":
            return DecoderObjective(denoiser, prepared.train, prepared.codec, phase)
        return _OfTrainee(trainee, name)

    done: dict[str, Progress] = {}

    def export(name: str, network: torch.nn.Module, progress: Progress) -> None:
        done[name] = progress
        trained_one = getattr(denoiser, name)
        setattr(denoiser, name, network)
        card = {
            "name": f"{kind}, of a comparison on equal time",
            "baseline": kind,
            "full_density": prepared.full_density,
            "people": len(prepared.train),
            "geometries": len(prepared.train.betas),
            "minutes": round(sum(part.seconds for part in done.values()) / 60, 1),
            "threads": threads,
            "steps": {part: progress.steps for part, progress in done.items()},
            "batch": {part: phase.batch for part, phase in trainee.phases.items()},
        }
        model = dataclasses.replace(trainee.model(), card=card)
        save_checkpoint(out / "model.safetensors", model, str(config.schedule))
        setattr(denoiser, name, trained_one)
        print(json.dumps(card), flush=True)

    run = Run(objective, trainee.phases, out, config.seed)
    train(denoiser, "person", run, 60 * minutes * PERSON_SHARE, export)
    train(denoiser, "local", run, 60 * minutes * (1 - PERSON_SHARE), export)


@dataclasses.dataclass
class _OfTrainee:
    """The objective with which `primdiffusion train` trains a network."""

    trainee: CellTrainee
    name: str

    def loss(self, generator: torch.Generator) -> Tensor:
        """Loss of a random batch."""
        return self.trainee.loss(self.name, generator)


if __name__ == "__main__":
    main()
