"""Many people at once, small, to choose from: of noise, or variants of one person."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.samplers import Step
from primdiffusion.editing.vary import vary
from primdiffusion.human import Human, generate_batch, people_of
from primdiffusion.human_file import export_for_blender, load_human, save_human
from primdiffusion.machine import peak_memory_gb
from primdiffusion.serve.progress import Pace, Report
from primdiffusion.serve.step_pictures import INTERVAL_S, Allowance, PassingPictures, draw_front_and_back
from primdiffusion.serve.variation_params import VariationsParams
from primdiffusion.staging import staged

LoadModel = Callable[[str | None], DiffusionModel]


def variations(load_model: LoadModel, params: VariationsParams, report: Report) -> dict[str, Any]:
    """The people of all seeds in `out_dir`, or none of them; returns their paths and what it took.

    New people are sampled in one batch, and their pictures become clearer with the steps, as far as time allows
    (`Allowance`); variants of a person are made one after the other. Each picture is reported as it appears, with the
    seed's index. Raises OSError before any work if the folder cannot be written to; what load_checkpoint,
    generate_batch, load_human and vary raise.
    """
    began = time.perf_counter()
    out, count = Path(params.out_dir), len(params.seeds)
    with staged(out) as folder:
        report("load", 0, params.steps, None)
        model = load_model(params.checkpoint)
        report("sample", 0, params.steps, None)
        people = _new(model, params, folder, report) if params.person is None else _around(model, params, report)
        for index, human in people:
            files = _files(folder, params.seeds[index])
            export_for_blender(files["human"], human)
            save_human(files["person"], human)
            draw_front_and_back(Path(files["picture"]), human, params.size)
            report("write", index + 1, count, None, picture=files["picture"], index=index)
    return {
        "people": [{"seed": seed, **_files(out, seed)} for seed in params.seeds],
        "seconds": round(time.perf_counter() - began, 3),
        "peak_gb": round(peak_memory_gb(), 3),
    }


def _files(folder: Path, seed: int) -> dict[str, str]:
    endings = {"human": "human.npz", "person": "human.safetensors", "picture": "png"}
    return {name: str(folder / f"{seed}.{ending}") for name, ending in endings.items()}


def _new(model: DiffusionModel, params: VariationsParams, folder: Path, report: Report) -> Iterator[tuple[int, Human]]:
    """People of noise, with pictures of what they are so far, each in turn."""
    seeds = params.seeds
    pace, allowance, turns = Pace(), Allowance(INTERVAL_S / len(seeds)), itertools.cycle(range(len(seeds)))

    def on_step(step: Step) -> None:
        done = step.index + 1
        left = pace.left(done, step.total)
        report("sample", done, step.total, left)
        for _ in seeds:
            if done == step.total or not allowance.granted():
                return
            index = next(turns)
            with allowance.spending():
                (guess,) = people_of(model, step.x0[index : index + 1], [seeds[index]], params.attributes)
                path = passing.next()
                draw_front_and_back(path, guess, params.size)
            report("sample", done, step.total, left, picture=str(path), index=index)

    with PassingPictures(folder, 2 * len(seeds)) as passing:
        people = generate_batch(model, seeds, params.steps, params.sampler, on_step, params.attributes, params.guidance)
    yield from enumerate(people)


def _around(model: DiffusionModel, params: VariationsParams, report: Report) -> Iterator[tuple[int, Human]]:
    """Variants of a person."""
    person, pace, count = load_human(str(params.person)), Pace(), len(params.seeds)
    for index, seed in enumerate(params.seeds):

        def on_step(step: Step, index: int = index) -> None:
            done, total = index * step.total + step.index + 1, count * step.total
            report("sample", done, total, pace.left(done, total))

        yield index, vary(model, person, params.amount, seed, params.steps, on_step, params.attributes, params.guidance)
