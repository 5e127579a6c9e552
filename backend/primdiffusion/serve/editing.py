"""The jobs that make a person of a person: vary, interpolate, inpaint, transfer."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.editing import inpaint, interpolate, transfer, vary
from primdiffusion.editing.edit import OnStep, combined, with_payload
from primdiffusion.editing.painted import read_weights
from primdiffusion.editing.regions import region_from_weights, region_of
from primdiffusion.human import Human
from primdiffusion.human_file import load_human
from primdiffusion.machine import peak_memory_gb
from primdiffusion.person_folder import FILES, write_person
from primdiffusion.serve.edit_params import EditParams, InpaintParams, InterpolateParams, TransferParams, VaryParams
from primdiffusion.serve.progress import Report, step_reporter
from primdiffusion.serve.step_pictures import Show, step_pictures
from primdiffusion.staging import staged

LoadModel = Callable[[str | None], DiffusionModel]


class Editor:
    """Edits with the models that `load_model` keeps."""

    def __init__(self, load_model: LoadModel) -> None:
        self._load_model = load_model

    def vary(self, params: VaryParams, report: Report) -> dict[str, Any]:
        """A neighbour of the person."""

        def edit(human: Human, folder: Path) -> Human:
            model = self._load_model(params.checkpoint)
            with _sampling(params, report, folder, lambda x0: with_payload(model, human, x0)) as on_step:
                return vary.vary(
                    model, human, params.amount, params.seed, params.steps, on_step, params.attributes, params.guidance
                )

        return _written(params, report, edit)

    def interpolate(self, params: InterpolateParams, report: Report) -> dict[str, Any]:
        """A person between two."""

        def edit(human: Human, folder: Path) -> Human:
            other = load_human(params.other)
            model = self._load_model(params.checkpoint)

            def show(x0: Tensor) -> Human | None:
                ends_and_between = len(x0) == 3  # two on the way from the people to their noises
                return with_payload(model, human, x0[2:]) if ends_and_between else None

            with _sampling(params, report, folder, show) as on_step:
                return interpolate.interpolate(model, human, other, params.fraction, params.steps, on_step)

        return _written(params, report, edit)

    def inpaint(self, params: InpaintParams, report: Report) -> dict[str, Any]:
        """The person with a region made anew."""

        def edit(human: Human, folder: Path) -> Human:
            region = _region(params.region, human)
            model = self._load_model(params.checkpoint)
            with _sampling(params, report, folder, lambda x0: _guess_inside(model, human, region, x0)) as on_step:
                return inpaint.inpaint(
                    model, human, region, params.seed, params.steps, params.attributes, params.guidance, on_step
                )

        return _written(params, report, edit)

    def transfer(self, params: TransferParams, report: Report) -> dict[str, Any]:
        """The person with another one's looks in a region. Loads a model only for harmonising."""

        def edit(human: Human, folder: Path) -> Human:
            source, region = load_human(params.source), _region(params.region, human)
            exchange = transfer.transfer_garment if params.what == "garment" else transfer.transfer_texture
            edited = exchange(source, human, region)
            if not params.harmonise:
                return edited
            model = self._load_model(params.checkpoint)
            with _sampling(params, report, folder, lambda x0: _guess_inside(model, edited, region, x0)) as on_step:
                return inpaint.harmonise(model, edited, region, params.harmonise, params.seed, params.steps, on_step)

        return _written(params, report, edit)


@contextlib.contextmanager
def _sampling(params: EditParams, report: Report, folder: Path, show: Show) -> Iterator[OnStep]:
    """What reports steps, with pictures in `folder` where these are asked for."""
    report("sample", 0, params.steps, None)
    with step_pictures(folder, params.picture_px, show) as picture:
        yield step_reporter(report, picture)


def _guess_inside(model: DiffusionModel, human: Human, region: Bool[Tensor, "k"], x0: Tensor) -> Human:
    """The person with what a guess stands for in a region."""
    guess = with_payload(model, human, x0)
    return dataclasses.replace(guess, payload=combined(region, guess.payload, human.payload))


def _region(region: list | dict, human: Human) -> Bool[Tensor, "k"]:
    if isinstance(region, dict):
        return region_from_weights(read_weights(region["weights"]), body_setup=human.body_setup)
    return region_of(region, human.body_setup)


def _written(params: EditParams, report: Report, edit: Callable[[Human, Path], Human]) -> dict[str, Any]:
    """Edits the person and writes the result to `out_dir`, all files or none; what generate returns of its own.

    Raises OSError before any work if the folder cannot be written to; what load_human, load_checkpoint and edits raise.
    """
    began = time.perf_counter()
    out = Path(params.out_dir)
    with staged(out) as folder:
        report("load", 0, params.steps, None)
        human = edit(load_human(params.person), folder)
        edited = time.perf_counter()
        report("write", params.steps, params.steps, None)
        write_person(folder, human, params.size)
        report("write", params.steps, params.steps, 0.0)  # the last chance to cancel
    seed = {"seed": params.seed} if isinstance(params, VaryParams | InpaintParams | TransferParams) else {}
    return {
        **FILES.in_folder(out),
        **seed,
        "steps": params.steps,
        "seconds": round(time.perf_counter() - began, 3),
        "seconds_sampling": round(edited - began, 3),
        "peak_gb": round(peak_memory_gb(), 3),
    }
