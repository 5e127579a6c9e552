"""The mixture of Gaussians over person components: one part for each kind of person that the training people suggest.

Kinds are many (16 outfits of a sex, 9 styles of hair and hat, 6 pairs of shoes, plain or patterned) and people of one
kind few or none, so parts share what they can: a covariance for each group (outfit and pattern), which small groups
lean on their like for, and a mean that is a sum of effects: of the group, of the hair, of the shoes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.gaussian import IMPOSSIBLE
from primdiffusion.training.config import PriorConfig

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
