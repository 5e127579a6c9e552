"""Stage 2: train a diffusion model on people as primitives (paper sec. 3.3). `primdiffusion train --help`."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import tyro
from accelerate import PartialState

from primdiffusion.diffusion.checkpoint import file_hash, read_card, save_checkpoint
from primdiffusion.diffusion.codec import VALUES
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.schedule import schedule_name
from primdiffusion.people.stored_people import PersonFolder
from primdiffusion.runtime.device import device_info
from primdiffusion.training import loop
from primdiffusion.training.cells import CellTask, load_base, prepare
from primdiffusion.training.config import TrainingConfig
from primdiffusion.training.diffusion_task import SlabTask
from primdiffusion.training.latents import split_people
from primdiffusion.training.run_folder import begin, open_run, versions
from primdiffusion.training.state import TrainingState
from primdiffusion.version import __version__

MODEL = "model.safetensors"
CLOSED_FORM = ("closed_form_geometries", "closed_form_people")
"""Entries of a card on the people of a closed form that is not that of the training data."""
DATA = "humans dressed from MakeHuman's CC0 assets, in T pose, as primitives fitted to renders of their meshes"
LIMITS = (
    "The humans are adults from MakeHuman's bodies, in their assets' outfits, shoes and hair styles, with colours and "
    "patterns drawn at random: no robes, uniforms, beards, glasses, wheelchairs or children.",
    "Frills at the collar are soft, hems of long skirts are uneven, and there are few prints.",
    "Body shapes are drawn from a Gaussian given the person; they suit the clothes on average only.",
)
"""Limits of a model trained on such humans; stated on its card."""
CODEC_LIMIT = (
    "A voxel is 6 to 17 mm wide and the codec keeps {channels} of {values} numbers: fine stripes, prints and eyelashes "
    "are soft."
)
DISTANCE_LIMIT = (
    "Made for medium and far shots: a voxel of the head is 8 mm wide, which is a pixel at 20 m from a lens of 50 mm "
    "(36 mm sensor, 1920 pixels across) and four at 5 m. Nearer than that, faces look soft."
)


def train(config: TrainingConfig) -> DiffusionModel:
    """Run or resume a training run; returns the model as trained so far, which is also in run/model.safetensors.

    Under `accelerate launch` each process trains on its own batches, and gradients are averaged. Ctrl-C and SIGTERM
    stop after the current step and save.

    Raises:
        ValueError: invalid settings, or settings or people other than those the run in this folder began with; people
            of different full densities; a loss or gradient that is not finite; out of memory; a
            damaged file (FileError among them).
        FileNotFoundError: there are fewer than two people.
        MissingPackageError: the tracker's package is not installed.
        OSError: the disk is full; the last saved state remains.
    """
    with open_run(config) as accelerator:
        people = PersonFolder(config.data)
        chosen, held = split_people(range(len(people.names)), config.holdout, config.seed)
        with accelerator.main_process_first():
            if accelerator.is_main_process:
                unseen = {"held": [people.names[index] for index in held]}
                begin(config, people.names, unseen, accelerator.num_processes)
            task = _task(config, people, chosen, held, accelerator.device)
        state = loop.train(task, config, accelerator)
        model = task.model()
        if accelerator.is_main_process:
            schedule = schedule_name(model.schedule)
            card = _card(config, people, chosen, held, task, state) | {"schedule": schedule}
            model = dataclasses.replace(model, card=card)
            save_checkpoint(config.run / MODEL, model, schedule)
        return model


def _task(
    config: TrainingConfig, people: PersonFolder, chosen: Sequence[int], held: Sequence[int], device: torch.device
) -> CellTask | SlabTask:
    if config.preset == "paper":
        return SlabTask(config, people, chosen, held, device)
    base = None if config.start_from is None else load_base(config.start_from)
    return CellTask(config, prepare(config, people, chosen, held, base), device, base)


def _card(
    config: TrainingConfig,
    people: PersonFolder,
    chosen: Sequence[int],
    held: Sequence[int],
    task: CellTask | SlabTask,
    state: TrainingState,
) -> dict[str, Any]:
    """The model card: data, settings and held-out errors."""
    card = {
        "name": f"PrimDiffusion {config.preset}",
        "version": __version__,
        "preset": config.preset,
        "geometries": len(chosen),
        "people": sum(people.variants[index] for index in chosen),
        "held_out_geometries": len(held),
        "full_density": people.full_density,
        "seed": config.seed,
        "device": "CPU" if task.device.type == "cpu" else device_info(task.device)["device_name"],
        **versions(),
        "steps": {task.name: state.step},
        "seconds": {task.name: round(state.seconds, 1)},
        "batch": {task.name: task.settings.batch * state.accelerator.num_processes},
        "parameters": sum(parameter.numel() for parameter in state.network.parameters()),
    }
    if config.start_from is not None:
        start = read_card(config.start_from)
        card |= {"started_from": file_hash(config.start_from)} | {k: start[k] for k in CLOSED_FORM if k in start}
    if config.made_of == "makehuman":
        card |= {"licence": "CC0-1.0", "data": DATA, "limits": _limits(config)}
    if isinstance(task, SlabTask):
        return {**card, "held_out_rms_x0_error": _rounded({"denoiser": task.errors()})}
    errors = task.errors_beside_closed_forms()
    better = all(errors["denoiser"][level] < errors["gaussian"][level] for level in errors["gaussian"])
    return {**card, "held_out_rms_x0_error": _rounded(errors), "beats_gaussian_at_every_level": better}


def _limits(config: TrainingConfig) -> list[str]:
    codec = CODEC_LIMIT.format(channels=config.codec.channels, values=VALUES)
    return [*LIMITS, codec, DISTANCE_LIMIT] if config.preset == "default" else list(LIMITS)


def _rounded(errors: Mapping[str, Mapping[int, float]]) -> dict[str, dict[str, float]]:
    return {name: {str(level): round(e, 5) for level, e in by.items()} for name, by in errors.items()}


def run(arguments: Sequence[str] | None = None) -> None:
    """Parse a command line, train, and print the path of the model. Raises as `train` does."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    config = tyro.cli(TrainingConfig, args=arguments, prog="primdiffusion train")
    model = train(config)
    if PartialState().is_main_process:
        (steps,) = model.card["steps"].values()
        print(f"{config.run / MODEL}  {steps} steps")


if __name__ == "__main__":
    run()
