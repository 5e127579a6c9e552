"""Generate humans: `generate` and `variations`."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from primdiffusion.commands.output import (
    FILES,
    INTERVAL_S,
    PreviewBudget,
    PreviewFiles,
    draw_front_and_back,
    skips_previews,
    step_previews,
    variation_files,
    write_files,
    write_human,
)
from primdiffusion.commands.progress import EtaEstimator, ReportProgress, step_reporter
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.model import DiffusionModel, warnings_of
from primdiffusion.diffusion.samplers import RELEASED_END, SamplerStep
from primdiffusion.diffusion.schedule import CLEAN
from primdiffusion.editing.edit import with_payload
from primdiffusion.editing.vary import vary_batch
from primdiffusion.files.regular_files import check_unlinked
from primdiffusion.files.whole_files import atomic_folder
from primdiffusion.formats.answers import HumanAnswer, VariationsAnswer
from primdiffusion.formats.requests import GenerateRequest, VariationsRequest
from primdiffusion.human import Human, decode_humans, generate_batch
from primdiffusion.human_file import load_human


def generate(request: GenerateRequest, session: Session, report: ReportProgress) -> HumanAnswer:
    """Sample batch by batch, and write the files of each human, all or none; return those of the last one.

    The humans before it are reported when they are finished. Raises OSError first of all if a folder cannot be written
    to; raises as load_checkpoint and generate_batch.
    """
    seeds, answer = range(request.seed, request.seed + request.count), None
    for first in seeds[:: request.batch]:
        batch = list(range(first, min(first + request.batch, seeds.stop)))
        for answer in _generate_batch(request, batch, session, report):
            if answer.seed != seeds[-1]:
                report("write", request.steps, request.steps, None, human=answer)
    assert answer is not None, "count is 1 or more"
    return answer


def _generate_batch(
    request: GenerateRequest, seeds: Sequence[int], session: Session, report: ReportProgress
) -> list[HumanAnswer]:
    began, steps, folders = time.perf_counter(), request.steps, [request.out_dir]
    if request.count > 1:
        folders = [request.out_dir / f"seed_{seed:06d}" for seed in seeds]
        for folder in folders:
            check_unlinked(folder)
    with contextlib.ExitStack() as files:
        unfinished = [files.enter_context(atomic_folder(folder)) for folder in folders]
        report("load", 0, steps, None)
        model = session.model(request.checkpoint)
        report("sample", 0, steps, None)

        def decode(x0: Tensor) -> Human:
            return decode_humans(model, x0[:1], seeds[:1], request.attributes)[0]

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
        report("write", steps, steps, None)
        drawn = not skips_previews(request.picture_px)
        looks = {"compact": request.compact, "compositing": request.compositing, "previews": drawn}
        for folder, human in zip(unfinished, humans, strict=True):
            write_human(folder, human, request.size, **looks)
        report("write", steps, steps, 0.0)  # the last chance to cancel
    seconds = (time.perf_counter() - began) / len(seeds)
    return [
        HumanAnswer(
            **FILES.in_folder(folder, previews=drawn),
            warnings=[f"seed {seed}: {text}" if request.count > 1 else text for text in warnings_of(human.provenance)],
            seed=seed,
            steps=steps,
            seconds=round(seconds, 3),
        )
        for seed, folder, human in zip(seeds, folders, humans, strict=True)
    ]


def variations(request: VariationsRequest, session: Session, report: ReportProgress) -> VariationsAnswer:
    """Write the files of all seeds, or none; return their paths and the time taken.

    Previews sharpen as sampling proceeds, as time allows (`PreviewBudget`); each is reported with the index of its
    seed. Raises OSError first of all if the folder cannot be written to; raises as load_checkpoint, generate_batch,
    load_human and vary_batch.
    """
    began, warnings = time.perf_counter(), []
    with atomic_folder(request.out_dir) as folder:
        report("load", 0, request.steps, None)
        model = session.model(request.checkpoint)
        report("sample", 0, request.steps, None)
        for index, human in enumerate(_sample_variations(model, request, folder, report)):
            files = variation_files(folder, request.seeds[index])
            write_files(files.person, human)
            draw_front_and_back(files.picture, human, request.size)
            report("write", index + 1, len(request.seeds), None, picture=files.picture, index=index)
            made = human.provenance if request.person is None else human.provenance["edits"][-1]
            warnings += [f"seed {request.seeds[index]}: {warning}" for warning in warnings_of(made)]
    return VariationsAnswer(
        people=[variation_files(request.out_dir, seed) for seed in request.seeds],
        warnings=warnings,
        seconds=round(time.perf_counter() - began, 3),
    )


def _sample_variations(
    model: DiffusionModel, request: VariationsRequest, folder: Path, report: ReportProgress
) -> list[Human]:
    """Sample the batch, and preview its humans in turn."""
    seeds, person = request.seeds, None if request.person is None else load_human(request.person)
    pace, budget, turns = EtaEstimator(), PreviewBudget(INTERVAL_S / len(seeds)), itertools.cycle(range(len(seeds)))

    def decode(x0: Tensor, seed: int) -> Human:
        if person is None:
            return decode_humans(model, x0, [seed], request.attributes)[0]
        return with_payload(model, person, x0)

    def on_step(step: SamplerStep) -> None:
        done = step.index + 1
        left = pace.left(done, step.total)
        report("sample", done, step.total, left)
        for _ in seeds:
            if done == step.total or not budget.allows():
                return
            index = next(turns)
            with budget.measure():
                path = previews.next()
                draw_front_and_back(path, decode(step.x0[index : index + 1], seeds[index]), request.size)
            report("sample", done, step.total, left, picture=path, index=index)

    with PreviewFiles(folder, 2 * len(seeds)) as previews:
        conditioning = (request.attributes, request.guidance)
        if person is None:
            return generate_batch(model, seeds, request.steps, request.sampler, on_step, *conditioning)
        return vary_batch(model, person, request.amount, seeds, request.steps, on_step, *conditioning)
