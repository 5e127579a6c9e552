"""The closed-form person prior: a mixture of Gaussians over person components, and its exact denoiser.

A latent is z = mean + sum_i c_i u_i + r with orthonormal person components u and a rest r orthogonal to them. White
noise splits the same way, so the c and r parts of a noisy person are diffusions of their own, each with its own
denoiser. For c ~ sum_k weight_k N(centre_k, cov_g(k)) and r of independent entries, the posterior means below are exact
up to the projection of r. They are the baseline that a network has to beat and the base that it corrects.

Parts k of the mixture are kinds of people (an outfit, a hair style, shoes): many, with few people each. So parts lie in
groups of one covariance, and what is common to a group is computed once.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.geometry.records import TensorRecord

IMPOSSIBLE = -1e4
"""Log weight of a part that contradicts the condition, or is padding."""


@dataclasses.dataclass(frozen=True)
class PersonPrior(TensorRecord):
    """Distribution of latents [C, H, W]; D = C*H*W, R person components, G groups of M mixture parts."""

    mean: Float[Tensor, "c h w"]
    basis: Float[Tensor, "r d"]
    """Orthonormal rows: person components in the order of their variance. They may live in the leading channels alone:
    d is a multiple of H*W, up to D."""
    parity: Float[Tensor, "r"]
    """Sign of each component in the mirror image of a person."""
    rest_variance: Float[Tensor, "c h w"]
    """Variance of the entries of r."""
    log_weight: Float[Tensor, "g m"]
    """Logarithm of the probability of each part; IMPOSSIBLE where a group has fewer parts."""
    centre: Float[Tensor, "g m r"]
    axes: Float[Tensor, "g r r"]
    """Orthonormal rows: principal axes of each group among the person components."""
    variance: Float[Tensor, "g r"]
    """Variance along each axis."""
    kind: Float[Tensor, "g m a"]
    """The condition (`AttributeVocabulary.encode`) of each part; a may be 0."""

    def split(self, z: Float[Tensor, "b c h w"], signal: Tensor | float = 1.0) -> tuple[Tensor, Tensor]:
        """Person coefficients [b, R] and rest [b, C, H, W] of latents whose mean is scaled by `signal` [b, 1, 1, 1]."""
        centred = z - signal * self.mean
        coefficients = self._along(centred)
        return coefficients, centred - self.picture(coefficients)

    def join(self, coefficients: Float[Tensor, "b r"], rest: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Latents of person coefficients and rest; the rest's share along the components is removed."""
        return self.mean + rest + self.picture(coefficients - self._along(rest))

    def outside(self, z: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The part orthogonal to the person components of latents without the mean."""
        return z - self.picture(self._along(z))

    def picture(self, coefficients: Float[Tensor, "b r"]) -> Float[Tensor, "b c h w"]:
        """Return the contribution of person coefficients to latents, without the mean."""
        flat = coefficients @ self.basis
        return functional.pad(flat, (0, self.mean.numel() - flat.shape[1])).unflatten(1, self.mean.shape)

    def _along(self, z: Float[Tensor, "b c h w"]) -> Float[Tensor, "b r"]:
        return z.flatten(1)[:, : self.basis.shape[1]] @ self.basis.T

    def log_weights(self, condition: Float[Tensor, "b a"] | None) -> Float[Tensor, "b g m"] | Float[Tensor, "1 g m"]:
        """Return the log weights of the parts, lowered by IMPOSSIBLE where a part contradicts the condition.

        A category is requested where its block of the condition is not 0; a part without its value is excluded. A value
        that no part has excludes none.
        """
        if condition is None or not condition.shape[-1]:
            return self.log_weight[None]
        asked = (condition[:, None, None, :] * self.kind).sum(-1)  # requested values that a part has
        return self.log_weight + IMPOSSIBLE * (asked.amax((1, 2), keepdim=True) - asked)

    def denoise_coefficients(
        self, y: Float[Tensor, "b r"], signal: Tensor, noise: Tensor, condition: Float[Tensor, "b a"] | None = None
    ) -> Float[Tensor, "b r"]:
        """E[c | y = signal c + noise eps]; `signal` and `noise` are [b, 1].

        Computed in float64: distances to centres are squares of numbers up to a hundred over noise down to 0.01;
        on the CPU for Apple GPUs, which have no float64.
        """
        given, (y, signal, noise) = y, (_double(part) for part in (y, signal, noise))
        axes, variance = _double(self.axes), _double(self.variance)
        centre = torch.einsum("gmr,gir->gmi", _double(self.centre), axes)
        in_axes = torch.einsum("br,gir->bgi", y, axes)
        total = signal[:, :, None] ** 2 * variance + noise[:, :, None] ** 2
        distance = (
            (in_axes.square() / total).sum(-1)[..., None]
            - 2 * signal[:, :, None] * torch.einsum("bgi,gmi->bgm", in_axes / total, centre)
            + signal[:, :, None] ** 2 * torch.einsum("bgi,gmi->bgm", 1 / total, centre.square())
        )
        evidence = _double(self.log_weights(condition)) - 0.5 * (distance + total.log().sum(-1)[..., None])
        share = evidence.flatten(1).softmax(-1).view_as(evidence)
        expected = torch.einsum("bgm,gmi->bgi", share, centre)
        gain = signal[:, :, None] * variance / total
        mean = gain * (share.sum(-1)[..., None] * in_axes - signal[:, :, None] * expected) + expected
        return torch.einsum("bgi,gir->br", mean, axes).to(given)

    def denoise_rest(self, rest: Float[Tensor, "b c h w"], signal: Tensor, noise: Tensor) -> Float[Tensor, "b c h w"]:
        """E[r | rest = signal r + noise eps]; `signal` and `noise` are [b, 1, 1, 1]."""
        return signal * self.rest_variance / (signal**2 * self.rest_variance + noise**2) * rest

    def denoise(
        self, x: Float[Tensor, "b c h w"], signal: Tensor, noise: Tensor, condition: Float[Tensor, "b a"] | None = None
    ) -> Float[Tensor, "b c h w"]:
        """E[z | x = signal z + noise eps]; `signal` and `noise` are [b, 1, 1, 1]."""
        y, rest = self.split(x, signal)
        coefficients = self.denoise_coefficients(y, signal[..., 0, 0], noise[..., 0, 0], condition)
        return self.join(coefficients, self.denoise_rest(rest, signal, noise))

    def posterior(
        self, precision: Float[Tensor, "r r"], vector: Float[Tensor, "r"]
    ) -> tuple[Float[Tensor, "r"], float]:
        """E[c] given an observation of likelihood exp(vector^T c - c^T precision c / 2), and the logarithm of that
        likelihood's mean over the prior.
        """
        logits, mean, _ = self._posterior(precision, vector)
        share = logits.flatten().softmax(0).view_as(logits)
        return torch.einsum("gm,gmr->r", share, mean).to(vector), float(logits.flatten().logsumexp(0))

    def posterior_sample(
        self, precision: Float[Tensor, "r r"], vector: Float[Tensor, "r"], generator: torch.Generator
    ) -> Float[Tensor, "r"]:
        """A draw of c given such an observation: a part of the mixture, then its Gaussian."""
        logits, mean, factor = self._posterior(precision, vector)
        part = int(torch.multinomial(logits.flatten().softmax(0), 1, generator=generator))
        noise = torch.randn(len(vector), 1, generator=generator, dtype=mean.dtype)
        spread = torch.linalg.solve_triangular(factor[part // logits.shape[1]].mT, noise, upper=True)
        return (mean.flatten(0, 1)[part] + spread[:, 0]).to(vector)

    def _posterior(self, precision: Tensor, vector: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logarithms of the parts' weights times their mean likelihoods [g, m], their means given the observation
        [g, m, r], and lower factors of their precisions [g, r, r].
        """
        axes, variance, centre = (_double(part) for part in (self.axes, self.variance, self.centre))
        own = (axes.mT / variance[:, None, :]) @ axes
        from_centre = centre @ own
        factor = torch.linalg.cholesky(_double(precision) + own)
        total = from_centre + _double(vector)
        mean = torch.cholesky_solve(total.mT, factor).mT
        spread = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * variance.log().sum(-1)
        evidence = (mean * total).sum(-1) / 2 - (from_centre * centre).sum(-1) / 2 - spread[:, None]
        return _double(self.log_weight) + evidence, mean, factor

    def group_means(self) -> Float[Tensor, "g r"]:
        """Mean coefficients of each group's parts."""
        weight = self.log_weight.softmax(1)
        return torch.einsum("gm,gmr->gr", weight, self.centre)

    def marginal_variance(self) -> Float[Tensor, "r"]:
        """Variance of each person coefficient over the whole mixture."""
        weight = self.log_weight.exp()
        within = torch.einsum("g,gij,gi->j", weight.sum(1), self.axes.square(), self.variance)
        mean = torch.einsum("gm,gmr->r", weight, self.centre)
        return within + torch.einsum("gm,gmr->r", weight, (self.centre - mean).square())

    def sample(
        self, count: int, generator: torch.Generator, condition: Float[Tensor, "1 a"] | None = None
    ) -> Float[Tensor, "count c h w"]:
        """Draw latents given the condition; drawn on the generator's device, returned on the prior's."""

        def normal(*shape: int) -> Tensor:
            draws = torch.randn(shape, generator=generator, dtype=self.mean.dtype, device=generator.device)
            return draws.to(self.mean.device)

        part = self._draw_parts(count, generator, condition)
        group = part // self.log_weight.shape[1]
        in_axes = self.variance[group].sqrt() * normal(count, self.basis.shape[0])
        coefficients = torch.einsum("bij,bi->bj", self.axes[group], in_axes) + self.centre.flatten(0, 1)[part]
        return self.join(coefficients, self.rest_variance.sqrt() * normal(count, *self.mean.shape))

    def sample_kinds(
        self, count: int, generator: torch.Generator, condition: Float[Tensor, "1 a"] | None = None
    ) -> Float[Tensor, "count a"]:
        """Draw kinds of people as conditions, as often as they occur among those that agree with `condition`."""
        return self.kind.flatten(0, 1)[self._draw_parts(count, generator, condition)]

    def _draw_parts(self, count: int, generator: torch.Generator, condition: Tensor | None) -> Int[Tensor, "n"]:
        weight = self.log_weights(condition)[0].flatten().softmax(0)
        drawn = torch.multinomial(weight.to(generator.device), count, replacement=True, generator=generator)
        return drawn.to(self.mean.device)

    def gaussian(self) -> PersonPrior:
        """Return the single Gaussian with this mixture's mean and covariance, as a baseline."""
        weight = self.log_weight.exp()
        mean = torch.einsum("gm,gmr->r", weight, self.centre)
        within = torch.einsum("g,gij,gi,gik->jk", weight.sum(1), self.axes, self.variance, self.axes)
        offset = self.centre - mean
        covariance = within + torch.einsum("gm,gmj,gmk->jk", weight, offset, offset)
        variance, vectors = torch.linalg.eigh(covariance)
        return dataclasses.replace(
            self,
            log_weight=torch.zeros_like(self.log_weight[:1, :1]),
            centre=mean[None, None],
            axes=vectors.T[None],
            variance=variance.clamp_min(0)[None],
            kind=self.kind[:1, :1] * 0,
        )


def _double(tensor: Tensor) -> Tensor:
    return tensor.cpu().double() if tensor.device.type == "mps" else tensor.double()
