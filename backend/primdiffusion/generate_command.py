"""The command `primdiffusion generate`: people of seeds, and of what is asked for."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from primdiffusion.diffusion.samplers import Step


@dataclasses.dataclass(frozen=True)
class Generate:
    """Generate people: human.npz for Blender, person.human.safetensors to keep, and pictures."""

    out: Path
    """Folder to write to; with --count above 1, a folder for each person in it."""
    seed: int = 0
    """Which person: the same seed gives the same one."""
    steps: int = 30
    """Sampler steps, 1 to 1000."""
    sampler: Literal["ddim", "dpmpp_2m", "ddpm"] = "ddim"
    """ddim: few steps; dpmpp_2m: fewer still; ddpm: the paper's, wants hundreds."""
    attributes: tuple[str, ...] = ()
    """What the people shall be, NAME=VALUE: sex=female "outfit=blouse and skirt" height=1.7; by default anybody. `info`
    lists the names and values that a checkpoint knows."""
    guidance: float = 1.5
    """How strongly attributes are insisted on: 1 plainly, more at the cost of variety."""
    checkpoint: Path | None = None
    """Trained model (.safetensors); without it the one that comes with the package."""
    count: int = 1
    """How many people, with seeds following on each other."""
    batch: int = 1
    """People that are sampled at once: faster, most of all on a graphics card, and takes more memory. Numbers then
    differ in the last digits from those of people made alone."""
    size: int = 512
    """Pixels a side of the pictures."""

    def run(self) -> None:
        """Generates, and prints the folder of each person."""
        for name in ("count", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: ask for one person or more")
        from tqdm import tqdm

        from primdiffusion.checkpoints import load_checkpoint
        from primdiffusion.diffusion.conditioning import read_attributes
        from primdiffusion.human import generate_batch
        from primdiffusion.machine import best_device
        from primdiffusion.person_folder import write_person
        from primdiffusion.staging import staged

        model, attributes = None, read_attributes(self.attributes)
        end = self.seed + self.count
        for first in range(self.seed, end, self.batch):
            began, seeds = time.perf_counter(), range(first, min(first + self.batch, end))
            folders = [self.out if self.count == 1 else self.out / f"seed_{seed:06d}" for seed in seeds]
            with contextlib.ExitStack() as files:  # all people of a batch or none
                unfinished = [files.enter_context(staged(folder)) for folder in folders]
                model = load_checkpoint(self.checkpoint, best_device()) if model is None else model
                label = ", ".join(map(str, seeds))
                with tqdm(total=self.steps, desc=f"seed {label}", unit="step", disable=None) as bar:

                    def on_step(step: Step, bar: tqdm = bar) -> None:
                        bar.update()

                    people = generate_batch(model, seeds, self.steps, self.sampler, on_step, attributes, self.guidance)
                for folder, human in zip(unfinished, people, strict=True):
                    write_person(folder, human, self.size)
            seconds = (time.perf_counter() - began) / len(seeds)
            for folder, seed in zip(folders, seeds, strict=True):
                print(f"{folder}  seed {seed}, {self.steps} steps, {seconds:.1f} s")
