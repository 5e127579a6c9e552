"""Edit a human: `vary`, `interpolate`, `inpaint` and `transfer`."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

from jaxtyping import Bool
from torch import Tensor

from primdiffusion.commands.output import FILES, Decode, skips_previews, step_previews, write_human
from primdiffusion.commands.progress import ReportProgress, step_reporter
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.model import DiffusionModel, warnings_of
from primdiffusion.editing.edit import OnStep, combine, with_payload
from primdiffusion.editing.inpaint import harmonise, inpaint
from primdiffusion.editing.interpolate import interpolate
from primdiffusion.editing.regions import read_weights, region_from_weights, region_of
from primdiffusion.editing.transfer import transfer_garment, transfer_texture
from primdiffusion.editing.vary import vary
from primdiffusion.files.whole_files import atomic_folder
from primdiffusion.formats.answers import HumanAnswer
from primdiffusion.formats.requests import (
    EditRequest,
    InpaintRequest,
    InterpolateRequest,
    RegionRequest,
    TransferRequest,
    VaryRequest,
)
from primdiffusion.human import Human
from primdiffusion.human_file import load_human

Sampling = Callable[[Decode], AbstractContextManager[OnStep]]
"""Reports the steps of a sampler, with previews of the humans that the function makes of its x0 guesses."""


def edit(request: EditRequest, session: Session, report: ReportProgress) -> HumanAnswer:
    """Edit the human and write the result, all files or none.

    Raises OSError first of all if the folder cannot be written to; raises as load_human, load_checkpoint and edits.
    """
    began, steps = time.perf_counter(), request.steps
    with atomic_folder(request.out_dir) as folder:
        report("load", 0, steps, None)

        @contextlib.contextmanager
        def sampling(decode: Decode) -> Iterator[OnStep]:
            report("sample", 0, steps, None)
            with step_previews(folder, request.picture_px, decode) as preview:
                yield step_reporter(report, preview)

        human = _EDITS[type(request)](request, load_human(request.person), session, sampling)
        report("write", steps, steps, None)
        drawn = not skips_previews(request.picture_px)
        write_human(folder, human, request.size, previews=drawn)
        report("write", steps, steps, 0.0)  # the last chance to cancel
    return HumanAnswer(
        **FILES.in_folder(request.out_dir, previews=drawn),
        warnings=warnings_of(human.provenance["edits"][-1]),
        seed=getattr(request, "seed", None),  # interpolations have none
        steps=steps,
        edit=human.provenance["edits"][-1]["edit"],
        seconds=round(time.perf_counter() - began, 3),
    )


def _vary(request: VaryRequest, human: Human, session: Session, sampling: Sampling) -> Human:
    model = session.model(request.checkpoint)
    conditioning = (request.attributes, request.guidance)
    with sampling(lambda x0: with_payload(model, human, x0)) as on_step:
        return vary(model, human, request.amount, request.seed, request.steps, on_step, *conditioning)


def _interpolate(request: InterpolateRequest, human: Human, session: Session, sampling: Sampling) -> Human:
    other = load_human(request.other)
    model = session.model(request.checkpoint)

    def decode(x0: Tensor) -> Human | None:
        denoising = len(x0) == 3  # both ends and the human in between; only the two ends while inverting
        return with_payload(model, human, x0[2:]) if denoising else None

    with sampling(decode) as on_step:
        return interpolate(model, human, other, request.fraction, request.steps, on_step)


def _inpaint(request: InpaintRequest, human: Human, session: Session, sampling: Sampling) -> Human:
    region = _region(request, human)
    model = session.model(request.checkpoint)
    conditioning = (request.attributes, request.guidance)
    with sampling(lambda x0: _decode_inside(model, human, region, x0)) as on_step:
        return inpaint(model, human, region, request.seed, request.steps, *conditioning, on_step, request.masking)


def _transfer(request: TransferRequest, human: Human, session: Session, sampling: Sampling) -> Human:
    """Loads a model only for harmonising."""
    source, region = load_human(request.source), _region(request, human)
    edited = (transfer_garment if request.what == "garment" else transfer_texture)(source, human, region)
    if not request.harmonise:
        return edited
    model = session.model(request.checkpoint)
    with sampling(lambda x0: _decode_inside(model, edited, region, x0)) as on_step:
        return harmonise(model, edited, region, request.harmonise, request.seed, request.steps, on_step)


_EDITS = {VaryRequest: _vary, InterpolateRequest: _interpolate, InpaintRequest: _inpaint, TransferRequest: _transfer}


def _region(request: RegionRequest, human: Human) -> Bool[Tensor, "k"]:
    """Return the region as a mask. Raises ValueError for unknown names and unusable weights, and OSError."""
    if request.weights is None:
        return region_of(request.region, human.body_setup)
    weights = read_weights(request.weights)
    try:
        return region_from_weights(weights, body_setup=human.body_setup)
    except ValueError as error:
        raise ValueError(f"{request.weights}: {error}") from error


def _decode_inside(model: DiffusionModel, human: Human, region: Bool[Tensor, "k"], x0: Tensor) -> Human:
    """Return the human with a sampler's x0 guess decoded inside a region."""
    guess = with_payload(model, human, x0)
    return dataclasses.replace(guess, payload=combine(region, guess.payload, human.payload))
