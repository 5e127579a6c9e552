"""The jobs that make a person of a person: vary, interpolate, inpaint, transfer."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.editing import inpaint, interpolate, transfer, vary
from primdiffusion.editing.edit import OnStep
from primdiffusion.editing.painted import read_weights
from primdiffusion.editing.regions import region_from_weights, region_of
from primdiffusion.human import Human
from primdiffusion.human_file import load_human
from primdiffusion.machine import peak_memory_gb
from primdiffusion.person_folder import FILES, write_person
from primdiffusion.serve.drawing import Report
from primdiffusion.serve.edit_params import EditParams, InpaintParams, InterpolateParams, TransferParams, VaryParams
from primdiffusion.staging import staged

LoadModel = Callable[[str | None], DiffusionModel]
Reporter = Callable[[Report], OnStep]


class Editor:
    """Edits with the models that `load_model` keeps; steps are reported by what `reporter` makes of a report."""

    def __init__(self, load_model: LoadModel, reporter: Reporter) -> None:
        self._load_model = load_model
        self._reporter = reporter

    def vary(self, params: VaryParams, report: Report) -> dict[str, Any]:
        """A neighbour of the person."""

        def edit(human: Human) -> Human:
            model, on_step = self._ready(params, report)
            return vary.vary(
                model, human, params.amount, params.seed, params.steps, on_step, params.attributes, params.guidance
            )

        return _written(params, report, edit)

    def interpolate(self, params: InterpolateParams, report: Report) -> dict[str, Any]:
        """A person between two."""

        def edit(human: Human) -> Human:
            other = load_human(params.other)
            model, on_step = self._ready(params, report)
            return interpolate.interpolate(model, human, other, params.fraction, params.steps, on_step)

        return _written(params, report, edit)

    def inpaint(self, params: InpaintParams, report: Report) -> dict[str, Any]:
        """The person with a region made anew."""

        def edit(human: Human) -> Human:
            region = _region(params.region, human)
            model, on_step = self._ready(params, report)
            return inpaint.inpaint(
                model, human, region, params.seed, params.steps, params.attributes, params.guidance, on_step
            )

        return _written(params, report, edit)

    def transfer(self, params: TransferParams, report: Report) -> dict[str, Any]:
        """The person with another one's looks in a region. Loads a model only for harmonising."""

        def edit(human: Human) -> Human:
            source, region = load_human(params.source), _region(params.region, human)
            exchange = transfer.transfer_garment if params.what == "garment" else transfer.transfer_texture
            edited = exchange(source, human, region)
            if not params.harmonise:
                return edited
            model, on_step = self._ready(params, report)
            return inpaint.harmonise(model, edited, region, params.harmonise, params.seed, params.steps, on_step)

        return _written(params, report, edit)

    def _ready(self, params: EditParams, report: Report) -> tuple[DiffusionModel, OnStep]:
        model = self._load_model(params.checkpoint)
        report("sample", 0, params.steps, None)
        return model, self._reporter(report)


def _region(region: list | dict, human: Human) -> Bool[Tensor, "k"]:
    if isinstance(region, dict):
        return region_from_weights(read_weights(region["weights"]), stand=human.stand)
    return region_of(region, human.stand)


def _written(params: EditParams, report: Report, edit: Callable[[Human], Human]) -> dict[str, Any]:
    """Edits the person and writes the result to `out_dir`, all files or none; what generate returns of its own.

    Raises OSError before any work if the folder cannot be written to; what load_human, load_checkpoint and edits raise.
    """
    began = time.perf_counter()
    out = Path(params.out_dir)
    with staged(out) as folder:
        report("load", 0, params.steps, None)
        human = edit(load_human(params.person))
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
