"""Bayes' rule for kinds of people: which kind noisy person coefficients are of, and what they are without the noise.

A kind has a centre, a Gaussian of its clothes, one of its head, and directions that the two share (`gaussian`). Kinds
are many and Gaussians few, so distances are computed for all kinds of a Gaussian together. Covariances have variances
along some axes and one in all other directions: their inverses are written down, and shared directions enter by
Woodbury's identity. Everything is in float64.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Block(NamedTuple):
    """Coefficients of some parts of the body: Gaussians, and the centres of n kinds."""

    axes: Float[Tensor, "g a i"]
    variance: Float[Tensor, "g a"]
    left: Float[Tensor, "g"]
    of: Int[Tensor, "n"]
    """The Gaussian of each kind."""
    centre: Float[Tensor, "n i"]
    shared: Float[Tensor, "g q i"]

    def groups(self) -> Iterator[tuple[int, Int[Tensor, "m"]]]:
        """Each Gaussian that a kind has, and the places of its kinds."""
        for group in self.of.unique().tolist():
            yield group, (self.of == group).nonzero()[:, 0]


class _Evidence(NamedTuple):
    """Statistics of a block's noisy coefficients under the Gaussian signal^2 covariance + noise^2 of each kind."""

    distance: Float[Tensor, "b n"]
    """Squared Mahalanobis distance to the kind's centre plus the logarithm of the determinant."""
    pull: Float[Tensor, "b n q"]
    """Inner products of the shared directions with the difference to the centre."""
    gram: Float[Tensor, "b g q q"]
    """Inner products of the shared directions."""


def _evidence(block: Block, y: Tensor, signal: Tensor, noise: Tensor) -> _Evidence:
    samples, kinds, directions = len(y), len(block.of), block.shared.shape[1]
    distance, pull = y.new_empty(samples, kinds), y.new_empty(samples, kinds, directions)
    gram = y.new_zeros(samples, len(block.left), directions, directions)
    for group, members in block.groups():
        axes, centre, shared = block.axes[group], block.centre[members], block.shared[group]
        total = signal**2 * block.variance[group] + noise**2
        total_left = signal**2 * block.left[group] + noise**2
        extra = 1 / total - 1 / total_left  # inner products: x.z / total_left + (x axes) extra (z axes)
        y_along, centre_along, shared_along = y @ axes.T, centre @ axes.T, shared @ axes.T
        weighted = y_along * extra
        own = y.square().sum(1, keepdim=True) / total_left + (weighted * y_along).sum(1, keepdim=True)
        cross = y @ centre.T / total_left + weighted @ centre_along.T
        between = centre.square().sum(1) / total_left + extra @ centre_along.square().T
        determinant = total.log().sum(1, keepdim=True) + (axes.shape[1] - axes.shape[0]) * total_left.log()
        distance[:, members] = own - 2 * signal * cross + signal**2 * between + determinant
        by_y = y @ shared.T / total_left + weighted @ shared_along.T
        by_centre = centre @ shared.T / total_left[..., None] + torch.einsum(
            "ba,na,qa->bnq", extra, centre_along, shared_along
        )
        pull[:, members] = signal[..., None] * (by_y[:, None] - signal[..., None] * by_centre)
        inner = shared @ shared.T / total_left[..., None]
        gram[:, group] = signal[..., None] ** 2 * (
            inner + torch.einsum("ba,pa,qa->bpq", extra, shared_along, shared_along)
        )
    return _Evidence(distance, pull, gram)


def posterior(
    blocks: tuple[Block, Block], log_weights: Tensor, y: Tensor, signal: Tensor, noise: Tensor
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n q"]]:
    """Probability of each kind of the blocks given y, for log weights [b, n], and the shared part that it expects."""
    each_y = y.split([block.centre.shape[1] for block in blocks], dim=1)
    clothes, head = (_evidence(block, own, signal, noise) for block, own in zip(blocks, each_y, strict=True))
    pairs, pair = torch.stack([block.of for block in blocks], dim=1).unique(dim=0, return_inverse=True)
    gram = clothes.gram[:, pairs[:, 0]] + head.gram[:, pairs[:, 1]]
    factor = torch.linalg.cholesky(gram + torch.eye(gram.shape[-1]).to(gram))
    pull = clothes.pull + head.pull
    u = torch.cholesky_solve(pull[..., None], factor[:, pair])[..., 0]
    determinant = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)[:, pair]
    distance = clothes.distance + head.distance - (pull * u).sum(-1) + determinant
    return (log_weights - distance / 2).softmax(1), u


def expected(
    blocks: tuple[Block, Block], log_weights: Tensor, y: Tensor, signal: Tensor, noise: Tensor
) -> Float[Tensor, "b r"]:
    """E[c | y = signal c + noise eps] over the kinds of the blocks, whose log weights are [b, n]."""
    share, u = posterior(blocks, log_weights, y, signal, noise)
    each_y = y.split([block.centre.shape[1] for block in blocks], dim=1)
    means = [_mean_of_block(block, share, u, own, signal, noise) for block, own in zip(blocks, each_y, strict=True)]
    return torch.cat(means, dim=1)


def _mean_of_block(
    block: Block, share: Tensor, u: Tensor, y: Tensor, signal: Tensor, noise: Tensor
) -> Float[Tensor, "b i"]:
    """E[c | y] of a block for kinds of these shares, whose shared directions are expected at u [b, n, q]."""
    mean = torch.zeros_like(y)
    for group, members in block.groups():
        own, axes = share[:, members], block.axes[group]
        expected = own @ block.centre[members] + (own[..., None] * u[:, members]).sum(1) @ block.shared[group]
        difference = own.sum(1, keepdim=True) * y - signal * expected
        gain_left = signal * block.left[group] / (signal**2 * block.left[group] + noise**2)
        gain = signal * block.variance[group] / (signal**2 * block.variance[group] + noise**2)
        mean += expected + gain_left * difference + ((gain - gain_left) * (difference @ axes.T)) @ axes
    return mean
