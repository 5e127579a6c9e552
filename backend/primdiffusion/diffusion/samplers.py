"""Samplers: pure functions of a denoiser, a schedule and an initial sample that yield each step (paper sec. 3.3).

The caller owns progress and cancelling: it stops by not iterating further. Each sample has its own noise generator, so
that a person does not depend on the rest of the batch.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from primdiffusion.diffusion.schedule import CLEAN, Schedule

Denoise = Callable[[Tensor, int], Tensor]
"""x0 guess from a batch x [b, ...] that holds noise of step t."""
Generators = torch.Generator | Sequence[torch.Generator]
"""A generator for each sample of a batch, or one for the whole batch."""
RELEASED_END = 0
"""The level at which the released code's DDIM ends: 0.01 of noise remains (SPEC 1.14)."""


@dataclasses.dataclass(frozen=True)
class SamplerStep:
    """State of a sampler after one step."""

    index: int
    """Steps done before this one, 0 ... total-1."""
    total: int
    t: int
    """Noise level of the denoiser's input."""
    x0: Tensor
    """The denoiser's guess of the clean sample."""
    x: Tensor
    """The sample at the next lower level; after the last step equal to x0, unless `ddim` ends above `CLEAN`."""


def ddpm(
    denoise: Denoise, schedule: Schedule, x: Tensor, steps: Sequence[int], generators: Generators
) -> Iterator[SamplerStep]:
    """Ancestral sampling with the posterior's variance (paper eq. 6-7) down the descending `steps`."""
    for index, (t, t_prev) in enumerate(pairwise((*steps, CLEAN))):
        x0 = denoise(x, t)
        x = ddpm_step(schedule, x, x0, t, t_prev, generators)
        yield SamplerStep(index, len(steps), t, x0, x)


def ddpm_step(schedule: Schedule, x: Tensor, x0: Tensor, t: int, t_prev: int, generators: Generators) -> Tensor:
    """The sample at t_prev from x [b, ...] at t and its clean guess x0: one step of `ddpm`."""
    x = schedule.posterior_mean(x, x0, t, t_prev)
    return x if t_prev == CLEAN else x + schedule.posterior_std(t, t_prev) * gaussian_noise(x, generators)


def ddim(
    denoise: Denoise,
    schedule: Schedule,
    x: Tensor,
    steps: Sequence[int],
    generators: Generators,
    eta: float = 0.0,
    end: int = CLEAN,
) -> Iterator[SamplerStep]:
    """Implicit sampling (Song et al. 2021, eq. 12) down the descending `steps`.

    `eta` scales the posterior's noise: 0 is deterministic after the start, 1 has the variance of `ddpm`.
    The last step reaches level `end`: by default the predicted x0; `RELEASED_END` leaves that level's noise in x.
    """
    for index, (t, t_prev) in enumerate(pairwise((*steps, end))):
        x0 = denoise(x, t)
        if not t == t_prev == end:  # a chain that itself ends there is at its end already
            x = ddim_step(schedule, x, x0, t, t_prev, generators, eta)
        yield SamplerStep(index, len(steps), t, x0, x)


def ddim_step(
    schedule: Schedule, x: Tensor, x0: Tensor, t: int, t_prev: int, generators: Generators, eta: float = 0.0
) -> Tensor:
    """The sample at t_prev from x [b, ...] at t and its clean guess x0: one step of `ddim`."""
    if t_prev == CLEAN:
        return x0
    added = eta * schedule.posterior_std(t, t_prev)
    implied = (schedule.noise(t_prev) ** 2 - added**2) ** 0.5
    x = schedule.signal(t_prev) * x0 + implied * schedule.epsilon(x, x0, t)
    return x + added * gaussian_noise(x, generators) if added > 0 else x


def dpmpp_2m(
    denoise: Denoise, schedule: Schedule, x: Tensor, steps: Sequence[int], generators: Generators
) -> Iterator[SamplerStep]:
    """DPM-Solver++(2M) (Lu et al. 2022, alg. 2) down the descending `steps`; draws no noise.

    A multistep method of second order: the clean guess is extrapolated to the middle of the step, in half log SNR, from
    this one and the previous one. The first step has no previous one, and the last reaches infinite SNR, where the
    guess itself is the answer: both equal those of `ddim`.
    """
    before: tuple[Tensor, float] | None = None
    for index, (t, t_prev) in enumerate(pairwise((*steps, CLEAN))):
        x0 = denoise(x, t)
        x = dpmpp_2m_step(schedule, x, x0, t, t_prev, before)
        before = x0, schedule.half_log_snr_gain(t, t_prev)
        yield SamplerStep(index, len(steps), t, x0, x)


def dpmpp_2m_step(
    schedule: Schedule, x: Tensor, x0: Tensor, t: int, t_prev: int, before: tuple[Tensor, float] | None
) -> Tensor:
    """The sample at t_prev from x [b, ...] at t and its clean guess x0: one step of `dpmpp_2m`.

    `before` is the clean guess of the previous step and that step's length in half log SNR; None in the first step.
    """
    if t_prev == CLEAN:
        return x0
    gain = schedule.half_log_snr_gain(t, t_prev)
    middle = x0 if before is None else x0 + gain / (2 * before[1]) * (x0 - before[0])
    ratio = schedule.noise(t_prev) / schedule.noise(t)
    return ratio * x - schedule.signal(t_prev) * math.expm1(-gain) * middle


def gaussian_noise(like: Tensor, generators: Generators) -> Tensor:
    """Standard normal noise of the shape, type and device of `like`.

    With a sequence of generators, one for each sample of `like` [b, ...], sample i is drawn from generators[i] alone
    and is the same in any batch; a single generator draws the batch at once. Raises ValueError for another number of
    generators than samples.
    """
    if isinstance(generators, torch.Generator):
        return _normal(like, generators)
    if len(generators) != len(like):
        raise ValueError(f"a batch of {len(like)} samples needs as many generators; {len(generators)} were given")
    return torch.stack([_normal(one, generator) for one, generator in zip(like, generators, strict=True)])


def _normal(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=generator.device).to(like.device)


SAMPLERS = {"ddim": ddim, "ddpm": ddpm, "dpmpp_2m": dpmpp_2m}
"""Samplers by name."""
