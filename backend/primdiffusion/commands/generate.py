"""Generate humans: `primdiffusion generate`, and `generate` and `variations` of JSON-RPC."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from primdiffusion.commands.request import (
    Attributes,
    OutDir,
    Pace,
    ReportProgress,
    check_attributes,
    check_picture_px,
    check_size,
    check_steps,
    parse,
    progress_bar,
    step_reporter,
)
from primdiffusion.formats import requests
from primdiffusion.formats.removing import check_unlinked
from primdiffusion.formats.requests import check_seed, check_unit_interval
from primdiffusion.formats.whole_files import staged, staged_together
from primdiffusion.machine import peak_memory_gb

if TYPE_CHECKING:
    from torch import Tensor

    from primdiffusion.commands.session import Session
    from primdiffusion.diffusion.model import DiffusionModel
    from primdiffusion.diffusion.samplers import SamplerStep
    from primdiffusion.human import Human

MOST_VARIATIONS = 64
"""They are sampled as one batch: memory grows with their number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GenerateRequest:
    """Generate a human: human.npz for Blender, person.human.safetensors, and previews."""

    seed: int
    """The same seed gives the same human."""
    out_dir: OutDir
    """Output folder; created if missing."""
    steps: int = requests.STEPS
    """Sampler steps, 1 to 1000."""
    sampler: requests.Sampler = requests.SAMPLERS[0]
    """ddim: few steps; dpmpp_2m: even fewer; ddpm: the paper's, needs hundreds."""
    attributes: Attributes = dataclasses.field(default_factory=dict)
    """Attributes, NAME=VALUE: sex=female "outfit=blouse and skirt" height=1.7; the default is none. `info` lists the
    names and values that a checkpoint knows."""
    guidance: float = requests.GUIDANCE
    """How closely attributes are followed; 1 is plain conditioning, more costs variety."""
    checkpoint: Path | None = None
    """Trained model (.safetensors); the default is the one in the package."""
    size: int = requests.PICTURE_SIZE
    """Width and height of the previews, pixels."""
    picture_px: tyro.conf.Suppress[int] = 0
    """Width and height of previews while sampling, pixels; 0 for none."""

    def check(self) -> None:
        """See `RequestRecord`."""
        check_seed(self.seed)
        check_steps(self.steps)
        check_size(self.size)
        check_picture_px(self.picture_px)
        check_attributes(self.attributes, self.guidance)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Write all files or none. Raises OSError first of all if the folder cannot be written to."""
        from primdiffusion.commands.output import FILES  # torch is loaded late

        began = time.perf_counter()
        sampled = generate_humans(self, {self.seed: self.out_dir}, session, report)
        return {
            **FILES.in_folder(self.out_dir),
            "seed": self.seed,
            "steps": self.steps,
            "seconds": round(time.perf_counter() - began, 3),
            "seconds_sampling": round(sampled - began, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }


def generate_humans(
    request: GenerateRequest,
    folders: dict[int, Path],
    session: Session,
    report: ReportProgress,
    *,
    compact: bool = False,
) -> float:
    """Sample a human for each seed as one batch and write each to its folder, all of them or none; see `save_human`.

    Returns the time (of `perf_counter`) when sampling ended. Raises as load_checkpoint and generate_batch, and OSError.
    """
    # torch is loaded late
    from primdiffusion.commands.output import step_previews, write_human
    from primdiffusion.human import generate_batch, people_of

    seeds, steps = list(folders), request.steps
    with contextlib.ExitStack() as files:
        unfinished = files.enter_context(staged_together(list(folders.values())))
        report("load", 0, steps, None)
        model = session.model(request.checkpoint)
        report("sample", 0, steps, None)

        def decode(x0: Tensor) -> Human:
            return people_of(model, x0[:1], seeds[:1], request.attributes)[0]

        with step_previews(unfinished[0], request.picture_px, decode) as preview:
            on_step = step_reporter(report, preview)
            humans = generate_batch(model, seeds, steps, request.sampler, on_step, request.attributes, request.guidance)
        sampled = time.perf_counter()
        report("write", steps, steps, None)
        for folder, human in zip(unfinished, humans, strict=True):
            write_human(folder, human, request.size, compact=compact)
        report("write", steps, steps, 0.0)  # the last chance to cancel
    return sampled


@dataclasses.dataclass(frozen=True, kw_only=True)
class GenerateCommand(GenerateRequest):
    """Generate humans: human.npz for Blender, person.human.safetensors, and previews."""

    out_dir: OutDir
    """Output folder; with --count above 1, of a folder for each human."""
    seed: int = 0
    """The same seed gives the same human."""
    count: int = 1
    """Number of humans, with consecutive seeds."""
    batch: int = 1
    """Humans sampled at once: faster, above all on a GPU, and needs more memory. Results differ from those of single
    humans in the last digits."""
    compact: bool = False
    """Store colours and densities of person.human.safetensors in 8 bits: 2 MB instead of 8, without visible loss."""

    def check(self) -> None:
        """See `RequestRecord`."""
        super().check()
        for name in ("count", "batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: choose 1 or more")
        check_seed(self.seed + self.count - 1)

    def generate(self, session: Session) -> None:
        """Generate batch by batch; print the folder of each human."""
        end = self.seed + self.count
        for first in range(self.seed, end, self.batch):
            began, seeds = time.perf_counter(), range(first, min(first + self.batch, end))
            folders = {seed: self.out_dir if self.count == 1 else self.out_dir / f"seed_{seed:06d}" for seed in seeds}
            for folder in folders.values() if self.count > 1 else ():
                check_unlinked(folder)
            with progress_bar(f"seed {', '.join(map(str, seeds))}") as report:
                generate_humans(self, folders, session, report, compact=self.compact)
            seconds = (time.perf_counter() - began) / len(seeds)
            for seed, folder in folders.items():
                print(f"{folder}  seed {seed}, {self.steps} steps, {seconds:.1f} s")


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    command = parse(GenerateCommand, arguments, "generate")
    from primdiffusion.commands.session import Session  # loads torch, which --help does not need

    command.generate(Session())


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariationsRequest:
    """Generate several humans, or variants of one, as one batch, each with a preview to choose by."""

    seeds: list[int]
    """All different."""
    out_dir: Path
    """Output folder, created if missing, for SEED.human.npz, SEED.human.safetensors and SEED.png of each."""
    steps: int = requests.STEPS
    sampler: requests.Sampler = requests.SAMPLERS[0]
    checkpoint: Path | None = None
    """Trained model (.safetensors); the default is the one in the package."""
    size: int = requests.VARIATION_SIZE
    """Width and height of the previews, pixels."""
    attributes: dict[str, str | float] = dataclasses.field(default_factory=dict)
    guidance: float = requests.GUIDANCE
    person: Path | None = None
    """A .human.safetensors file: generate variants of this human, as `vary` does, instead of new humans."""
    amount: float = requests.AMOUNT
    """Strength of the variation, as in `vary`."""

    def check(self) -> None:
        """See `RequestRecord`."""
        if not 1 <= len(self.seeds) <= MOST_VARIATIONS:
            raise ValueError(f"{len(self.seeds)} seeds were given: choose 1 to {MOST_VARIATIONS}")
        for seed in self.seeds:
            check_seed(seed)
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError("two of the seeds are equal: give each once")
        check_steps(self.steps)
        check_picture_px(self.size)
        if self.size < 2:
            raise ValueError(f"size is {self.size} pixels: choose 2 or more")
        check_attributes(self.attributes, self.guidance)
        check_unit_interval("amount", self.amount)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Write the files of all seeds, or none; return their paths and the time taken.

        Previews sharpen as sampling proceeds, as time allows (`PreviewBudget`); each is reported with the index of its
        seed. Raises OSError first of all if the folder cannot be written to; raises as load_checkpoint, generate_batch,
        load_human and vary_batch.
        """
        # torch is loaded late
        from primdiffusion.commands.output import draw_front_and_back
        from primdiffusion.human_file import export_for_blender, save_human

        began = time.perf_counter()
        with staged(self.out_dir) as folder:
            report("load", 0, self.steps, None)
            model = session.model(self.checkpoint)
            report("sample", 0, self.steps, None)
            for index, human in enumerate(_sample_variations(model, self, folder, report)):
                files = _files(folder, self.seeds[index])
                export_for_blender(files["human"], human)
                save_human(files["person"], human)
                draw_front_and_back(Path(files["picture"]), human, self.size)
                report("write", index + 1, len(self.seeds), None, picture=files["picture"], index=index)
        return {
            "people": [{"seed": seed, **_files(self.out_dir, seed)} for seed in self.seeds],
            "seconds": round(time.perf_counter() - began, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }


def _files(folder: Path, seed: int) -> dict[str, str]:
    endings = {"human": "human.npz", "person": "human.safetensors", "picture": "png"}
    return {name: str(folder / f"{seed}.{ending}") for name, ending in endings.items()}


def _sample_variations(
    model: DiffusionModel, request: VariationsRequest, folder: Path, report: ReportProgress
) -> list[Human]:
    """Sample the batch, and preview its humans in turn."""
    # torch is loaded late
    from primdiffusion.commands.output import INTERVAL_S, PreviewBudget, PreviewFiles, draw_front_and_back
    from primdiffusion.editing.edit import with_payload
    from primdiffusion.editing.vary import vary_batch
    from primdiffusion.human import generate_batch, people_of
    from primdiffusion.human_file import load_human

    seeds, person = request.seeds, None if request.person is None else load_human(request.person)
    pace, budget, turns = Pace(), PreviewBudget(INTERVAL_S / len(seeds)), itertools.cycle(range(len(seeds)))

    def decode(x0: Tensor, seed: int) -> Human:
        if person is None:
            return people_of(model, x0, [seed], request.attributes)[0]
        return with_payload(model, person, x0)

    def on_step(step: SamplerStep) -> None:
        done = step.index + 1
        left = pace.left(done, step.total)
        report("sample", done, step.total, left)
        for _ in seeds:
            if done == step.total or not budget.granted():
                return
            index = next(turns)
            with budget.spending():
                path = previews.next()
                draw_front_and_back(path, decode(step.x0[index : index + 1], seeds[index]), request.size)
            report("sample", done, step.total, left, picture=str(path), index=index)

    with PreviewFiles(folder, 2 * len(seeds)) as previews:
        conditioning = (request.attributes, request.guidance)
        if person is None:
            return generate_batch(model, seeds, request.steps, request.sampler, on_step, *conditioning)
        return vary_batch(model, person, request.amount, seeds, request.steps, on_step, *conditioning)
