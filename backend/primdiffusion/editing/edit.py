"""Shared by all edits: encoding, noise levels, conditioning, and provenance."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel, seeded_generator
from primdiffusion.diffusion.samplers import Denoise, SamplerStep
from primdiffusion.diffusion.schedule import early_steps
from primdiffusion.human import Human
from primdiffusion.primitives.body_setup import BodySetup
from primdiffusion.primitives.primitives import Payload

AMOUNT_POWER = 0.7
EDIT_SEED_MASK = 0x6ED1F7A9C35B2D84
"""XORed with edit seeds: the noise a human was generated from would lead the edit back to it."""
OnStep = Callable[[SamplerStep], None]
"""Progress callback, called after each step; an exception it raises cancels."""


def check_unit_interval(name: str, value: float) -> None:
    """Raise ValueError unless `value` is in [0, 1]."""
    if not 0 <= value <= 1:
        raise ValueError(f"{name} is {value}: choose a number from 0 to 1")


def match_density(model: DiffusionModel, human: Human) -> DiffusionModel:
    """Return the model with the human's own density scale, so that edited parts are as solid as the rest.

    Raises ValueError if human and model use different bodies.
    """
    check_correspondence("the human", human.body_setup, "the checkpoint's humans", model.body_setup)
    own = human.provenance.get("full_density", model.full_density)
    if isinstance(own, bool) or not isinstance(own, int | float) or not (math.isfinite(own) and own > 0):
        raise ValueError(f"full_density is {own!r}, not a positive number of 1/m: generate this human again")
    return dataclasses.replace(model, full_density=float(own))


def check_correspondence(name: str, body_setup: BodySetup | None, other_name: str, other: BodySetup | None) -> None:
    """Raise ValueError unless both use the same body: primitives of different bodies do not correspond."""
    contents = [
        None if one is None else [file.sha256 for file in (one.files.smpl, *one.files.uv)]
        for one in (body_setup, other)
    ]
    if contents[0] != contents[1]:
        raise ValueError(
            f"{name} and {other_name} have different bodies, so their primitives do not correspond: "
            "choose two with the same body"
        )


def encode_human(model: DiffusionModel, human: Human) -> Float[Tensor, "1 c h w"]:
    """Encode a human as a clean latent; `model` comes from `match_density`. Detail beyond the codec is lost."""
    return model.encode(human.payload.map(lambda values: values[None]))


def edit_generator(seed: int) -> torch.Generator:
    """Return the noise generator of an edit. Raises ValueError for a seed outside 0 ... 2^63-1."""
    seeded_generator(seed)
    return seeded_generator(seed ^ EDIT_SEED_MASK)


def kept_attributes(
    model: DiffusionModel, human: Human, x0: Float[Tensor, "1 c h w"], asked: Mapping[str, str | float]
) -> Mapping[str, str | float]:
    """Condition of an edit: the attributes asked for, and plain clothes where the prior misreads pictures."""
    from_pictures = "reconstructed_from" in human.provenance
    plain = from_pictures and "pattern" not in asked and model.plain_after_all(x0)
    return {**asked, "pattern": "plain"} if plain else asked


def conditional_denoiser(model: DiffusionModel, attributes: Mapping[str, str | float], guidance: float) -> Denoise:
    """Return the model's denoiser, conditioned on attributes. Raises ValueError for unknown ones."""
    if not math.isfinite(guidance):
        raise ValueError(f"guidance is {guidance}: give a finite number, 1 for none")
    condition = model.condition(attributes)

    def denoise(x: Tensor, t: int) -> Tensor:
        return model.denoise(x, t, condition, guidance)

    return denoise


def edit_timesteps(model: DiffusionModel, amount: float, steps: int) -> list[int]:
    """Descending timesteps from T * amount^0.7 (T-1, pure noise, for amount 1); empty for amount 0.

    Low noise levels hardly change the result: the power makes amounts look evenly spaced. There are `steps` timesteps,
    evenly spaced, or fewer if there are fewer below the start. They end where the model's own chain of as many steps
    ends, or lower for a start below that, so an edit draws no finer detail than sampling does. Raises ValueError for an
    amount outside 0 ... 1 and a number of steps outside 1 ... T.
    """
    check_unit_interval("amount", amount)
    last = model.chain(model.schedule.length, steps)[-1]
    levels = round(amount**AMOUNT_POWER * model.schedule.length)
    return early_steps(levels, min(steps, levels), last) if levels else []


def run_sampler(steps: Iterable[SamplerStep], on_step: OnStep | None) -> Float[Tensor, "b c h w"]:
    """Run a sampler to its end and return the clean latents; `on_step` is called after each step."""
    final = None
    for step in steps:
        if on_step is not None:
            on_step(step)
        final = step.x0
    assert final is not None, "a sampler yields at least one step"
    return final


def decode_latents(
    model: DiffusionModel, x0: Float[Tensor, "1 c h w"], kind: Float[Tensor, "1 a"] | None = None
) -> Payload:
    """Decode one clean latent to a payload on the CPU, of a person of this kind if it is known."""
    return model.decode(x0[0], kind).to("cpu")


def with_payload(model: DiffusionModel, human: Human, x0: Float[Tensor, "1 c h w"]) -> Human:
    """Return the human with the payload of a clean latent, on the CPU: the preview of a running edit."""
    return dataclasses.replace(human.to("cpu"), payload=decode_latents(match_density(model, human), x0))


def with_edit(human: Human, edit: Mapping[str, Any], payload: Payload, betas: Tensor | None = None) -> Human:
    """Return the human with a new payload (and betas), and `edit` appended to its provenance."""
    provenance = {**human.provenance, "edits": [*human.provenance.get("edits", []), dict(edit)]}
    betas = human.betas if betas is None else betas
    return dataclasses.replace(
        human.to("cpu"), payload=payload, betas=betas.to("cpu"), provenance=provenance
    ).validate()


def combine(region: Tensor, inside: Payload, outside: Payload) -> Payload:
    """Combine two payloads: `inside` in the region [K], `outside`, bit for bit, elsewhere; on the CPU."""

    def chosen(name: str) -> Tensor:
        new, old = (getattr(payload, name).to("cpu") for payload in (inside, outside))
        return torch.where(region.reshape(-1, *[1] * (old.ndim - 1)), new.to(old.dtype), old)

    return Payload(chosen("rgb"), chosen("density"), chosen("delta_scale"))


def difference(one: Payload, other: Payload) -> Payload:
    """Subtract payloads field by field: `one` - `other`."""
    return Payload(one.rgb - other.rgb, one.density - other.density, one.delta_scale - other.delta_scale)


def add_residual(payload: Payload, residual: Payload, factor: float) -> Payload:
    """Add `factor` * `residual`, clamped to the bounds of payloads."""
    return Payload(
        (payload.rgb + factor * residual.rgb).clamp(0, 1),
        (payload.density + factor * residual.density).clamp_min(0),
        (payload.delta_scale + factor * residual.delta_scale).clamp_min(0),
    )
