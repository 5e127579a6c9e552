"""Samplers: pure functions of a denoiser, a schedule and a start that yield each step back (paper sec. 3.3).

The caller owns progress and cancelling: it stops by not asking for the next step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from primdiffusion.diffusion.schedule import CLEAN, Schedule

Denoise = Callable[[Tensor, int], Tensor]
"""x0 guess from a batch x [b, ...] that holds noise of step t."""


@dataclasses.dataclass(frozen=True)
class Step:
    """What a sampler knows after one step."""

    index: int
    """Steps done before this one, 0 ... total-1."""
    total: int
    t: int
    """Noise level that the denoiser was asked about."""
    x0: Tensor
    """The denoiser's guess of the clean sample."""
    x: Tensor
    """The sample at the next lower level; after the last step equal to x0."""


def ddpm(
    denoise: Denoise, schedule: Schedule, x: Tensor, steps: Sequence[int], generator: torch.Generator
) -> Iterator[Step]:
    """Ancestral sampling with the posterior's variance (paper eq. 6-7) down the descending `steps`."""
    for index, (t, t_prev) in enumerate(pairwise((*steps, CLEAN))):
        x0 = denoise(x, t)
        x = schedule.posterior_mean(x, x0, t, t_prev)
        if t_prev != CLEAN:
            x = x + schedule.posterior_std(t, t_prev) * gaussian_noise(x, generator)
        yield Step(index, len(steps), t, x0, x)


def ddim(
    denoise: Denoise, schedule: Schedule, x: Tensor, steps: Sequence[int], generator: torch.Generator, eta: float = 0.0
) -> Iterator[Step]:
    """Implicit sampling (Song et al. 2021, eq. 12) down the descending `steps`.

    `eta` scales the posterior's noise: 0 is deterministic after the start, 1 has the variance of `ddpm`.
    The last step yields the predicted x0; the released code leaves 0.01 of noise there (SPEC 1.14).
    """
    for index, (t, t_prev) in enumerate(pairwise((*steps, CLEAN))):
        x0 = denoise(x, t)
        if t_prev == CLEAN:
            x = x0
        else:
            added = eta * schedule.posterior_std(t, t_prev)
            kept = (schedule.noise(t_prev) ** 2 - added**2) ** 0.5
            x = schedule.signal(t_prev) * x0 + kept * schedule.epsilon(x, x0, t)
            if added > 0:
                x = x + added * gaussian_noise(x, generator)
        yield Step(index, len(steps), t, x0, x)


def gaussian_noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Standard normal noise of the shape, type and device of `like`."""
    return torch.randn(like.shape, generator=generator, dtype=like.dtype, device=like.device)


SAMPLERS = {"ddim": ddim, "ddpm": ddpm}
"""Samplers by the name a user states."""
