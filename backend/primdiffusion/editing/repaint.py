"""Sampling a part of a sample so that it fits the rest, without training (RePaint, Lugmayr et al. 2022)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from primdiffusion.diffusion.samplers import Denoise, SamplerStep, gaussian_noise
from primdiffusion.diffusion.schedule import CLEAN, Schedule

JUMP = 1
"""Steps of each stretch that is sampled again, after noise of as many steps was added. Lugmayr et al. jump ten of 250;
of a few dozen, each is so long that for the same number of calls jumps of one fit best (tests/backend)."""
RESAMPLES = 2
"""How often each stretch is sampled: 1 is no resampling."""


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
    """Sample what is `inside` down the descending `steps`, while what is outside follows the clean sample `known`.

    At every level t the outside is q_sample(known, t) with fresh noise: what a sample of that level has there (SPEC 3).
    Inside, a step is the posterior's (paper eq. 6-7). A step alone fits the inside to an outside of a higher level;
    after every `jump` steps, noise of `jump` steps is added to all of it and these are sampled again (their alg. 1), so
    that both come to agree. `x` is a sample at steps[0]; only its inside matters. The last x0 is `known` outside.
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
    """Positions 0 (noisiest) to `count` (clean) in the order they are visited, jumps back included.

    Raises ValueError for a jump or a number of samplings below 1.
    """
    if jump < 1 or resamples < 1:
        raise ValueError(f"jumps of {jump} steps, {resamples} samplings of each: choose 1 or more of both")
    path = [0]
    for bottom in range(jump, count, jump):
        path += range(path[-1] + 1, bottom + 1)
        for _ in range(resamples - 1):
            path += range(bottom - jump, bottom + 1)
    return [*path, *range(path[-1] + 1, count + 1)]


def noised(schedule: Schedule, x0: Float[Tensor, "b c h w"], t: int, generator: torch.Generator) -> Tensor:
    """Clean samples with noise of level t; themselves at `CLEAN`."""
    if t == CLEAN:
        return x0
    level = torch.full((len(x0),), t, dtype=torch.int64, device=x0.device)
    return schedule.q_sample(x0, level, gaussian_noise(x0, generator))


def renoised(schedule: Schedule, x: Float[Tensor, "b c h w"], t: int, t_up: int, generator: torch.Generator) -> Tensor:
    """Samples of level t with the noise added that level t_up > t has beyond it: q(x_up | x)."""
    kept = schedule.signal(t_up) / schedule.signal(t)
    return kept * x + (1 - kept**2) ** 0.5 * gaussian_noise(x, generator)
