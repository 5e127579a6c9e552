"""Bayes' rule for kinds of people: which kind noisy person coefficients are of, and what they are without the noise.

A kind has a centre, a Gaussian of its clothes, one of its head, and directions that the two share (`gaussian`). Kinds
are many and Gaussians few. Covariances have variances along some axes and one in all other directions: their inverses
are written down, and shared directions enter by Woodbury's identity. Everything is in float64, and for all kinds at
once; what does not depend on the noise is computed once (`Block.of_kinds`).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Block(NamedTuple):
    """Coefficients of some parts of the body: Gaussians, and the centres of n kinds."""

    axes: Float[Tensor, "g a i"]
    variance: Float[Tensor, "g a"]
    left: Float[Tensor, "g"]
    shared: Float[Tensor, "g q i"]
    shared_along: Float[Tensor, "g q a"]
    """Shared directions along the axes."""
    shared_gram: Float[Tensor, "g q q"]
    of: Int[Tensor, "n"]
    """The Gaussian of each kind."""
    centre: Float[Tensor, "n i"]
    length: Float[Tensor, "n"]
    """Squared lengths of the centres."""
    along: Float[Tensor, "n a"]
    """Centres along the axes of their Gaussians."""
    by_shared: Float[Tensor, "n q"]
    """Inner products of centres and shared directions."""

    @classmethod
    def of_kinds(
        cls, axes: Tensor, variance: Tensor, left: Tensor, shared: Tensor, of: Tensor, centre: Tensor
    ) -> Block:
        """A block of the fields of these names."""
        along, by_shared = centre.new_zeros(len(of), axes.shape[1]), centre.new_zeros(len(of), shared.shape[1])
        for group in of.unique().tolist():
            members = of == group
            along[members] = centre[members] @ axes[group].T
            by_shared[members] = centre[members] @ shared[group].T
        shared_along, gram = shared @ axes.mT, shared @ shared.mT
        length = centre.square().sum(1)
        return cls(axes, variance, left, shared, shared_along, gram, of, centre, length, along, by_shared)

    def chosen(self, kinds: Int[Tensor, "m"]) -> Block:
        """The block of some kinds, with their Gaussians."""
        groups, of = self.of[kinds].unique(return_inverse=True)
        of_kinds = {name: getattr(self, name)[kinds] for name in ("centre", "length", "along", "by_shared")}
        of_groups = {
            name: getattr(self, name)[groups]
            for name in ("axes", "variance", "left", "shared", "shared_along", "shared_gram")
        }
        return Block(of=of, **of_groups, **of_kinds)


class _Evidence(NamedTuple):
    """Statistics of a block's noisy coefficients under the Gaussian signal^2 covariance + noise^2 of each kind."""

    distance: Float[Tensor, "b n"]
    """Squared Mahalanobis distance to the kind's centre plus the logarithm of the determinant."""
    pull: Float[Tensor, "b n q"]
    """Inner products of the shared directions with the difference to the centre."""
    gram: Float[Tensor, "b g q q"]
    """Inner products of the shared directions."""


def _evidence(block: Block, y: Tensor, signal: Tensor, noise: Tensor) -> _Evidence:
    """Inner products are x.z / total_left + (x axes) extra (z axes)."""
    of, wide = block.of, signal[..., None]
    total = wide**2 * block.variance + noise[..., None] ** 2
    total_left = signal**2 * block.left + noise**2
    extra = 1 / total - 1 / total_left[..., None]
    y_along = _along(y, block.axes)
    weighted = y_along * extra
    determinant = total.log().sum(2) + (block.axes.shape[2] - block.axes.shape[1]) * total_left.log()
    own = y.square().sum(1, keepdim=True) / total_left + (weighted * y_along).sum(2) + determinant
    extra_along = extra[:, of] * block.along
    cross = y @ block.centre.T / total_left[:, of] + (weighted[:, of] * block.along).sum(2)
    between = block.length / total_left[:, of] + (extra_along * block.along).sum(2)
    by_y = _along(y, block.shared) / total_left[..., None]
    by_y += torch.einsum("bga,gqa->bgq", weighted, block.shared_along)
    by_centre = block.by_shared / total_left[:, of, None]
    by_centre += torch.einsum("bna,nqa->bnq", extra_along, block.shared_along[of])
    gram = block.shared_gram / total_left[..., None, None]
    gram += torch.einsum("bga,gpa,gqa->bgpq", extra, block.shared_along, block.shared_along)
    return _Evidence(
        own[:, of] - 2 * signal * cross + signal**2 * between,
        wide * (by_y[:, of] - wide * by_centre),
        wide[..., None] ** 2 * gram,
    )


def posterior(
    blocks: tuple[Block, Block], log_weights: Tensor, y: Tensor, signal: Tensor, noise: Tensor
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n q"]]:
    """Probability of each kind of the blocks given y, for log weights [b, n], and the shared part that it expects."""
    each_y = y.split([block.centre.shape[1] for block in blocks], dim=1)
    clothes, head = (_evidence(block, own, signal, noise) for block, own in zip(blocks, each_y, strict=True))
    heads = head.gram.shape[1]
    pairs, pair = (blocks[0].of * heads + blocks[1].of).unique(return_inverse=True)
    gram = clothes.gram[:, pairs // heads] + head.gram[:, pairs % heads]
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
    """E[c | y] of a block for kinds of these shares, whose shared directions are expected at u [b, n, q].

    That of one kind is e + gain (y - signal e), where e is its centre and shared part, with a gain for each direction.
    """
    gain_left = signal * block.left / (signal**2 * block.left + noise**2)
    wide = signal[..., None]
    gain = wide * block.variance / (wide**2 * block.variance + noise[..., None] ** 2) - gain_left[..., None]

    def of_groups(values: Float[Tensor, "b n ..."]) -> Float[Tensor, "b g ..."]:
        return values.new_zeros(len(values), len(block.left), *values.shape[2:]).index_add(1, block.of, values)

    shares, shared = of_groups(share), of_groups(share[..., None] * u)
    remaining = 1 - signal * gain_left
    mean = (share * remaining[:, block.of]) @ block.centre
    mean += _summed(remaining[..., None] * shared, block.shared)
    mean += (shares * gain_left).sum(1, keepdim=True) * y
    expected = of_groups(share[..., None] * block.along) + torch.einsum("bgq,gqa->bga", shared, block.shared_along)
    difference = shares[..., None] * _along(y, block.axes) - wide * expected
    return mean + _summed(gain * difference, block.axes)


def _along(y: Float[Tensor, "b i"], directions: Float[Tensor, "g q i"]) -> Float[Tensor, "b g q"]:
    """Inner products; einsum would copy the directions."""
    return (y @ directions.flatten(0, 1).T).unflatten(1, directions.shape[:2])


def _summed(weights: Float[Tensor, "b g q"], directions: Float[Tensor, "g q i"]) -> Float[Tensor, "b i"]:
    """Weighted sums of the directions."""
    return weights.flatten(1) @ directions.flatten(0, 1)
