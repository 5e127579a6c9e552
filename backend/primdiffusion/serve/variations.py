"""Many people at once, small, to choose from: of noise, or variants of one person."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.samplers import Step
from primdiffusion.editing.edit import with_payload
from primdiffusion.editing.vary import vary_batch
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

    All are sampled in one batch, and their pictures become clearer with the steps, as far as time allows (`Allowance`).
    Each picture is reported as it appears, with the seed's index. Raises OSError before any work if the folder cannot
    be written to; what load_checkpoint, generate_batch, load_human and vary_batch raise.
    """
    began = time.perf_counter()
    out, count = Path(params.out_dir), len(params.seeds)
    with staged(out) as folder:
        report("load", 0, params.steps, None)
        model = load_model(params.checkpoint)
        report("sample", 0, params.steps, None)
        for index, human in enumerate(_people(model, params, folder, report)):
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


def _people(model: DiffusionModel, params: VariationsParams, folder: Path, report: Report) -> list[Human]:
    """New people, or variants of one, in one batch, with pictures of what they are so far, each in turn."""
    seeds, person = params.seeds, None if params.person is None else load_human(params.person)
    pace, allowance, turns = Pace(), Allowance(INTERVAL_S / len(seeds)), itertools.cycle(range(len(seeds)))

    def guess(x0: Tensor, seed: int) -> Human:
        if person is None:
            return people_of(model, x0, [seed], params.attributes)[0]
        return with_payload(model, person, x0)

    def on_step(step: Step) -> None:
        done = step.index + 1
        left = pace.left(done, step.total)
        report("sample", done, step.total, left)
        for _ in seeds:
            if done == step.total or not allowance.granted():
                return
            index = next(turns)
            with allowance.spending():
                path = passing.next()
                draw_front_and_back(path, guess(step.x0[index : index + 1], seeds[index]), params.size)
            report("sample", done, step.total, left, picture=str(path), index=index)

    with PassingPictures(folder, 2 * len(seeds)) as passing:
        asked = (params.attributes, params.guidance)
        if person is None:
            return generate_batch(model, seeds, params.steps, params.sampler, on_step, *asked)
        return vary_batch(model, person, params.amount, seeds, params.steps, on_step, *asked)
