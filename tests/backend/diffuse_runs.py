"""Runs of stage 2 that take seconds: few small people, few channels, small pictures."""

import functools
import json
import sys
from pathlib import Path

import pytest
from accelerate.state import AcceleratorState
from diffusion_people import SMALL
from primdiffusion.diffusion.unet import UNetConfig
from primdiffusion.training import diffusion_task, losses
from primdiffusion.training.config import CodecConfig, NetworkTraining, PriorConfig, TrainingConfig
from primdiffusion.training.diffuse import train
from support.runs import rows

TINY_UNET = UNetConfig(width=32, multipliers=(1, 1, 1, 1, 1), blocks=1, heads=2)
DEFAULT_FILES = {".lock", "config.json", "run.json", "metrics.jsonl", "pictures", "model.safetensors",
                 "prepared.safetensors", "state.safetensors"}  # fmt: skip


def make_small(patch: pytest.MonkeyPatch) -> None:
    """Pictures of one person, of few pixels and steps, slabs judged at one level; accelerate forgets earlier runs."""
    patch.setattr(diffusion_task, "WIDTH", 24)
    patch.setattr(diffusion_task, "HEIGHT", 40)
    patch.setattr(diffusion_task, "STEP", 0.03)
    patch.setattr(diffusion_task, "x0_errors", functools.partial(losses.x0_errors, levels=(500,)))
    patch.setattr(diffusion_task, "SEEDS", (0,))
    patch.setattr(diffusion_task, "generate_batch", functools.partial(diffusion_task.generate_batch, steps=1))
    AcceleratorState._reset_state(reset_partial_state=True)


def settings(people: Path, run: Path, **changes) -> TrainingConfig:
    """Ten steps, or two of the paper's preset."""
    quick = {
        "holdout": 0.2,
        "codec": CodecConfig(channels=4, people=8),
        "prior": PriorConfig(components=6),
        "model": SMALL,
        "local": NetworkTraining(steps=10, batch=4, evaluate_every=5),
        "unet": TINY_UNET,
        "slab": NetworkTraining(steps=2, batch=1, learning_rate=1e-3, evaluate_every=2),
        "log_every": 1,
        "threads": 1,
    }
    return TrainingConfig(data=people, run=run, **{**quick, **changes})


def logged(run: Path) -> list[int]:
    """Steps of the lines that tell the loss."""
    return [row["step"] for row in rows(run) if "loss" in row]


if __name__ == "__main__":  # a run in a process of its own
    make_small(pytest.MonkeyPatch())
    data, folder, local = sys.argv[1:]
    train(settings(Path(data), Path(folder), local=NetworkTraining(**json.loads(local))))
