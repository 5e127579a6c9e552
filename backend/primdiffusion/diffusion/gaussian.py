"""What is known of people in closed form: Gaussian person components, a mixture of them, and their exact denoiser.

A latent is z = mean + sum_i c_i u_i + r with orthonormal person components u and a rest r orthogonal to them. White
noise splits the same way, so the c and r parts of a noisy person are diffusions of their own, each with its own
denoiser. For c ~ sum_m weight_m N(centre_m, cov_m) and r of independent entries, the posterior means below are exact
up to the projection of r. They are the yardstick a network has to beat and the base it starts from.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.geometry.records import TensorRecord


@dataclasses.dataclass(frozen=True)
class PersonPrior(TensorRecord):
    """Distribution of latents [C, H, W]; D = C*H*W, R person components, M mixture parts (1: a Gaussian)."""

    mean: Float[Tensor, "c h w"]
    basis: Float[Tensor, "r d"]
    """Orthonormal rows: person components in the order of their variance."""
    parity: Float[Tensor, "r"]
    """Sign of each component in the mirror image of a person."""
    rest_variance: Float[Tensor, "c h w"]
    """Variance of the entries of r."""
    weight: Float[Tensor, "m"]
    """Probability of each part."""
    centre: Float[Tensor, "m r"]
    axes: Float[Tensor, "m r r"]
    """Orthonormal rows: principal axes of each part among the person components."""
    variance: Float[Tensor, "m r"]
    """Variance along each axis."""

    def split(self, z: Float[Tensor, "b c h w"], signal: Tensor | float = 1.0) -> tuple[Tensor, Tensor]:
        """Person coefficients [b, R] and rest [b, C, H, W] of latents whose mean is scaled by `signal` [b, 1, 1, 1]."""
        centred = z - signal * self.mean
        coefficients = centred.flatten(1) @ self.basis.T
        return coefficients, centred - (coefficients @ self.basis).unflatten(1, self.mean.shape)

    def join(self, coefficients: Float[Tensor, "b r"], rest: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Latents of person coefficients and rest; the rest's share along the components is removed."""
        coefficients = coefficients - rest.flatten(1) @ self.basis.T
        return self.mean + rest + (coefficients @ self.basis).unflatten(1, self.mean.shape)

    def denoise_coefficients(self, y: Float[Tensor, "b r"], signal: Tensor, noise: Tensor) -> Float[Tensor, "b r"]:
        """E[c | y = signal c + noise eps]; `signal` and `noise` are [b, 1]."""
        in_axes = torch.einsum("mij,bmj->bmi", self.axes, y[:, None] - signal[:, :, None] * self.centre)
        total = signal[:, :, None] ** 2 * self.variance + noise[:, :, None] ** 2
        mean = (
            torch.einsum("mij,bmi->bmj", self.axes, signal[:, :, None] * self.variance / total * in_axes) + self.centre
        )
        log_likelihood = self.weight.log() - 0.5 * (in_axes.square() / total + total.log()).sum(-1)
        return torch.einsum("bm,bmr->br", log_likelihood.softmax(-1), mean)

    def denoise_rest(self, rest: Float[Tensor, "b c h w"], signal: Tensor, noise: Tensor) -> Float[Tensor, "b c h w"]:
        """E[r | rest = signal r + noise eps]; `signal` and `noise` are [b, 1, 1, 1]."""
        return signal * self.rest_variance / (signal**2 * self.rest_variance + noise**2) * rest

    def denoise(self, x: Float[Tensor, "b c h w"], signal: Tensor, noise: Tensor) -> Float[Tensor, "b c h w"]:
        """E[z | x = signal z + noise eps]; `signal` and `noise` are [b, 1, 1, 1]."""
        y, rest = self.split(x, signal)
        return self.join(
            self.denoise_coefficients(y, signal[..., 0, 0], noise[..., 0, 0]), self.denoise_rest(rest, signal, noise)
        )

    def marginal_variance(self) -> Float[Tensor, "r"]:
        """Variance of each person coefficient over the whole mixture."""
        second = torch.einsum("mij,mi->mj", self.axes.square(), self.variance) + self.centre.square()
        return self.weight @ second - (self.weight @ self.centre).square()

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "count c h w"]:
        """Random latents of this distribution."""

        def normal(*shape: int) -> Tensor:
            return torch.randn(shape, generator=generator, dtype=self.mean.dtype, device=self.mean.device)

        part = torch.multinomial(self.weight, count, replacement=True, generator=generator)
        in_axes = self.variance[part].sqrt() * normal(count, self.basis.shape[0])
        coefficients = torch.einsum("bij,bi->bj", self.axes[part], in_axes) + self.centre[part]
        return self.join(coefficients, self.rest_variance.sqrt() * normal(count, *self.mean.shape))

    def gaussian(self) -> PersonPrior:
        """The single Gaussian with this mixture's mean and covariance: the yardstick without clusters."""
        mean = self.weight @ self.centre
        within = torch.einsum("m,mij,mi,mik->jk", self.weight, self.axes, self.variance, self.axes)
        offset = self.centre - mean
        covariance = within + torch.einsum("m,mj,mk->jk", self.weight, offset, offset)
        variance, vectors = torch.linalg.eigh(covariance)
        one = torch.ones_like(self.weight[:1])
        return dataclasses.replace(
            self, weight=one, centre=mean[None], axes=vectors.T[None], variance=variance.clamp_min(0)[None]
        )
