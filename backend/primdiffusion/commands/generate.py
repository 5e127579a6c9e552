"""Generate humans: `primdiffusion generate`, and `generate` and `variations` of JSON-RPC."""

from __future__ import annotations

import contextlib
import itertools
import time
from pathlib import Path

from torch import Tensor

from primdiffusion.commands.options import GenerateCommand
from primdiffusion.commands.output import (
    FILES,
    INTERVAL_S,
    PreviewBudget,
    PreviewFiles,
    draw_front_and_back,
    step_previews,
    write_files,
    write_human,
)
from primdiffusion.commands.progress import Pace, ReportProgress, print_warnings, progress_bar, step_reporter
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.reading import warnings_of
from primdiffusion.diffusion.samplers import RELEASED_END, SamplerStep
from primdiffusion.diffusion.schedule import CLEAN
from primdiffusion.editing.edit import with_payload
from primdiffusion.editing.vary import vary_batch
from primdiffusion.files.regular_files import check_unlinked
from primdiffusion.files.whole_files import staged, staged_together
from primdiffusion.formats.answers import HumanAnswer, VariationFiles, VariationsAnswer
from primdiffusion.formats.requests import GenerateRequest, VariationsRequest
from primdiffusion.human import Human, generate_batch, people_of
from primdiffusion.human_file import load_human
from primdiffusion.runtime.machine import peak_memory_gb


def generate(request: GenerateRequest, session: Session, report: ReportProgress) -> HumanAnswer:
    """Write all files or none. Raises OSError first of all if the folder cannot be written to."""
    began = time.perf_counter()
    (human,), sampled = generate_humans(request, {request.seed: request.out_dir}, session, report)
    return HumanAnswer(
        **FILES.in_folder(request.out_dir),
        warnings=warnings_of(human.provenance),
        seed=request.seed,
        steps=request.steps,
        seconds=round(time.perf_counter() - began, 3),
        seconds_sampling=round(sampled - began, 3),
        peak_gb=round(peak_memory_gb(), 3),
    )


def generate_humans(
    request: GenerateRequest,
    folders: dict[int, Path],
    session: Session,
    report: ReportProgress,
    *,
    compact: bool = False,
) -> tuple[list[Human], float]:
    """Sample a human for each seed as one batch and write each to its folder, all of them or none; see `save_human`.

    Returns them, and the time (of `perf_counter`) when sampling ended. Raises as load_checkpoint and generate_batch,
    and OSError.
    """
    seeds, steps = list(folders), request.steps
    with contextlib.ExitStack() as files:
        unfinished = files.enter_context(staged_together(list(folders.values())))
        report("load", 0, steps, None)
        model = session.model(request.checkpoint)
        report("sample", 0, steps, None)

        def decode(x0: Tensor) -> Human:
            return people_of(model, x0[:1], seeds[:1], request.attributes)[0]

        released = request.compositing == "released" and request.sampler == "ddim"
        with step_previews(unfinished[0], request.picture_px, decode, request.compositing) as preview:
            on_step = step_reporter(report, preview)
            humans = generate_batch(
                model,
                seeds,
                steps,
                request.sampler,
                on_step,
                request.attributes,
                request.guidance,
                RELEASED_END if released else CLEAN,
            )
        sampled = time.perf_counter()
        report("write", steps, steps, None)
        for folder, human in zip(unfinished, humans, strict=True):
            write_human(folder, human, request.size, compact=compact, compositing=request.compositing)
        report("write", steps, steps, 0.0)  # the last chance to cancel
    return humans, sampled


def run(command: GenerateCommand) -> None:
    """Generate batch by batch; print the folder of each human."""
    session, end = Session(), command.seed + command.count
    for first in range(command.seed, end, command.batch):
        began, seeds = time.perf_counter(), range(first, min(first + command.batch, end))
        folders = {
            seed: command.out_dir if command.count == 1 else command.out_dir / f"seed_{seed:06d}" for seed in seeds
        }
        for folder in folders.values() if command.count > 1 else ():
            check_unlinked(folder)
        with progress_bar(f"seed {', '.join(map(str, seeds))}") as report:
            humans, _ = generate_humans(command, folders, session, report, compact=command.compact)
        seconds = (time.perf_counter() - began) / len(seeds)
        for (seed, folder), human in zip(folders.items(), humans, strict=True):
            print(f"{folder}  seed {seed}, {command.steps} steps, {seconds:.1f} s")
            print_warnings(f"seed {seed}: {warning}" for warning in warnings_of(human.provenance))


def variations(request: VariationsRequest, session: Session, report: ReportProgress) -> VariationsAnswer:
    """Write the files of all seeds, or none; return their paths and the time taken.

    Previews sharpen as sampling proceeds, as time allows (`PreviewBudget`); each is reported with the index of its
    seed. Raises OSError first of all if the folder cannot be written to; raises as load_checkpoint, generate_batch,
    load_human and vary_batch.
    """
    began, warnings = time.perf_counter(), []
    with staged(request.out_dir) as folder:
        report("load", 0, request.steps, None)
        model = session.model(request.checkpoint)
        report("sample", 0, request.steps, None)
        for index, human in enumerate(_sample_variations(model, request, folder, report)):
            files = _files(folder, request.seeds[index])
            write_files(files.person, human)
            draw_front_and_back(files.picture, human, request.size)
            report("write", index + 1, len(request.seeds), None, picture=files.picture, index=index)
            made = human.provenance if request.person is None else human.provenance["edits"][-1]
            warnings += [f"seed {request.seeds[index]}: {warning}" for warning in warnings_of(made)]
    return VariationsAnswer(
        people=[_files(request.out_dir, seed) for seed in request.seeds],
        warnings=warnings,
        seconds=round(time.perf_counter() - began, 3),
        peak_gb=round(peak_memory_gb(), 3),
    )


def _files(folder: Path, seed: int) -> VariationFiles:
    return VariationFiles(
        seed=seed,
        person=folder / f"{seed}.human.safetensors",
        picture=folder / f"{seed}.png",
    )


def _sample_variations(
    model: DiffusionModel, request: VariationsRequest, folder: Path, report: ReportProgress
) -> list[Human]:
    """Sample the batch, and preview its humans in turn."""
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
            report("sample", done, step.total, left, picture=path, index=index)

    with PreviewFiles(folder, 2 * len(seeds)) as previews:
        conditioning = (request.attributes, request.guidance)
        if person is None:
            return generate_batch(model, seeds, request.steps, request.sampler, on_step, *conditioning)
        return vary_batch(model, person, request.amount, seeds, request.steps, on_step, *conditioning)
