"""What all edits share: a person as a model sees them, the noise an amount stands for, what their file says of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel, seeded
from primdiffusion.diffusion.samplers import Denoise, SamplerStep
from primdiffusion.diffusion.schedule import Schedule, trailing_steps
from primdiffusion.editing.unit_interval import check_unit_interval
from primdiffusion.human import Human
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import Payload

EVENNESS = 0.7
EDITING = 0x6ED1F7A9C35B2D84
"""Tells seeds of edits from those of generating: with a person's own noise, an edit would lead back to them."""
OnStep = Callable[[SamplerStep], None]
"""Sees each step after it is done; an exception it raises ends the work (that is how cancelling works)."""


def fitted(model: DiffusionModel, human: Human) -> DiffusionModel:
    """The model with the person's own density scale, so that what it calls solid is as solid as the rest of them.

    Raises ValueError for a person who stands on another body than the model's people.
    """
    check_correspondence("the person", human.body_setup, "the checkpoint's people", model.body_setup)
    own = human.provenance.get("full_density", model.full_density)
    if isinstance(own, bool) or not isinstance(own, int | float) or not (math.isfinite(own) and own > 0):
        raise ValueError(f"the person's full_density is {own!r}, not a positive number of 1/m: generate them again")
    return dataclasses.replace(model, full_density=float(own))


def check_correspondence(name: str, body_setup: BodySetup | None, other_name: str, other: BodySetup | None) -> None:
    """ValueError unless both stand on one body: on two, primitives with one number are different places."""
    contents = [
        None if one is None else [file.sha256 for file in (one.files.smpl, *one.files.uv)]
        for one in (body_setup, other)
    ]
    if contents[0] != contents[1]:
        raise ValueError(
            f"{name} and {other_name} stand on different bodies, so their primitives do not correspond: "
            "choose two of one kind"
        )


def encoded(model: DiffusionModel, human: Human) -> Float[Tensor, "1 c h w"]:
    """The person as a clean sample of a `fitted` model; what its codec leaves out is lost."""
    return model.encode(human.payload.map(lambda values: values[None]))


def edit_generator(seed: int) -> torch.Generator:
    """The noise of an edit; ValueError for a seed outside 0 ... 2^63-1."""
    seeded(seed)
    return seeded(seed ^ EDITING)


def asked(model: DiffusionModel, attributes: Mapping[str, str | float], guidance: float) -> Denoise:
    """The model's denoiser for people with these attributes; raises ValueError for those it does not know."""
    if not math.isfinite(guidance):
        raise ValueError(f"guidance is {guidance}: give a number, 1 for none")
    condition = model.condition(attributes)

    def denoise(x: Tensor, t: int) -> Tensor:
        return model.denoise(x, t, condition, guidance)

    return denoise


def chain_down(schedule: Schedule, amount: float, steps: int) -> list[int]:
    """Descending steps from the level T * amount^0.7 (1: T-1, noise alone) to the last one; empty where it is 0.

    Low levels hardly show: with this power, amounts look evenly spaced. `steps` of them, evenly spaced as in sampling,
    or all there are below that level where these are fewer. Raises ValueError for an amount outside 0 ... 1 and a
    number of steps outside 1 ... T.
    """
    check_unit_interval("amount", amount)
    trailing_steps(schedule.length, steps)
    levels = round(amount**EVENNESS * schedule.length)
    return trailing_steps(levels, min(steps, levels)) if levels else []


def last(steps: Iterable[SamplerStep], on_step: OnStep | None) -> Float[Tensor, "b c h w"]:
    """The clean samples that a sampler ends with; `on_step` is told of each step."""
    final = None
    for step in steps:
        if on_step is not None:
            on_step(step)
        final = step.x0
    assert final is not None, "a sampler yields at least one step"
    return final


def decoded(model: DiffusionModel, x0: Float[Tensor, "1 c h w"]) -> Payload:
    """The payload of one clean sample, on the CPU."""
    return model.decode(x0[0]).to("cpu")


def with_payload(model: DiffusionModel, human: Human, x0: Float[Tensor, "1 c h w"]) -> Human:
    """The person with the looks of one clean sample of the model, on the CPU: what an edit amounts to so far."""
    return dataclasses.replace(human.to("cpu"), payload=decoded(fitted(model, human), x0))


def with_edit(human: Human, edit: Mapping[str, Any], payload: Payload, betas: Tensor | None = None) -> Human:
    """The person with a new payload (and body), and `edit` added to what their provenance says was done to them."""
    provenance = {**human.provenance, "edits": [*human.provenance.get("edits", []), dict(edit)]}
    betas = human.betas if betas is None else betas
    return dataclasses.replace(
        human.to("cpu"), payload=payload, betas=betas.to("cpu"), provenance=provenance
    ).validate()


def combined(region: Tensor, inside: Payload, outside: Payload) -> Payload:
    """The one payload in a region [K], the other, bit for bit, everywhere else; on the CPU."""

    def chosen(name: str) -> Tensor:
        new, old = (getattr(payload, name).to("cpu") for payload in (inside, outside))
        return torch.where(region.reshape(-1, *[1] * (old.ndim - 1)), new.to(old.dtype), old)

    return Payload(chosen("rgb"), chosen("density"), chosen("delta_scale"))


def difference(one: Payload, other: Payload) -> Payload:
    """What `one` has beyond `other`, field by field."""
    return Payload(one.rgb - other.rgb, one.density - other.density, one.delta_scale - other.delta_scale)


def added(payload: Payload, left_out: Payload, share: float) -> Payload:
    """A payload with a share of a `difference`, within the bounds of payloads."""
    return Payload(
        (payload.rgb + share * left_out.rgb).clamp(0, 1),
        (payload.density + share * left_out.density).clamp_min(0),
        (payload.delta_scale + share * left_out.delta_scale).clamp_min(0),
    )
