"""The closed-form person prior: a mixture of Gaussians over person components, and its exact denoiser.

A latent is z = mean + sum_i c_i u_i + r with orthonormal person components u and a rest r orthogonal to them. White
noise splits the same way, so the c and r parts of a noisy person are diffusions of their own, each with its own
denoiser. The posterior means below are exact up to the projection of r. They are the baseline that a network has to
beat and the base that it corrects.

Each part of the body has components of its own: among components of the whole body, the colour of a shirt bleeds into
trousers and skin. What belongs together is in the distribution of c. A kind of person is an outfit, a hair style and
shoes:

    c = centre of the kind + clothes + head + u shared,    u ~ N(0, 1)

`clothes` are Gaussian over all parts but the head, with a covariance for each group (an outfit of a sex, plain or
patterned), `head` is one with a covariance for each hair style, and `shared` are directions that join the two: the tone
of the skin. Kinds are many, with few people each, so what is common to a group is computed once.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.kinds import Block, expected, posterior
from primdiffusion.geometry.records import TensorRecord

IMPOSSIBLE = -1e4
"""Log weight of a kind that contradicts the condition, or is padding."""
CLEAN_NOISE = 1e-3
"""Noise of coefficients that are read as they are; some directions have no variance of their own."""
RIDGE = 1e-3
"""Added to the covariance of functions of coefficients, as a share of their mean variance."""
TOGETHER, TOGETHER_ON_CUDA = 8, 32
"""Samples whose distances to all kinds are in memory at once; more on CUDA devices, where launches take the time."""


@dataclasses.dataclass(frozen=True)
class PersonComponents(TensorRecord):
    """Latents [C, H, W] on K = H*W cells as P parts of N components (R = P*N), and a rest orthogonal to these."""

    mean: Float[Tensor, "c h w"]
    basis: Float[Tensor, "n k d"]
    """Components, orthonormal in each part, in the order of their variance: [j, i] is what component j of a cell's
    part adds to its d leading channels. Cells are in the order of their parts, `part.argsort(stable=True)`."""
    part: Int[Tensor, "k"]
    """Part of each cell, equal to its own mirror image; the last one is the head."""
    parity: Float[Tensor, "r"]
    """Sign of each coefficient in the mirror image of a person."""

    def split(self, z: Float[Tensor, "b c h w"], signal: Tensor | float = 1.0) -> tuple[Tensor, Tensor]:
        """Person coefficients [b, R] and rest [b, C, H, W] of latents whose mean is scaled by `signal` [b, 1, 1, 1]."""
        centred = z - signal * self.mean
        coefficients = self.along(centred)
        return coefficients, centred - self.picture(coefficients)

    def join(self, coefficients: Float[Tensor, "b r"], rest: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Latents of person coefficients and rest; the rest's share along the components is removed."""
        return self.mean + rest + self.picture(coefficients - self.along(rest))

    def outside(self, z: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The part orthogonal to the person components of latents without the mean."""
        return z - self.picture(self.along(z))

    def picture(self, coefficients: Float[Tensor, "b r"]) -> Float[Tensor, "b c h w"]:
        """Return the contribution of person coefficients to latents, without the mean."""
        own = coefficients.unflatten(1, (-1, len(self.basis))).unbind(1)
        drawn = torch.cat([part @ basis.flatten(1) for part, basis in zip(own, self.bases(), strict=True)], dim=1)
        channels = self.basis.shape[2]
        picture = coefficients.new_zeros((len(coefficients), *self.mean.flatten(1).shape))
        picture[:, :channels, self._order] = drawn.unflatten(1, (-1, channels)).mT
        return picture.unflatten(2, self.mean.shape[1:])

    def along(self, z: Float[Tensor, "b c h w"]) -> Float[Tensor, "b r"]:
        """Coefficients of latents without the mean."""
        cells = z.flatten(2)[:, : self.basis.shape[2], self._order].mT
        own = cells.split([basis.shape[1] for basis in self.bases()], dim=1)
        return torch.cat(
            [part.flatten(1) @ basis.flatten(1).T for part, basis in zip(own, self.bases(), strict=True)], dim=1
        )

    @property
    def _order(self) -> Int[Tensor, "k"]:
        return self.part.argsort(stable=True)

    def bases(self) -> tuple[Tensor, ...]:
        """The components of each part [n, cells, d]."""
        return self.basis.split(self._cells, dim=1)

    @functools.cached_property
    def _cells(self) -> list[int]:
        """Cells of each part; waits for the device."""
        return self.part.bincount().tolist()

    def picture_variance(self, variance: Float[Tensor, "r"]) -> Float[Tensor, "c h w"]:
        """Variance of `picture` for independent coefficients of these variances."""
        own = variance.unflatten(0, (-1, len(self.basis)))
        drawn = torch.cat(
            [torch.einsum("nkd,n->kd", basis.square(), part) for part, basis in zip(own, self.bases(), strict=True)]
        )
        picture = torch.zeros_like(self.mean).flatten(1)
        picture[: drawn.shape[1], self._order] = drawn.T
        return picture.view_as(self.mean)


@dataclasses.dataclass(frozen=True)
class PersonPrior(PersonComponents):
    """Distribution of latents, with G groups of at most M kinds."""

    rest_variance: Float[Tensor, "c h w"]
    """Variance of the entries of r."""
    log_weight: Float[Tensor, "g m"]
    """Logarithm of the probability of each kind; IMPOSSIBLE where a group has fewer kinds."""
    centre: Float[Tensor, "g m r"]
    axes: Float[Tensor, "g a o"]
    """Orthonormal rows: principal axes of the clothes of each group, among the leading o coefficients."""
    variance: Float[Tensor, "g a"]
    """Variance along each axis."""
    left: Float[Tensor, "g"]
    """Variance in all directions without an axis."""
    head: Int[Tensor, "g m"]
    """Index of each kind's head among the F heads."""
    head_axes: Float[Tensor, "f e s"]
    """Principal axes of each head, among the last s = R - o coefficients; s may be 0."""
    head_variance: Float[Tensor, "f e"]
    head_left: Float[Tensor, "f"]
    shared: Float[Tensor, "g q o"]
    """Directions that the clothes of each group share with the head, as long as their standard deviations."""
    head_shared: Float[Tensor, "f q s"]
    """The same of each head."""
    kind: Float[Tensor, "g m x"]
    """The condition (`AttributeVocabulary.encode`) of each kind; x may be 0."""

    def log_weights(self, condition: Float[Tensor, "b x"] | None) -> Float[Tensor, "b g m"] | Float[Tensor, "1 g m"]:
        """Return the log weights of the kinds, lowered by IMPOSSIBLE where a kind contradicts the condition.

        A category is requested where its block of the condition is not 0; a kind without its value is excluded. A value
        that no kind has excludes none.
        """
        if condition is None or not condition.shape[-1]:
            return self.log_weight[None]
        asked = (condition[:, None, None, :] * self.kind).sum(-1)  # requested values that a kind has
        return self.log_weight + IMPOSSIBLE * (asked.amax((1, 2), keepdim=True) - asked)

    def denoise_coefficients(
        self, y: Float[Tensor, "b r"], signal: Tensor, noise: Tensor, condition: Float[Tensor, "b x"] | None = None
    ) -> Float[Tensor, "b r"]:
        """E[c | y = signal c + noise eps]; `signal` and `noise` are [b, 1].

        Computed in float64: distances to centres are squares of numbers up to a hundred over noise down to 0.01;
        on the CPU for Apple GPUs, which have no float64.
        """
        real, blocks = self._real_kinds
        log_weights = _double(self.log_weights(condition)).flatten(1)[:, real].expand(len(y), -1)
        if condition is not None:
            possible = (log_weights > IMPOSSIBLE / 2).any(0).nonzero()[:, 0]
            log_weights, blocks = log_weights[:, possible], (blocks[0].chosen(possible), blocks[1].chosen(possible))
        found = [
            expected(blocks, weights, *(_double(each) for each in chunk))
            for weights, *chunk in _chunks(log_weights, y, signal, noise)
        ]
        return torch.cat(found).to(y)

    def kind_shares(self, c: Float[Tensor, "b r"]) -> Float[Tensor, "b g m"]:
        """Probability of each kind given clean person coefficients."""
        real, blocks = self._real_kinds
        weights = _double(self.log_weight).flatten()[None, real]
        one = torch.ones(len(c), 1, device=c.device)
        found = [
            posterior(blocks, weights, *(_double(each) for each in chunk))[0]
            for chunk in _chunks(c, one, CLEAN_NOISE * one)
        ]
        shares = torch.zeros(len(c), self.log_weight.numel()).to(found[0])
        shares[:, real] = torch.cat(found)
        return shares.unflatten(1, self.log_weight.shape)

    def expected_kind(self, c: Float[Tensor, "b r"]) -> Float[Tensor, "b x"]:
        """Probability of each attribute's value given clean person coefficients, laid out as conditions."""
        shares = self.kind_shares(c).flatten(1)
        return (shares @ self.kind.to(shares).flatten(0, 1)).to(c)

    @functools.cached_property
    def _real_kinds(self) -> tuple[Int[Tensor, "n"], tuple[Block, Block]]:
        """Places of kinds that are not padding, with their clothes and heads."""
        inner = self.axes.shape[2]
        real = _double(self.log_weight).flatten().gt(IMPOSSIBLE / 2).nonzero()[:, 0]
        centre = _double(self.centre).flatten(0, 1)[real]
        group = real // self.head.shape[1]
        clothes = Block.of_kinds(
            _double(self.axes), _double(self.variance), _double(self.left), _double(self.shared), group,
            centre[:, :inner],
        )  # fmt: skip
        heads = Block.of_kinds(
            _double(self.head_axes), _double(self.head_variance), _double(self.head_left), _double(self.head_shared),
            self.head.flatten().to(centre.device)[real], centre[:, inner:],
        )  # fmt: skip
        return real, (clothes, heads)

    def denoise_rest(self, rest: Float[Tensor, "b c h w"], signal: Tensor, noise: Tensor) -> Float[Tensor, "b c h w"]:
        """E[r | rest = signal r + noise eps]; `signal` and `noise` are [b, 1, 1, 1]."""
        return signal * self.rest_variance / (signal**2 * self.rest_variance + noise**2) * rest

    def denoise(
        self, x: Float[Tensor, "b c h w"], signal: Tensor, noise: Tensor, condition: Float[Tensor, "b x"] | None = None
    ) -> Float[Tensor, "b c h w"]:
        """E[z | x = signal z + noise eps]; `signal` and `noise` are [b, 1, 1, 1]."""
        y, rest = self.split(x, signal)
        coefficients = self.denoise_coefficients(y, signal[..., 0, 0], noise[..., 0, 0], condition)
        return self.join(coefficients, self.denoise_rest(rest, signal, noise))

    def marginal_variance(self) -> Float[Tensor, "r"]:
        """Variance of each person coefficient over the whole mixture."""
        weight = self.log_weight.exp()
        mean = torch.einsum("gm,gmr->r", weight, self.centre)
        between = torch.einsum("gm,gmr->r", weight, (self.centre - mean).square())
        heads = torch.zeros_like(self.head_left).index_add(0, self.head.flatten(), weight.flatten())
        clothes = torch.einsum("g,gi->i", weight.sum(1), _diagonal(self.axes, self.variance, self.left))
        head = torch.einsum("f,fi->i", heads, _diagonal(self.head_axes, self.head_variance, self.head_left))
        pairs, share = self._pairs()
        return torch.cat([clothes, head]) + torch.einsum("n,nqr->r", share, self.shared_by(*pairs).square()) + between

    def sample(
        self, count: int, generator: torch.Generator, condition: Float[Tensor, "1 x"] | None = None
    ) -> Float[Tensor, "count c h w"]:
        """Draw latents given the condition; drawn on the generator's device, returned on the prior's."""

        def normal(*shape: int) -> Tensor:
            draws = torch.randn(shape, generator=generator, dtype=self.mean.dtype, device=generator.device)
            return draws.to(self.mean.device)

        kinds = self._draw_kinds(count, generator, condition)
        group, head = kinds // self.head.shape[1], self.head.flatten()[kinds]
        clothes = _drawn(normal, self.axes[group], self.variance[group], self.left[group])
        heads = _drawn(normal, self.head_axes[head], self.head_variance[head], self.head_left[head])
        shared = torch.einsum("bq,bqr->br", normal(count, self.shared.shape[1]), self.shared_by(group, head))
        coefficients = self.centre.flatten(0, 1)[kinds] + shared + torch.cat([clothes, heads], dim=1)
        return self.join(coefficients, self.rest_variance.sqrt() * normal(count, *self.mean.shape))

    def sample_kinds(
        self, count: int, generator: torch.Generator, condition: Float[Tensor, "1 x"] | None = None
    ) -> Float[Tensor, "count x"]:
        """Draw kinds of people as conditions, as often as they occur among those that agree with `condition`."""
        return self.kind.flatten(0, 1)[self._draw_kinds(count, generator, condition)]

    def _draw_kinds(self, count: int, generator: torch.Generator, condition: Tensor | None) -> Int[Tensor, "n"]:
        weight = self.log_weights(condition)[0].flatten().softmax(0)
        drawn = torch.multinomial(weight.to(generator.device), count, replacement=True, generator=generator)
        return drawn.to(self.mean.device)

    def shared_by(self, group: Int[Tensor, "n"], head: Int[Tensor, "n"]) -> Float[Tensor, "n q r"]:
        """Directions that clothes of these groups share with these heads."""
        return torch.cat([self.shared[group], self.head_shared[head]], dim=2)

    def _pairs(self) -> tuple[tuple[Int[Tensor, "n"], Int[Tensor, "n"]], Float[Tensor, "n"]]:
        """Groups and heads that kinds put together, and the share of each pair."""
        heads = len(self.head_left)
        pair = torch.arange(len(self.head), device=self.head.device)[:, None] * heads + self.head
        share = torch.bincount(pair.flatten(), self.log_weight.exp().flatten())
        found = share.nonzero()[:, 0]
        return (found // heads, found % heads), share[found].to(self.mean)

    def heads_of(self, group: int) -> list[int]:
        """The heads that kinds of a group have."""
        return self.head[group][self.log_weight[group] > IMPOSSIBLE / 2].unique().tolist()

    def gaussian_of(self, group: int, head: int | None = None) -> GaussianOfKinds:
        """The mean and the covariance of all kinds of a group, or of those with one head."""
        chosen = self.log_weight[group] > IMPOSSIBLE / 2
        if head is not None:
            chosen &= self.head[group] == head
        weight, centre = self.log_weight[group][chosen].softmax(0), self.centre[group][chosen]
        heads = torch.zeros_like(self.head_left).index_add(0, self.head[group][chosen], weight)
        mean, inner = weight @ centre, self.axes.shape[2]
        own = self.variance[group].sqrt()[:, None] * self.axes[group]
        of_heads = ((heads[:, None] * self.head_variance).sqrt()[..., None] * self.head_axes)[heads > 0].flatten(0, 1)
        present = heads.nonzero()[:, 0]
        shared = heads[present].sqrt()[:, None, None] * self.shared_by(torch.full_like(present, group), present)
        rows = [
            functional.pad(own, (0, len(mean) - inner)),
            functional.pad(of_heads, (inner, 0)),
            shared.flatten(0, 1),
            weight.sqrt()[:, None] * (centre - mean),
        ]
        return GaussianOfKinds(mean, torch.cat(rows))

    def moved(
        self, c: Float[Tensor, "r"], slopes: Float[Tensor, "q r"], change: Float[Tensor, "q"]
    ) -> Float[Tensor, "r"]:
        """Coefficients whose functions with these slopes differ by `change`, and all else as it goes with that in the
        Gaussian of c's likeliest kind: c + S H^T (H S H^T)^-1 change."""
        group, kind = divmod(int(self.kind_shares(c[None]).argmax()), self.head.shape[1])
        factor = self.gaussian_of(group, int(self.head[group, kind])).factor
        along = slopes @ factor.T
        covariance = along @ along.T
        ridge = RIDGE * covariance.diagonal().mean() * torch.eye(len(covariance)).to(covariance)
        return c + torch.linalg.solve(covariance + ridge, change) @ along @ factor

    def gaussian_of_all(self, directions: int) -> GaussianOfKinds:
        """The mean and the leading directions of the covariance of all people."""
        whole = self.gaussian()
        factor = whole.variance[0].sqrt()[:, None] * whole.axes[0]
        return GaussianOfKinds(whole.centre[0, 0], factor[-directions:].flip(0))

    def gaussian(self) -> PersonPrior:
        """Return the single Gaussian with this mixture's mean and covariance, as a baseline."""
        weight = self.log_weight.exp()
        mean = torch.einsum("gm,gmr->r", weight, self.centre)
        offset = (self.centre - mean).flatten(0, 1)
        covariance = offset.T @ (weight.flatten()[:, None] * offset)
        pairs, share = self._pairs()
        shared = (share.sqrt()[:, None, None] * self.shared_by(*pairs)).flatten(0, 1)
        covariance += shared.T @ shared
        inner = self.axes.shape[2]
        heads = torch.zeros_like(self.head_left).index_add(0, self.head.flatten(), weight.flatten())
        covariance[:inner, :inner] += _pooled(weight.sum(1), self.axes, self.variance, self.left)
        covariance[inner:, inner:] += _pooled(heads, self.head_axes, self.head_variance, self.head_left)
        variance, vectors = torch.linalg.eigh(covariance)
        return dataclasses.replace(
            self,
            log_weight=torch.zeros_like(self.log_weight[:1, :1]),
            centre=mean[None, None],
            axes=vectors.T[None],
            variance=variance.clamp_min(0)[None],
            left=self.left[:1] * 0,
            head=self.head[:1, :1] * 0,
            head_axes=self.head_axes[:1, :0, :0],
            head_variance=self.head_variance[:1, :0],
            head_left=self.head_left[:1],
            shared=torch.zeros_like(variance)[None, None, :][:, :0],
            head_shared=self.head_shared[:1, :0, :0],
            kind=self.kind[:1, :1] * 0,
        )


class GaussianOfKinds(NamedTuple):
    """Coefficients c = mean + weights @ factor, with weights ~ N(0, 1)."""

    mean: Float[Tensor, "r"]
    factor: Float[Tensor, "w r"]

    def leading(self, directions: int) -> GaussianOfKinds:
        """The same with the leading directions of the covariance alone, orthogonal to each other."""
        _, vectors = torch.linalg.eigh((self.factor @ self.factor.T).double())
        return self._replace(factor=vectors.flip(1)[:, :directions].T.to(self.factor) @ self.factor)


def _diagonal(axes: Float[Tensor, "g a i"], variance: Float[Tensor, "g a"], left: Float[Tensor, "g"]) -> Tensor:
    """Variance of each coefficient in each group."""
    return left[:, None] + torch.einsum("gai,ga->gi", axes.square(), variance - left[:, None])


def _pooled(
    weight: Float[Tensor, "g"], axes: Float[Tensor, "g a i"], variance: Float[Tensor, "g a"], left: Float[Tensor, "g"]
) -> Float[Tensor, "i i"]:
    """The weighted mean of the groups' covariances."""
    rows, each = axes.flatten(0, 1), weight[:, None] * (variance - left[:, None])
    own = rows.T @ (each.flatten()[:, None] * rows)
    return own + (weight @ left) * torch.eye(axes.shape[2]).to(own)


def _drawn(
    normal: Callable[..., Tensor],
    axes: Float[Tensor, "b a i"],
    variance: Float[Tensor, "b a"],
    left: Float[Tensor, "b"],
) -> Float[Tensor, "b i"]:
    """A draw of each sample's Gaussian."""
    drawn = torch.einsum("ba,bai->bi", variance.sqrt() * normal(*variance.shape), axes)
    if axes.shape[1] == axes.shape[2]:
        return drawn
    white = normal(len(axes), axes.shape[2])
    return drawn + left.sqrt()[:, None] * (white - torch.einsum("bi,bai,baj->bj", white, axes, axes))


def _chunks(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    together = TOGETHER_ON_CUDA if tensors[0].device.type == "cuda" else TOGETHER
    return zip(*(tensor.split(together) for tensor in tensors), strict=True)


def _double(tensor: Tensor) -> Tensor:
    return tensor.cpu().double() if tensor.device.type == "mps" else tensor.double()
