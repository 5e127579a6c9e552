"""Fit the closed-form person prior, a mixture of Gaussians over person components, and the body shapes that go with it.

The mixture has one part for each kind of person that the training people suggest. Kinds are many (16 outfits of a sex,
9 styles of hair and hat, 6 pairs of shoes, plain or patterned) and people of one kind few or none, so parts share what
they can: a covariance for each group (outfit and pattern), which small groups lean on their like for, and a mean that
is a sum of effects: of the group, of the hair, of the shoes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.gaussian import IMPOSSIBLE, PersonPrior
from primdiffusion.diffusion.model import ShapePrior
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import CHUNK, LatentSet

RIDGE = 4.0
"""People without any effect that every effect is estimated with."""

Values = tuple[int, ...]
"""The value of each of some attributes, as its number in the vocabulary; -1 where unknown."""


class Mixture(NamedTuple):
    """Fields of `PersonPrior`: G groups of at most M parts over R components."""

    log_weight: Float[Tensor, "g m"]
    centre: Float[Tensor, "g m r"]
    axes: Float[Tensor, "g r r"]
    variance: Float[Tensor, "g r"]
    kind: Float[Tensor, "g m a"]


def fit_mixture(
    c: Float[Tensor, "n r"], condition: Float[Tensor, "n a"], vocabulary: AttributeVocabulary, config: PriorConfig
) -> Mixture:
    """Parts for all kinds that can be put together of the people's attributes; a single Gaussian if they have none."""
    names = [name for name in config.groups if name in vocabulary.categories]
    features = [kept for feature in config.features if (kept := [n for n in feature if n in vocabulary.categories])]
    values = _values(condition, vocabulary)
    keys = [names, *features]
    rows = [[tuple(values[name][i] for name in key) for i in range(len(c))] for key in keys]
    choices = [sorted(set(row)) for row in rows]
    effects = _effects(c, rows, choices)
    left = c - sum(effects[k][[choices[k].index(v) for v in rows[k]]] for k in range(len(keys)))
    axes, variance = _covariances(left, rows[0], choices[0], config.lean * c.shape[1])
    groups = [_parts(group, keys, rows, choices) for group in choices[0]]
    most = max(map(len, groups))
    log_weight = torch.full((len(groups), most), IMPOSSIBLE)
    centre = torch.zeros(len(groups), most, c.shape[1])
    kind = torch.zeros(len(groups), most, condition.shape[1])
    for g, parts in enumerate(groups):
        for m, (log_share, part) in enumerate(parts):
            log_weight[g, m] = log_share
            centre[g, m] = sum(effects[k][choices[k].index(v)] for k, v in enumerate(part))
            kind[g, m] = _condition(part, keys, vocabulary)
    return Mixture(log_weight - log_weight.flatten().logsumexp(0), centre, axes, variance, kind)


def _values(condition: Float[Tensor, "n a"], vocabulary: AttributeVocabulary) -> dict[str, list[int]]:
    """Number of each person's value of each category; -1 where unknown."""
    found = {}
    for name, block in vocabulary.blocks().items():
        known = condition[:, block]
        found[name] = torch.where(known.amax(1) > 0, known.argmax(1), -1).tolist()
    return found


def _effects(
    c: Float[Tensor, "n r"], rows: Sequence[Sequence[Values]], choices: Sequence[Sequence[Values]]
) -> list[Float[Tensor, "v r"]]:
    """What every choice of every key adds to the mean, by ridge regression."""
    blocks = [
        torch.nn.functional.one_hot(torch.tensor([options.index(v) for v in row]), len(options)).float()
        for row, options in zip(rows, choices, strict=True)
    ]
    design = torch.cat(blocks, dim=1).double()
    normal = design.T @ design + RIDGE * torch.eye(design.shape[1], dtype=torch.float64)
    effect = torch.linalg.solve(normal, design.T @ c.double()).float()
    return list(effect.split([len(options) for options in choices]))


def _covariances(
    left: Float[Tensor, "n r"], group: Sequence[Values], groups: Sequence[Values], pull: float
) -> tuple[Float[Tensor, "g r r"], Float[Tensor, "g r"]]:
    """Principal axes and variances of each group's people, and of `pull` of all groups that agree in the last value."""
    of = torch.tensor([groups.index(v) for v in group])
    scatter = [left[of == g].T @ left[of == g] for g in range(len(groups))]
    counts = [int((of == g).sum()) for g in range(len(groups))]
    axes, variances = [], []
    for g, own in enumerate(groups):
        like = [other for other, values in enumerate(groups) if values[-1:] == own[-1:]]
        pooled = sum(scatter[other] for other in like) / sum(counts[other] for other in like)
        covariance = (scatter[g] + pull * pooled) / (counts[g] + pull)
        value, vector = torch.linalg.eigh(covariance.double())
        axes.append(vector.T.float())
        variances.append(value.clamp_min(max(float(value.max()) * 1e-7, 1e-12)).float())
    return torch.stack(axes), torch.stack(variances)


def _parts(
    group: Values,
    keys: Sequence[Sequence[str]],
    rows: Sequence[Sequence[Values]],
    choices: Sequence[Sequence[Values]],
) -> list[tuple[float, tuple[Values, ...]]]:
    """Logarithm of the share and the values of every part of a group: all choices of features that go with it.

    Features go with a group where the attributes that both name agree; their shares are those among all people of whom
    these attributes are true.
    """
    total = len(rows[0])
    parts = [(math.log(rows[0].count(group) / total), (group,))]
    for names, row, options in zip(keys[1:], rows[1:], choices[1:], strict=True):
        shared = [(names.index(name), keys[0].index(name)) for name in names if name in keys[0]]
        fitting = [v for v in options if all(v[mine] == group[theirs] for mine, theirs in shared)]
        counts = Counter(row)
        people = sum(counts[v] for v in fitting)
        parts = [(share + math.log(counts[v] / people), (*values, v)) for share, values in parts for v in fitting]
    return parts


def _condition(
    part: Sequence[Values], keys: Sequence[Sequence[str]], vocabulary: AttributeVocabulary
) -> Float[Tensor, "a"]:
    """The condition that a part meets."""
    condition, blocks = torch.zeros(vocabulary.width), vocabulary.blocks()
    for names, values in zip(keys, part, strict=True):
        for name, value in zip(names, values, strict=True):
            if value >= 0:
                condition[blocks[name].start + value] = 1.0
    return condition


def fit_prior(
    people: LatentSet, codec: LinearCodec, vocabulary: AttributeVocabulary, config: PriorConfig
) -> PersonPrior:
    """Principal components of people and their mirror images, and a mixture of Gaussians over them.

    Components are found from Gram matrices of the even and the odd parts of people, so that each is even or odd under
    the mirror. Variances of trailing components fitted to few people are too large for new people and those of the rest
    too small: both are corrected by leaving `config.folds` parts of the geometries out in turn. Mean and rest are those
    of detailed people.
    """
    parts = _mirror_parts(people, codec, config.channels)
    grams = [part @ part.T for _, part in parts]
    vectors = [_principal(gram, config.components) for gram in grams]
    signs, order = _merge([variance for variance, _ in vectors], config.components)
    rows = [
        (vector.T @ part) / (variance * len(people)).sqrt()[:, None]
        for (_, part), (variance, vector) in zip(parts, vectors, strict=True)
    ]
    del parts
    detailed = int(people.detailed)
    mean = people.latents[:detailed].float().mean(0)
    mean = (mean + codec.mirror(mean)) / 2
    basis = torch.linalg.qr(torch.cat(rows)[order].T)[0].T.contiguous()
    kept, rest_ratio = _held_out_ratios(grams, people.geometry, config)
    coefficients, rest_energy = [], torch.zeros(mean.numel())
    for first in range(0, len(people), CHUNK):
        centred = (people.latents[first : first + CHUNK].float() - mean).flatten(1)
        c = centred[:, : basis.shape[1]] @ basis.T
        coefficients.append(c)
        centred = centred[: max(0, detailed - first)]
        centred[:, : basis.shape[1]] -= c[: len(centred)] @ basis
        rest_energy += centred.square().sum(0)
    rest = (rest_energy / detailed).unflatten(0, mean.shape)
    rest = (rest + codec.mirror(rest).abs()) / 2 * rest_ratio
    c = torch.cat(coefficients) * kept.sqrt()
    mixture = fit_mixture(torch.cat([c, c * signs]), people.condition.repeat(2, 1), vocabulary, config)
    return PersonPrior(mean, basis, signs, rest.clamp_min(1e-6), **mixture._asdict())


def _mirror_parts(people: LatentSet, codec: LinearCodec, channels: int) -> list[tuple[Tensor, Tensor]]:
    """Mean and centred rows of (z + Mz)/2, and zero and rows of (z - Mz)/2; of the leading channels."""
    latents = people.latents[:, :channels].float()
    mirrored = codec.mirror(latents)
    even, odd = (latents + mirrored) / 2, (latents - mirrored) / 2
    mean = even.mean(0)
    return [(mean, (even - mean).flatten(1)), (torch.zeros_like(mean), odd.flatten(1))]


def _principal(gram: Float[Tensor, "n n"], components: int) -> tuple[Tensor, Tensor]:
    """Leading variances and eigenvectors of a Gram matrix, largest first."""
    value, vector = torch.linalg.eigh(gram.double())
    count = min(components, len(gram))
    value, vector = value.flip(0)[:count], vector.flip(1)[:, :count]
    return (value / len(gram)).clamp_min(1e-12).float(), vector.float()


def _merge(variances: list[Tensor], components: int) -> tuple[Tensor, Tensor]:
    """Signs and places in the concatenation of the largest of even and odd variances."""
    joined = torch.cat(variances)
    order = joined.argsort(descending=True)[:components]
    signs = torch.cat([torch.full_like(v, s) for v, s in zip(variances, (1.0, -1.0), strict=True)])
    return signs[order], order


def _held_out_ratios(grams: list[Tensor], geometry: Int[Tensor, "n"], config: PriorConfig) -> tuple[Tensor, float]:
    """Variance of new people over that of fitted people: along each component (by rank) and of the rest."""
    fold = geometry % config.folds
    fitted_all, held_all, rest_fitted, rest_held = 0.0, 0.0, 0.0, 0.0
    for index in range(config.folds):
        train, test = (fold != index).nonzero()[:, 0], (fold == index).nonzero()[:, 0]
        if not len(train) or not len(test):
            raise ValueError(f"{config.folds} folds need as many geometries; there are {int(geometry.max()) + 1}")
        fitted, held, energy_fitted, energy_held = [], [], 0.0, 0.0
        for gram in grams:
            variance, vector = _principal(gram[train][:, train], config.components)
            projected = gram[test][:, train] @ vector / (variance * len(train)).sqrt()
            fitted.append(variance)
            held.append(projected.square().mean(0))
            energy_fitted += float(gram.diagonal()[train].mean())
            energy_held += float(gram.diagonal()[test].mean())
        order = torch.cat(fitted).argsort(descending=True)[: config.components]
        fitted_now, held_now = torch.cat(fitted)[order], torch.cat(held)[order]
        fitted_all, held_all = fitted_all + fitted_now, held_all + held_now
        rest_fitted += energy_fitted - float(fitted_now.sum())
        rest_held += energy_held - float(held_now.sum())
    ratio = _smooth(torch.as_tensor(held_all) / torch.as_tensor(fitted_all))
    return ratio.clamp(0.05, 1.0), max(1.0, rest_held / rest_fitted)


def _smooth(values: Float[Tensor, "r"], width: int = 9) -> Float[Tensor, "r"]:
    """Running mean in log space: the ratio of a single component is noisy, its trend is not."""
    padded = torch.nn.functional.pad(values.log()[None, None], (width // 2, width // 2), mode="replicate")
    return torch.nn.functional.avg_pool1d(padded, width, stride=1)[0, 0].exp()


def fit_shapes(people: LatentSet, prior: PersonPrior, features: int = 24, ridge: float = 30.0) -> ShapePrior:
    """Body shapes by ridge regression on the leading person coefficients in standard deviations."""
    first = torch.searchsorted(people.geometry, torch.arange(len(people.betas)))
    x = torch.cat([prior.split(chunk.float())[0] for chunk in people.latents[first].split(256)])
    x = (x / prior.marginal_variance().sqrt())[:, :features]
    bias = people.betas.mean(0)
    target = people.betas - bias
    weight = torch.linalg.solve(x.T @ x + ridge * torch.eye(x.shape[1]), x.T @ target).T
    left = target - x @ weight.T
    covariance = left.T @ left / len(left) + 1e-4 * torch.eye(left.shape[1])
    return ShapePrior(weight, bias, torch.linalg.cholesky(covariance), people.betas.abs().amax(0).clamp_min(1.0))
