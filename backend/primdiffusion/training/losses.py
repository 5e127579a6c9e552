"""Objective of the default denoiser's network, and the evaluation error.

Random numbers are drawn on the device of their generator, which must be that of the samples.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.samplers import gaussian_noise
from primdiffusion.diffusion.schedule import Schedule
from primdiffusion.render.cuda.graph import RecordedLoss
from primdiffusion.training.config import NetworkTraining
from primdiffusion.training.latents import LatentSet

LEVELS = (50, 100, 300, 500, 700, 900)
"""Steps at which held-out error is reported."""
LEVEL_MEDIAN, LEVEL_WIDTH = 2.0, 1.4
"""Median of noise over signal at log-normal levels, in units of the samples' standard deviation, and standard deviation
of its logarithm."""
LOG_UNIFORM_SHARE = 0.2
"""Share of log-uniform levels among log-normal ones: no level stays untrained."""


def weighted_error(error: Float[Tensor, "b *s"], std: Float[Tensor, "b *s"]) -> Tensor:
    """Mean square of `error`, given in units of the closed form's posterior std, weighted by that std.

    Every level's weights have mean 1. The square of std would give the paper's x0 error (eq. 9), which the highest
    levels dominate.
    """
    weight = std.flatten(1)
    return (weight / weight.mean(1, keepdim=True) * error.flatten(1).square()).mean()


@dataclasses.dataclass
class RestObjective:
    """Loss of the local network: the rest, given the closed form's guess of the coefficients.

    On a CUDA device it is recorded with its gradients.
    """

    denoiser: PersonDenoiser
    people: LatentSet
    codec: LinearCodec
    vocabulary: AttributeVocabulary
    config: NetworkTraining

    def loss(self, generator: torch.Generator) -> Tensor:
        """Weighted x0 error of a random batch at random levels."""
        return self._recorded(*self.batch(generator))

    @functools.cached_property
    def _recorded(self) -> RecordedLoss:
        assert self.denoiser.local is not None
        return RecordedLoss(self.error, self.denoiser.local)

    @torch.no_grad()
    def batch(self, generator: torch.Generator) -> tuple[Tensor, ...]:
        """Draw noisy people; return their rest, guessed coefficients, step, condition and clean rest."""
        spread = float(self.denoiser.prior.rest_variance.mean().sqrt())
        t = random_steps(self.denoiser.schedule, self.config.batch, generator, self.config, spread)
        weights, indices = blends(self.people, len(t), self.config.blend_fraction, generator)
        condition = blend_conditions(self.people, indices, weights, self.vocabulary, self.config.unasked, generator)
        z = mix(self.people.latents, weights, indices)
        flip = torch.rand(len(z), 1, 1, 1, generator=generator, device=generator.device)[:, 0, 0, 0] < 0.5
        z[flip] = self.codec.mirror(z[flip])
        x = self.denoiser.schedule.q_sample(z, t, gaussian_noise(z, generator))
        signal, _ = self.denoiser.schedule.levels(t, z)
        _, clean = self.denoiser.prior.split(z)
        y, rest = self.denoiser.prior.split(x, signal)
        return rest, self.denoiser.coefficients(y, t, condition), t, condition, clean

    def error(self, *batch: Tensor) -> Tensor:
        """Weighted x0 error of a batch; does not wait for the device."""
        rest, coefficients, t, condition, clean = batch
        guess, std, correction = self.denoiser.rest_parts(rest, coefficients, t, condition)
        return weighted_error((guess - clean) / std + correction, std)


def random_steps(
    schedule: Schedule, count: int, generator: torch.Generator, config: NetworkTraining, spread: float = 1.0
) -> Int[Tensor, "b"]:
    """Random steps, distributed as `config.levels` says: uniform in t is the paper's (eq. 9).

    `spread` is the standard deviation of the samples. Uniform steps are nearly all so noisy that they drown what person
    components leave out.
    """
    if config.levels == "uniform":
        return torch.randint(schedule.length, (count,), generator=generator, device=generator.device)
    alpha_bar = schedule.alpha_bar.to(generator.device)
    noise_over_signal = 0.5 * ((1 - alpha_bar).log() - alpha_bar.log())
    low, high = noise_over_signal[0], noise_over_signal[-1]
    uniform, which = torch.rand(2, count, generator=generator, device=generator.device, dtype=alpha_bar.dtype)
    normal = torch.randn(count, generator=generator, device=generator.device, dtype=alpha_bar.dtype)
    about = math.log(LEVEL_MEDIAN * spread) + LEVEL_WIDTH * normal
    drawn = torch.where(which < LOG_UNIFORM_SHARE, low + (high - low) * uniform, about.clamp(low, high))
    return torch.searchsorted(noise_over_signal, drawn).clamp_max(schedule.length - 1)


def blends(
    people: LatentSet, count: int, share: float, generator: torch.Generator
) -> tuple[Float[Tensor, "b 2"], Int[Tensor, "b 2"]]:
    """Weights and indices of pairs of samples of one geometry; a `share` of pairs is mixed, the others are not.

    Colourings of one geometry have the same density, so their mixture is a valid sample of mixed colours. Weights
    exceed 0 ... 1 by so much that mixing preserves the variance of colours: E[p^2 + (1-p)^2] = 1.
    """
    geometry = people.geometry
    place, which, mixed, chosen = torch.rand(4, count, generator=generator, device=generator.device)
    first = (place * len(people)).long().clamp_max(len(people) - 1)
    counts = torch.bincount(geometry)
    starts = counts.cumsum(0) - counts
    own = geometry[first]
    second = starts[own] + (which * counts[own]).long()
    part = (0.5 + 3**0.5 * (mixed - 0.5)) * (chosen < share)
    return torch.stack([1 - part, part], dim=1), torch.stack([first, second], dim=1)


def mix(
    samples: Float[Tensor, "n *s"], weights: Float[Tensor, "b 2"], indices: Int[Tensor, "b 2"]
) -> Float[Tensor, "b *s"]:
    """Weighted sums of pairs of samples, in float32; samples of weight 0 are not read."""
    result = samples[indices[:, 0]].float()
    both = weights[:, 1] != 0
    if both.any():
        shape = (-1, *[1] * (result.ndim - 1))
        second = samples[indices[both, 1]].float()
        result[both] = weights[both, 0].reshape(shape) * result[both] + weights[both, 1].reshape(shape) * second
    return result


def blend_conditions(
    people: LatentSet,
    indices: Int[Tensor, "b 2"],
    weights: Float[Tensor, "b 2"],
    vocabulary: AttributeVocabulary,
    unasked: float,
    generator: torch.Generator,
) -> Float[Tensor, "b a"]:
    """Return conditions of a batch of `blends`: attributes common to both samples, some of them dropped at random."""
    first, second = people.condition[indices].unbind(1)
    same = (first == second) | (weights[:, 1:] == 0)
    return vocabulary.forget(torch.where(same, first, 0.0), unasked, generator)


Guess = Callable[[Tensor, Tensor], Tensor]


def x0_errors(
    guesses: Mapping[str, Guess],
    schedule: Schedule,
    samples: Float[Tensor, "n c h w"],
    levels: Sequence[int] = LEVELS,
    batch: int = 16,
) -> dict[str, dict[int, float]]:
    """Root mean square x0 error of each guess at each level, all on the same noise; in units of the samples."""
    errors = {name: dict.fromkeys(levels, 0.0) for name in guesses}
    generator = torch.Generator(samples.device).manual_seed(20_231)
    with torch.inference_mode():
        for level in levels:
            for chunk in samples.split(batch):
                z = chunk.float()
                t = torch.full((len(z),), level, device=z.device)
                x = schedule.q_sample(z, t, gaussian_noise(z, generator))
                for name, guess in guesses.items():
                    errors[name][level] += float((guess(x, t) - z).square().sum())
    return {name: {level: (e / samples.numel()) ** 0.5 for level, e in by.items()} for name, by in errors.items()}


def closed_form(denoiser: PersonDenoiser, single: bool) -> Guess:
    """The prior's closed-form guess, as a single Gaussian or as its mixture."""
    prior = denoiser.prior.gaussian() if single else denoiser.prior
    return lambda x, t: prior.denoise(x, *denoiser.schedule.levels(t, x))
