"""The default denoiser: a closed-form person prior, corrected by one network over components and one over the grid."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.local_unet import LocalUNet, LocalUNetConfig, PersonNetwork, PersonNetworkConfig
from primdiffusion.diffusion.schedule import Schedule


@dataclasses.dataclass(frozen=True)
class DenoiserConfig:
    """Networks of the default denoiser; None means the closed form alone."""

    person: PersonNetworkConfig | None = dataclasses.field(default_factory=PersonNetworkConfig)
    """Network over the person components."""
    local: LocalUNetConfig | None = dataclasses.field(default_factory=LocalUNetConfig)
    """Network over the grid."""


class PersonDenoiser(nn.Module):
    """x0 guess of noisy latents: E[c | .] and E[r | .] of the prior plus learned corrections.

    Corrections are in units of the closed form's own posterior standard deviation, so they are of order 1 at every
    noise level and vanish with the noise. They start at 0: an untrained denoiser is the prior's. The two parts are
    orthogonal, so the squared error is the sum of theirs and each can be trained alone.
    """

    component_std: Tensor
    picture_std: Tensor
    prior_parity: Tensor
    prior_rest_variance: Tensor

    def __init__(self, config: DenoiserConfig, prior: PersonPrior, schedule: Schedule):
        super().__init__()
        self.config, self.schedule = config, schedule
        self.network_dtype = torch.float32
        for field in dataclasses.fields(PersonPrior):
            self.register_buffer(f"prior_{field.name}", getattr(prior, field.name))
        component_std = prior.marginal_variance().sqrt()
        self.register_buffer("component_std", component_std, persistent=False)
        self.register_buffer("picture_std", _picture_std(prior, component_std), persistent=False)
        channels, grid, components = prior.mean.shape[0], prior.mean.shape[-1], prior.basis.shape[0]
        asked = prior.kind.shape[-1]
        self.person = PersonNetwork(components, asked, config.person) if config.person else None
        drawn = -(-prior.basis.shape[1] // grid**2)  # channels that person components draw in
        self.local = LocalUNet(channels, components, grid, asked, config.local, drawn) if config.local else None
        if self.local is not None:
            self.local = self.local.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @property
    def prior(self) -> PersonPrior:
        """The closed-form part."""
        return PersonPrior(
            **{field.name: self.get_buffer(f"prior_{field.name}") for field in dataclasses.fields(PersonPrior)}
        )

    def forward(
        self,
        x: Float[Tensor, "b c h w"],
        t: Int[Tensor, "b"],
        condition: Float[Tensor, "b a"] | None = None,
        guidance: float = 1.0,
    ) -> Float[Tensor, "b c h w"]:
        """Return the x0 guess for latents x at steps t, given `condition` (None: unconditional).

        `guidance` w makes the coefficients u + w (c - u) of the unconditional guess u and the conditional guess c (Ho
        and Salimans 2022). The rest, which takes most of the time, is the conditional guess that follows from them.
        """
        signal, _ = self.schedule.levels(t, x)
        prior = self.prior
        y, rest = prior.split(x, signal)
        coefficients = self.coefficients(y, t, condition)
        if condition is not None and guidance != 1.0:
            coefficients = torch.lerp(self.coefficients(y, t), coefficients, guidance)
        return prior.join(coefficients, self.rest(rest, coefficients, t, condition))

    def coefficients(
        self, y: Float[Tensor, "b r"], t: Int[Tensor, "b"], condition: Float[Tensor, "b a"] | None = None
    ) -> Float[Tensor, "b r"]:
        """Denoise person coefficients."""
        signal, noise = self.schedule.levels(t, y)
        guess = self.prior.denoise_coefficients(y, signal, noise, condition)
        if self.person is None:
            return guess
        std = self.component_std
        total = (signal**2 * std**2 + noise**2).sqrt()
        with self._precision(y):
            correction = self.person(y / total, guess / std, t, condition)
        return guess + std * noise / total * correction

    def rest(
        self,
        rest: Float[Tensor, "b c h w"],
        coefficients: Float[Tensor, "b r"],
        t: Int[Tensor, "b"],
        condition: Float[Tensor, "b a"] | None = None,
    ) -> Float[Tensor, "b c h w"]:
        """Denoise the rest, given denoised person coefficients."""
        guess, deviation, correction = self.rest_parts(rest, coefficients, t, condition)
        return guess + deviation * correction

    def rest_parts(
        self,
        rest: Float[Tensor, "b c h w"],
        coefficients: Float[Tensor, "b r"],
        t: Int[Tensor, "b"],
        condition: Float[Tensor, "b a"] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the closed-form guess, its posterior standard deviation, and the correction in units of that."""
        signal, noise = self.schedule.levels(t, rest)
        prior = self.prior
        total = torch.addcmul(noise**2, signal**2, prior.rest_variance)
        guess = rest * (signal * prior.rest_variance / total)
        total = total.sqrt()
        deviation = noise * prior.rest_variance.sqrt() / total
        if self.local is None:
            return guess, deviation, torch.zeros_like(guess)
        picture = prior.picture(coefficients) / self.picture_std[:, None, None]
        with self._precision(rest):
            correction = self.local(rest / total, picture, coefficients / self.component_std, t, condition)
        return guess, deviation, correction.float()

    def _precision(self, like: Tensor) -> torch.autocast:
        """Autocast for the networks only: the closed form needs full precision."""
        return torch.autocast(like.device.type, self.network_dtype, enabled=self.network_dtype != torch.float32)


def _picture_std(prior: PersonPrior, component_std: Float[Tensor, "r"]) -> Float[Tensor, "c"]:
    """Root mean square over the grid of what the person components draw in each channel."""
    energy = component_std**2 @ prior.basis**2
    energy = functional.pad(energy, (0, prior.mean.numel() - len(energy)))
    return energy.unflatten(0, prior.mean.shape).mean((1, 2)).sqrt().clamp_min(1e-6)
