"""Interpolate between two humans: DDIM inversion of both, slerp of the noises, DDIM sampling."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.samplers import Denoise, SamplerStep, ddim
from primdiffusion.diffusion.schedule import Schedule
from primdiffusion.editing.edit import (
    OnStep,
    add_residual,
    check_unit_interval,
    decode_latents,
    difference,
    encode_human,
    match_density,
    run_sampler,
    with_edit,
)
from primdiffusion.formats import requests
from primdiffusion.human import Human, model_provenance
from primdiffusion.primitives.primitives import Payload
from primdiffusion.runtime.device import on_fixed_threads


@on_fixed_threads
def interpolate(
    model: DiffusionModel,
    a: Human,
    b: Human,
    fraction: float = 0.5,
    steps: int = requests.Sampling.steps,
    on_step: OnStep | None = None,
) -> Human:
    """Return the human at `fraction` of the way from `a` to `b`: plausible throughout, not a cross-fade.

    Both are inverted with DDIM (Song et al. 2021, sec. 4.3), the noises are interpolated spherically, and the result is
    sampled with DDIM. The reconstruction residuals of a and b are interpolated and added, so that fractions 0 and 1
    return them exactly. Each is denoised with its own attributes, and what lies between with those of the nearer end:
    half of a tee and half of a suit is neither. Betas are interpolated linearly. Needs no seed; deterministic as
    `human.generate`. The provenance is that of the nearer end.

        >>> between = pd.interpolate(model, human, varied, 0.5)
        >>> between.provenance["edits"][-1]["edit"]
        'interpolate'

    Raises ValueError for a fraction outside 0 ... 1 and steps outside 2 ... T.
    """
    check_unit_interval("fraction", fraction)
    chain = inversion_steps(model.schedule, steps)
    models = match_density(model, a), match_density(model, b)
    if models[0].full_density != models[1].full_density:
        densities = " and ".join(f"{one.full_density:g}" for one in models)
        raise ValueError(f"the two have different full densities ({densities} 1/m): choose two of one checkpoint")
    if fraction in (0, 1):
        payload = (b if fraction else a).payload.to("cpu")
    else:
        payload = _between(models[0], (a, b), fraction, chain, on_step)
    near, far = (a, b) if fraction <= 0.5 else (b, a)
    edit = {"edit": "interpolate", "with": dict(far.provenance), "fraction": min(fraction, 1 - fraction)}
    betas = torch.lerp(a.betas.cpu(), b.betas.cpu(), fraction)
    return with_edit(near, {**edit, "steps": steps, **model_provenance(model)}, payload, betas)


def inversion_steps(schedule: Schedule, steps: int) -> list[int]:
    """Descending timesteps from T-1 to 0: as `trailing_steps`, but down to the level of nearly clean latents.

    Raises ValueError for a number of steps outside 2 ... T.
    """
    if not 2 <= steps <= schedule.length:
        raise ValueError(f"steps is {steps}: interpolation takes 2 to {schedule.length} steps")
    return [round((schedule.length - 1) * (1 - i / (steps - 1))) for i in range(steps)]


def invert(
    denoise: Denoise, schedule: Schedule, x0: Float[Tensor, "b c h w"], steps: Sequence[int]
) -> Iterator[SamplerStep]:
    """DDIM inversion: from clean latents, assigned to the last of the descending `steps`, up to the first."""
    x, upwards = x0, list(reversed(steps))
    for index, (t, t_up) in enumerate(pairwise(upwards)):
        guess = denoise(x, t)
        x = schedule.signal(t_up) * guess + schedule.noise(t_up) * schedule.epsilon(x, guess, t)
        yield SamplerStep(index, len(upwards) - 1, t, guess, x)


def slerp(a: Float[Tensor, "c h w"], b: Float[Tensor, "c h w"], fraction: float) -> Float[Tensor, "c h w"]:
    """Spherical linear interpolation; linear for nearly parallel vectors."""
    cosine = float((a * b).sum() / (a.norm() * b.norm()).clamp_min(1e-12))
    angle = math.acos(max(-1.0, min(1.0, cosine)))
    if math.sin(angle) < 1e-4:
        return torch.lerp(a, b, fraction)
    return (math.sin((1 - fraction) * angle) * a + math.sin(fraction * angle) * b) / math.sin(angle)


def invert_and_sample(
    denoise: Denoise, schedule: Schedule, ends: Float[Tensor, "2 c h w"], fraction: float, steps: Sequence[int]
) -> Iterator[SamplerStep]:
    """Invert both ends, then denoise both and their interpolation; the last x0 is that of [a, b, between]."""
    noise, total, up = ends, 2 * len(steps) - 1, 0
    for step in invert(denoise, schedule, ends, steps):
        yield dataclasses.replace(step, total=total)
        noise, up = step.x, up + 1
    start = torch.cat([noise, slerp(noise[0], noise[1], fraction)[None]])
    for step in ddim(denoise, schedule, start, steps, []):
        yield dataclasses.replace(step, index=up + step.index, total=total)


def _between(
    model: DiffusionModel, people: tuple[Human, Human], fraction: float, chain: Sequence[int], on_step: OnStep | None
) -> Payload:
    ends = torch.cat([encode_human(model, human) for human in people])
    of_ends = model.read_condition(ends)
    nearer = condition = None
    if of_ends is not None:
        nearer = of_ends[int(fraction > 0.5)][None]
        condition = torch.cat([of_ends, nearer])

    def denoise(x: Tensor, t: int) -> Tensor:
        return model.denoise(x, t, None if condition is None else condition[: len(x)])

    back = run_sampler(invert_and_sample(denoise, model.schedule, ends, fraction, chain), on_step)
    latent_residual = ends - back[:2]
    lost = torch.lerp(latent_residual[:1], latent_residual[1:], fraction)
    between = decode_latents(model, back[2:] + lost, nearer)
    residuals = [
        difference(human.payload.to("cpu"), decode_latents(model, x0[None]))
        for human, x0 in zip(people, ends, strict=True)
    ]
    return add_residual(add_residual(between, residuals[0], 1 - fraction), residuals[1], fraction)
