"""Noise schedules: signal and noise at step t, and the posterior of an earlier step (paper eq. 4-7)."""

from __future__ import annotations

import dataclasses
import functools
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.geometry.records import TensorRecord

CLEAN = -1
"""The step before the first: no noise, alpha_bar = 1."""


@dataclasses.dataclass(frozen=True)
class Schedule(TensorRecord):
    """The variance schedule beta_t, t = 0 ... T-1, in float64; every coefficient below is derived from alpha_bar.

    A step is an integer t, or `CLEAN`. `t_prev` may be any earlier step, so a respaced chain needs no second schedule.
    """

    alpha_bar: Float[Tensor, "t"]
    """Cumulative product of 1 - beta (paper eq. 5), decreasing, float64."""

    @property
    def length(self) -> int:
        """T, the number of steps the schedule was defined with."""
        return self.alpha_bar.shape[0]

    def signal(self, t: int) -> float:
        """sqrt(alpha_bar_t), the factor on the clean sample; 1 at `CLEAN`."""
        return 1.0 if t == CLEAN else float(self.alpha_bar[t]) ** 0.5

    def noise(self, t: int) -> float:
        """sqrt(1 - alpha_bar_t), the standard deviation of the noise; 0 at `CLEAN`."""
        return 0.0 if t == CLEAN else (1.0 - float(self.alpha_bar[t])) ** 0.5

    def levels(self, t: Int[Tensor, "b"], like: Tensor) -> tuple[Tensor, Tensor]:
        """Signal and noise factors of a batch of steps, shaped [b, 1, ...] to multiply `like` [b, ...]."""
        shape = (-1, *([1] * (like.ndim - 1)))
        every = _levels(self.alpha_bar, like.dtype, like.device)
        signal, noise = (level.index_select(0, t).reshape(shape) for level in every)
        return signal, noise

    def q_sample(self, x0: Float[Tensor, "b *s"], t: Int[Tensor, "b"], noise: Float[Tensor, "b *s"]) -> Tensor:
        """Add noise of level t (paper eq. 5)."""
        signal, sigma = self.levels(t, x0)
        return signal * x0 + sigma * noise

    def epsilon(self, x: Tensor, x0: Tensor, t: int) -> Tensor:
        """The noise that x holds if the clean person is x0; raises ValueError at `CLEAN`, which holds none."""
        if t == CLEAN:
            raise ValueError("a clean sample holds no noise to be solved for; ask for a step t >= 0")
        return (x - self.signal(t) * x0) / self.noise(t)

    def posterior_mean(self, x: Tensor, x0: Tensor, t: int, t_prev: int) -> Tensor:
        """Mean of q(x_prev | x, x0) (paper eq. 6); exactly x0 when t_prev is `CLEAN`."""
        if t_prev == CLEAN:
            return x0
        alpha = self._alpha(t, t_prev)
        variance, variance_prev = self.noise(t) ** 2, self.noise(t_prev) ** 2
        return (alpha**0.5 * variance_prev * x + self.signal(t_prev) * (1.0 - alpha) * x0) / variance

    def posterior_std(self, t: int, t_prev: int) -> float:
        """Standard deviation sqrt(beta tilde) of q(x_prev | x, x0); 0 when t_prev is `CLEAN`."""
        alpha = self._alpha(t, t_prev)
        return (self.noise(t_prev) ** 2 / self.noise(t) ** 2 * (1.0 - alpha)) ** 0.5

    def half_log_snr(self, t: int) -> float:
        """lambda_t = log(signal / noise), time to exponential integrators; inf at `CLEAN`, -inf without signal."""
        if t == CLEAN:
            return math.inf
        alpha_bar = float(self.alpha_bar[t])
        return 0.5 * (math.log(alpha_bar) - math.log1p(-alpha_bar)) if alpha_bar > 0 else -math.inf

    def half_log_snr_gain(self, t: int, t_prev: int) -> float:
        """h = lambda_prev - lambda_t > 0: the length of one step back for an exponential integrator."""
        _check_back(t, t_prev)
        return self.half_log_snr(t_prev) - self.half_log_snr(t)

    def _alpha(self, t: int, t_prev: int) -> float:
        _check_back(t, t_prev)
        return (self.signal(t) / self.signal(t_prev)) ** 2


@functools.lru_cache(maxsize=16)
def _levels(alpha_bar: Tensor, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Signal and noise at every step: copying them to a device waits for it."""
    # rounded before it moves, as Apple GPUs have no float64
    every = alpha_bar.sqrt().to(dtype), (1.0 - alpha_bar).sqrt().to(dtype)
    return every[0].to(device), every[1].to(device)


def linear(length: int = 1000, first: float = 1e-4) -> Schedule:
    """beta linear in t: the paper's schedule (DDPM's; SPEC 1.4)."""
    return _from_betas(torch.linspace(first, 2e-2, length, dtype=torch.float64))


def sqrt_linear(length: int = 1000) -> Schedule:
    """sqrt(beta) linear in t: the released code's schedule, which it also calls linear (SPEC 1.4)."""
    return _from_betas(torch.linspace(1e-4**0.5, 2e-2**0.5, length, dtype=torch.float64) ** 2)


def fine_linear(length: int = 1000) -> Schedule:
    """beta linear in t from nearly 0, so that the first steps hold less noise than the finest detail of people.

    With DDPM's first beta of 1e-4 the noise never falls below 0.01, which is as large as the differences between faces.
    """
    return linear(length, 2e-3 / length)


SCHEDULES = {"linear": linear, "sqrt_linear": sqrt_linear, "fine_linear": fine_linear}
"""Schedules by their name in configurations and checkpoints."""


def schedule_name(schedule: Schedule) -> str:
    """Name of a schedule in `SCHEDULES`; ValueError for any other."""
    levels = schedule.alpha_bar.cpu()
    for name, make in SCHEDULES.items():
        if torch.equal(make().alpha_bar, levels):
            return name
    raise ValueError(f"this schedule has no name, which files need: choose one of {', '.join(SCHEDULES)}")


def trailing_steps(length: int, steps: int) -> list[int]:
    """`steps` evenly spaced t, descending, beginning at T-1: sampling starts at the schedule's own terminal noise."""
    _check_steps(length, steps)
    return [round(length - i * length / steps) - 1 for i in range(steps)]


def released_steps(length: int, steps: int) -> list[int]:
    """Timesteps of the released sampler: 991, 981, ... 1 for 100 of 1000 (SPEC 3), or all of T-1 ... 0.

    Raises ValueError between T / 2 and T: such a chain would begin far below the initial noise level.
    """
    if steps == length:
        return list(reversed(range(length)))
    if length // 2 < steps < length:
        raise ValueError(f"steps is {steps}: the released chain takes up to {length // 2} steps, or all {length}")
    _check_steps(length, steps)
    return [i * (length // steps) + 1 for i in reversed(range(steps))]


def early_steps(length: int, steps: int, last: int = 50) -> list[int]:
    """Evenly spaced descending t from T-1 to `last`, from which the last step goes to the clean sample at once.

    What is undecided there becomes its mean instead of a draw. A network that has not learned the finest detail draws
    it as coloured specks; its mean is smooth. With so many steps that they do not fit above `last`, the chain ends
    lower.
    """
    _check_steps(length, steps)
    lowest = min(last, length - steps)
    return [round(length - 1 - i * (length - 1 - lowest) / max(1, steps - 1)) for i in range(steps)]


CHAINS = {"trailing": trailing_steps, "early": early_steps, "released": released_steps}
"""Timesteps that a sampler visits, by their name in checkpoints."""


def _check_back(t: int, t_prev: int) -> None:
    if not CLEAN <= t_prev < t:
        raise ValueError(f"a step back goes from t to an earlier t_prev >= {CLEAN}; got t={t}, t_prev={t_prev}")


def _check_steps(length: int, steps: int) -> None:
    if not 1 <= steps <= length:
        raise ValueError(f"a schedule of {length} steps can be sampled in 1 to {length}; {steps} were requested")


def _from_betas(betas: Float[Tensor, "t"]) -> Schedule:
    return Schedule(torch.cumprod(1.0 - betas, dim=0))
