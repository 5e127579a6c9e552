"""Generate people: `primdiffusion generate`, and `generate` of JSON-RPC."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from primdiffusion.commands.checks import (
    check_attributes,
    check_picture_px,
    check_seed,
    check_size,
    check_steps,
)
from primdiffusion.commands.progress import Report, progress_bar, step_reporter
from primdiffusion.commands.request import Attributes, OutDir, parse
from primdiffusion.formats import requests

if TYPE_CHECKING:
    from torch import Tensor

    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human


@dataclasses.dataclass(frozen=True, kw_only=True)
class GenerateRequest:
    """Generate a person: human.npz for Blender, person.human.safetensors to keep, and pictures."""

    seed: int
    """Which person: the same seed gives the same one."""
    out_dir: OutDir
    """Folder to write to; made if missing."""
    steps: int = requests.STEPS
    """Sampler steps, 1 to 1000."""
    sampler: requests.Sampler = requests.SAMPLERS[0]
    """ddim: few steps; dpmpp_2m: fewer still; ddpm: the paper's, wants hundreds."""
    attributes: Attributes = dataclasses.field(default_factory=dict)
    """What the people shall be, NAME=VALUE: sex=female "outfit=blouse and skirt" height=1.7; by default anybody. `info`
    lists the names and values that a checkpoint knows."""
    guidance: float = requests.GUIDANCE
    """How strongly attributes are followed: 1 plainly, more at the cost of variety."""
    checkpoint: Path | None = None
    """Trained model (.safetensors); without it the one that comes with the package."""
    size: int = requests.PICTURE_SIZE
    """Pixels a side of the pictures."""
    picture_px: tyro.conf.Suppress[int] = 0
    """Pixels a side of the pictures while the person is sampled; 0 for none."""

    def check(self) -> None:
        """See `Request`."""
        check_seed(self.seed)
        check_steps(self.steps)
        check_size(self.size)
        check_picture_px(self.picture_px)
        check_attributes(self.attributes, self.guidance)

    def run(self, session: Session, report: Report) -> dict[str, Any]:
        """Writes the person, all files or none. Raises OSError before any work if the folder cannot be written to."""
        # torch is loaded late
        from primdiffusion.machine import peak_memory_gb
        from primdiffusion.person_folder import FILES

        began = time.perf_counter()
        sampled = generate_people(self, {self.seed: self.out_dir}, session, report)
        return {
            **FILES.in_folder(self.out_dir),
            "seed": self.seed,
            "steps": self.steps,
            "seconds": round(time.perf_counter() - began, 3),
            "seconds_sampling": round(sampled - began, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }


def generate_people(request: GenerateRequest, folders: dict[int, Path], session: Session, report: Report) -> float:
    """Samples the people of the seeds in one batch and writes each to its folder, all of them or none.

    Returns the time on the clock when they were sampled. Raises what load_checkpoint and generate_batch do, OSError.
    """
    # torch is loaded late
    from primdiffusion.commands.step_pictures import step_pictures
    from primdiffusion.human import generate_batch, people_of
    from primdiffusion.person_folder import write_person
    from primdiffusion.staging import staged

    seeds, steps = list(folders), request.steps
    with contextlib.ExitStack() as files:
        unfinished = [files.enter_context(staged(folder)) for folder in folders.values()]
        report("load", 0, steps, None)
        model = session.model(request.checkpoint)
        report("sample", 0, steps, None)

        def show(x0: Tensor) -> Human:
            return people_of(model, x0[:1], seeds[:1], request.attributes)[0]

        with step_pictures(unfinished[0], request.picture_px, show) as picture:
            on_step = step_reporter(report, picture)
            people = generate_batch(model, seeds, steps, request.sampler, on_step, request.attributes, request.guidance)
        sampled = time.perf_counter()
        report("write", steps, steps, None)
        for folder, human in zip(unfinished, people, strict=True):
            write_person(folder, human, request.size)
        report("write", steps, steps, 0.0)  # the last chance to cancel
    return sampled


@dataclasses.dataclass(frozen=True, kw_only=True)
class GenerateCommand(GenerateRequest):
    """Generate people: human.npz for Blender, person.human.safetensors to keep, and pictures."""

    out_dir: OutDir
    """Folder to write to; with --count above 1, a folder for each person in it."""
    seed: int = 0
    """Which person: the same seed gives the same one."""
    count: int = 1
    """How many people, with seeds following on each other."""
    batch: int = 1
    """People that are sampled at once: faster, most of all on a graphics card, and takes more memory. Numbers then
    differ in the last digits from those of people made alone."""

    def check(self) -> None:
        """See `Request`."""
        super().check()
        for name in ("count", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: ask for one person or more")

    def generate(self, session: Session) -> None:
        """Generates batch by batch, and prints the folder of each person."""
        end = self.seed + self.count
        for first in range(self.seed, end, self.batch):
            began, seeds = time.perf_counter(), range(first, min(first + self.batch, end))
            folders = {seed: self.out_dir if self.count == 1 else self.out_dir / f"seed_{seed:06d}" for seed in seeds}
            with progress_bar(f"seed {', '.join(map(str, seeds))}") as report:
                generate_people(self, folders, session, report)
            seconds = (time.perf_counter() - began) / len(seeds)
            for seed, folder in folders.items():
                print(f"{folder}  seed {seed}, {self.steps} steps, {seconds:.1f} s")


def run(arguments: Sequence[str]) -> None:
    """One command line, errors as exceptions."""
    command = parse(GenerateCommand, arguments, "generate")
    from primdiffusion.commands.session import Session  # loads torch, which --help does not need

    command.generate(Session())
