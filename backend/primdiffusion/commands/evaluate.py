"""Evaluate trained models: `primdiffusion evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.encoder.model import load_encoder
from primdiffusion.evaluation import command
from primdiffusion.evaluation.command import StageTwo, TrainedReconstructor
from primdiffusion.machine import best_device
from primdiffusion.training.latents import split_people
from primdiffusion.training.stored_people import find_people, read_person


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""

    def load(path: Path | None) -> TrainedReconstructor:
        return load_encoder(path, best_device())

    def stage_two() -> StageTwo:
        return StageTwo(lambda path: load_checkpoint(path, best_device()), find_people, split_people, read_person)

    command.run(arguments, load, stage_two)
