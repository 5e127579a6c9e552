"""Resample a region of a latent to fit the rest, without training (RePaint, Lugmayr et al. 2022)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from primdiffusion.diffusion.samplers import Denoise, SamplerStep, gaussian_noise
from primdiffusion.diffusion.schedule import CLEAN, Schedule

JUMP = 1
"""Steps of each jump back to a higher noise level. Lugmayr et al. jump 10 of 250 steps; with a few dozen longer steps,
jumps of one fit best for the same number of denoiser calls (tests/backend)."""
RESAMPLES = 2
"""How often each jump's steps are sampled; 1 disables resampling."""


def repaint(
    denoise: Denoise,
    schedule: Schedule,
    x: Float[Tensor, "b c h w"],
    known: Float[Tensor, "b c h w"],
    inside: Bool[Tensor, "h w"],
    steps: Sequence[int],
    generator: torch.Generator,
    jump: int = JUMP,
    resamples: int = RESAMPLES,
) -> Iterator[SamplerStep]:
    """Sample the region `inside` along the descending `steps`, conditioned on the clean latent `known` outside.

    At every level t the outside is q_sample(known, t) with fresh noise (SPEC 3); inside, a step samples the posterior
    (paper eq. 6-7). A single step fits the inside to an outside of a higher noise level; after every `jump` steps,
    noise of `jump` steps is added to both and these steps are repeated (their alg. 1), so that both come to agree. Only
    the inside of `x`, a latent at steps[0], is used. The last x0 equals `known` outside.
    """
    levels = (*steps, CLEAN)
    moves = list(pairwise(resampling_path(len(steps), jump, resamples)))
    total, done = sum(there > here for here, there in moves), 0
    x = torch.where(inside, x, noised(schedule, known, levels[0], generator))
    for t, t_next in ((levels[here], levels[there]) for here, there in moves):
        if t_next > t:
            x = renoised(schedule, x, t, t_next, generator)
            continue
        x0 = torch.where(inside, denoise(x, t), known)
        x = schedule.posterior_mean(x, x0, t, t_next)
        if t_next != CLEAN:
            x = x + schedule.posterior_std(t, t_next) * gaussian_noise(x, generator)
        x = torch.where(inside, x, noised(schedule, known, t_next, generator))
        yield SamplerStep(done, total, t, x0, x)
        done += 1


def resampling_path(count: int, jump: int, resamples: int) -> list[int]:
    """Positions 0 (noisiest) to `count` (clean) in order, including jumps back.

    Raises ValueError for `jump` or `resamples` below 1.
    """
    if jump < 1 or resamples < 1:
        raise ValueError(f"jump is {jump}, resamples {resamples}: choose 1 or more for both")
    path = [0]
    for bottom in range(jump, count, jump):
        path += range(path[-1] + 1, bottom + 1)
        for _ in range(resamples - 1):
            path += range(bottom - jump, bottom + 1)
    return [*path, *range(path[-1] + 1, count + 1)]


def noised(schedule: Schedule, x0: Float[Tensor, "b c h w"], t: int, generator: torch.Generator) -> Tensor:
    """Noise clean latents to level t; unchanged for `CLEAN`."""
    if t == CLEAN:
        return x0
    level = torch.full((len(x0),), t, dtype=torch.int64, device=x0.device)
    return schedule.q_sample(x0, level, gaussian_noise(x0, generator))


def renoised(schedule: Schedule, x: Float[Tensor, "b c h w"], t: int, t_up: int, generator: torch.Generator) -> Tensor:
    """Noise latents of level t to the higher level t_up: a sample of q(x_up | x)."""
    ratio = schedule.signal(t_up) / schedule.signal(t)
    return ratio * x + (1 - ratio**2) ** 0.5 * gaussian_noise(x, generator)
