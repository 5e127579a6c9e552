"""People between two people: both back to noise, a point on the arc between, and forth again."""

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
    added,
    decoded,
    difference,
    encoded,
    fitted,
    last,
    with_edit,
)
from primdiffusion.editing.unit_interval import check_unit_interval
from primdiffusion.formats import requests
from primdiffusion.human import Human, made_by
from primdiffusion.primitives.primitives import Payload


def interpolate(
    model: DiffusionModel,
    a: Human,
    b: Human,
    fraction: float = 0.5,
    steps: int = requests.STEPS,
    on_step: OnStep | None = None,
) -> Human:
    """The person at `fraction` of the way from `a` to `b`: a likely person all the way, not a double exposure.

    DDIM is run backwards for both (Song et al. 2021, sec. 4.3), the noises are interpolated on the arc between them,
    and DDIM is run forwards for that. What the way there and back loses of a and b is added again in proportion to the
    nearness to each, so the ends are the people themselves: exactly at 0 and 1. Betas are interpolated linearly.
    Deterministic, without a seed. Provenance is that of the nearer person. Raises ValueError for a fraction outside
    0 ... 1 and steps outside 1 ... T.
    """
    check_unit_interval("fraction", fraction)
    chain = inversion_steps(model.schedule, steps)
    models = fitted(model, a), fitted(model, b)
    if models[0].full_density != models[1].full_density:
        densities = " and ".join(f"{one.full_density:g}" for one in models)
        raise ValueError(f"the two people are of different full densities ({densities} 1/m): choose two of one kind")
    if fraction in (0, 1):
        payload = (b if fraction else a).payload.to("cpu")
    else:
        payload = _between(models[0], (a, b), fraction, chain, on_step)
    near, far = (a, b) if fraction <= 0.5 else (b, a)
    edit = {"edit": "interpolate", "with": dict(far.provenance), "fraction": min(fraction, 1 - fraction)}
    betas = torch.lerp(a.betas.cpu(), b.betas.cpu(), fraction)
    return with_edit(near, {**edit, "steps": steps, **made_by(model)}, payload, betas)


def inversion_steps(schedule: Schedule, steps: int) -> list[int]:
    """Descending steps from T-1 to 0: as `trailing_steps`, but down to where a clean sample is nearly at home.

    Raises ValueError for a number of steps outside 2 ... T; one alone leads nowhere.
    """
    if not 2 <= steps <= schedule.length:
        raise ValueError(f"people can be interpolated in 2 to {schedule.length} steps; {steps} were asked for")
    return [round((schedule.length - 1) * (1 - i / (steps - 1))) for i in range(steps)]


def inverted(
    denoise: Denoise, schedule: Schedule, x0: Float[Tensor, "b c h w"], steps: Sequence[int]
) -> Iterator[SamplerStep]:
    """DDIM backwards: from clean samples, taken for samples of the last of the descending `steps`, up to the first."""
    x, upwards = x0, list(reversed(steps))
    for index, (t, t_up) in enumerate(pairwise(upwards)):
        guess = denoise(x, t)
        x = schedule.signal(t_up) * guess + schedule.noise(t_up) * schedule.epsilon(x, guess, t)
        yield SamplerStep(index, len(upwards) - 1, t, guess, x)


def slerp(a: Float[Tensor, "c h w"], b: Float[Tensor, "c h w"], fraction: float) -> Float[Tensor, "c h w"]:
    """The point at `fraction` of the arc from a to b, as far from 0 as these are; linear where they are one."""
    cosine = float((a * b).sum() / (a.norm() * b.norm()).clamp_min(1e-12))
    angle = math.acos(max(-1.0, min(1.0, cosine)))
    if math.sin(angle) < 1e-4:
        return torch.lerp(a, b, fraction)
    return (math.sin((1 - fraction) * angle) * a + math.sin(fraction * angle) * b) / math.sin(angle)


def there_and_back(
    denoise: Denoise, schedule: Schedule, ends: Float[Tensor, "2 c h w"], fraction: float, steps: Sequence[int]
) -> Iterator[SamplerStep]:
    """Both ends up to noise, then both and the point between them down; the last x0 is that of [a, b, between]."""
    noise, total, up = ends, 2 * len(steps) - 1, 0
    for step in inverted(denoise, schedule, ends, steps):
        yield dataclasses.replace(step, total=total)
        noise, up = step.x, up + 1
    start = torch.cat([noise, slerp(noise[0], noise[1], fraction)[None]])
    for step in ddim(denoise, schedule, start, steps, []):
        yield dataclasses.replace(step, index=up + step.index, total=total)


def _between(
    model: DiffusionModel, people: tuple[Human, Human], fraction: float, chain: Sequence[int], on_step: OnStep | None
) -> Payload:
    ends = torch.cat([encoded(model, human) for human in people])
    back = last(there_and_back(model.denoise, model.schedule, ends, fraction, chain), on_step)
    lost = ends - back[:2]
    between = decoded(model, back[2:] + torch.lerp(lost[:1], lost[1:], fraction))
    left_out = [
        difference(human.payload.to("cpu"), decoded(model, x0[None])) for human, x0 in zip(people, ends, strict=True)
    ]
    return added(added(between, left_out[0], 1 - fraction), left_out[1], fraction)
