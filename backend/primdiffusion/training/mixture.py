"""Fit a mixture of Gaussians over person components.

The mixture has all kinds of person that the training people suggest. Kinds are many (16 outfits of a sex, 9 styles of
hair and hat, 6 pairs of shoes, plain or patterned) and people of one kind few or none, so kinds share what they can: a
covariance of clothes for each group (sex, outfit and pattern) and one of the head for each hair style, for which small
groups lean on their like, and a mean that is a sum of effects: of the group, of the hair, of the shoes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.gaussian import IMPOSSIBLE, PersonComponents
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.regression import RIDGE, principal_directions, regress_cells

PASSES = 4
"""Rounds of backfitting."""
SAME_GARMENTS = 0.5
"""Weight of a person of another group in the same garments in a group's covariance."""
GROUP_COLOURS = 4
"""Principal directions of a group in which its colours differ."""


class Key(NamedTuple):
    """Attributes that are chosen together, and the choices that people make of their values."""

    names: list[str]
    choices: list[tuple[int, ...]]
    """Numbers of the values in the vocabulary; -1 where unknown."""
    of_person: Int[Tensor, "n"]
    """The number of each person's choice."""

    def design(self) -> Float[Tensor, "n v"]:
        """1 where a person has made a choice, else 0."""
        return functional.one_hot(self.of_person, len(self.choices)).float()

    def alike(self, name: str) -> Float[Tensor, "v v"]:
        """1 where two choices have the same value of an attribute, which all have if it is none of theirs; else 0."""
        values = [[v for own, v in zip(self.names, choice, strict=True) if own == name] for choice in self.choices]
        return torch.tensor([[float(one == other) for other in values] for one in values])


class Kind(NamedTuple):
    """A group, a head and features that go together."""

    share: float
    """Share of people in the group."""
    choices: tuple[int, ...]
    """The number of its choice of each key."""


def fit_mixture(
    c: Float[Tensor, "n r"],
    clothes: int,
    condition: Float[Tensor, "n x"],
    vocabulary: AttributeVocabulary,
    config: PriorConfig,
    inside: PersonComponents,
    counted: int | None = None,
) -> dict[str, Tensor]:
    """Kinds, as fields of `PersonPrior`, for all that can be put together of the people's attributes; a single one if
    they have none.

    The leading `clothes` coefficients are those of the clothes, the others the head's. Kinds are as frequent as among
    the first `counted` people (None: all).
    """
    keys = _keys(condition, vocabulary, config)
    groups, heads = keys[:2]
    effects, remainder = _effects(c, clothes, keys)
    skin, skin_of_head, remainder = _skin(remainder, clothes, groups, inside, config)
    bare = _bare(heads, vocabulary, config)[heads.of_person]
    of_bare = groups._replace(of_person=groups.of_person[bare])
    axes = _axes(_covariances(remainder[bare, :clothes], of_bare, config.outfit, config.shrinkage), config.axes)
    head_axes = _axes(_covariances(remainder[:, clothes:], heads, config.hair, config.shrinkage), config.axes)
    return {
        "axes": axes[0], "variance": axes[1], "left": axes[2],
        "head_axes": head_axes[0], "head_variance": head_axes[1], "head_left": head_axes[2],
        "shared": skin, "head_shared": skin_of_head.repeat(len(heads.choices), 1, 1),
        **_kind_fields(effects, c.mean(0), [k._replace(of_person=k.of_person[:counted]) for k in keys], vocabulary),
    }  # fmt: skip


def _keys(condition: Float[Tensor, "n x"], vocabulary: AttributeVocabulary, config: PriorConfig) -> list[Key]:
    """Groups, heads, and those features of which the people have an attribute."""
    values = {}
    for name, block in vocabulary.blocks().items():
        known = condition[:, block]
        values[name] = torch.where(known.amax(1) > 0, known.argmax(1), -1).tolist()
    keys = []
    for number, wanted in enumerate((config.groups, config.heads, *config.features)):
        names = [name for name in wanted if name in vocabulary.categories]
        if names or number < 2:
            rows = [tuple(values[name][person] for name in names) for person in range(len(condition))]
            choices = sorted(set(rows))
            keys.append(Key(names, choices, torch.tensor([choices.index(row) for row in rows])))
    return keys


def _effects(
    c: Float[Tensor, "n r"], clothes: int, keys: Sequence[Key]
) -> tuple[list[Float[Tensor, "v r"]], Float[Tensor, "n r"]]:
    """Effects of every choice of every key on the mean, and the remainder, by backfitting.

    Groups say what clothes are like, and heads what hands and head are like. The other keys add what they show to:
    long hair hangs over a collar, but the shirts of the few people who have it do not colour everybody's.
    """
    designs = [key.design() for key in keys]
    effects, remainder = [torch.zeros(len(key.choices), c.shape[1]) for key in keys], c - c.mean(0)
    for part, first in ((slice(0, clothes), 0), (slice(clothes, None), 1)):
        for key in (first, *(k for k in range(len(keys)) if k != first)) * PASSES:
            design = designs[key]
            left = remainder[:, part] + design @ effects[key][:, part]
            effect = _ridge(left, design) if key == first else _shown(left, design, design.shape[1] - 1)
            effects[key][:, part] = effect
            remainder[:, part] = left - design @ effect
    return effects, remainder


def _ridge(c: Float[Tensor, "n r"], design: Float[Tensor, "n v"]) -> Float[Tensor, "v r"]:
    """Coefficients by ridge regression on a design."""
    normal = design.T @ design + RIDGE * torch.eye(design.shape[1])
    return torch.linalg.solve(normal.double(), (design.T @ c).double()).float()


def _shown(c: Float[Tensor, "n r"], design: Float[Tensor, "n v"], freedoms: int) -> Float[Tensor, "v r"]:
    """Same as `_ridge`, but each coefficient's part shrinks by s = 1 - 1/F (James and Stein), down to 0.

    F compares what the design's degrees of freedom explain with what they would explain by chance.
    """
    effect = _ridge(c, design)
    fitted = design @ effect
    chance = (c - fitted).square().sum(0) * freedoms / max(len(c) - freedoms, 1)
    return (1 - chance / fitted.square().sum(0).clamp_min(1e-12)).clamp_min(0) * effect


def _skin(
    c: Float[Tensor, "n r"], clothes: int, groups: Key, inside: PersonComponents, config: PriorConfig
) -> tuple[Float[Tensor, "g q o"], Float[Tensor, "q s"], Float[Tensor, "n r"]]:
    """Directions of the skin in the clothes of each group and in the head, and what they leave.

    Hands are bare in every outfit, so their leading principal directions are those of skin. Cells that an outfit leaves
    bare have its tone, those that it covers do not.
    """
    hands = c[:, clothes : (c.shape[1] + clothes) // 2]
    deviation, vector = principal_directions(hands, config.shared)
    scores = hands @ vector / deviation
    on_head = scores.T @ c[:, clothes:] / len(c)
    shared, remainder = c.new_zeros(len(groups.choices), scores.shape[1], clothes), c.clone()
    remainder[:, clothes:] -= scores @ on_head
    for same in groups.alike(config.outfit).bool().unique(dim=0):
        own = same[groups.of_person]
        shared[same], remainder[own, :clothes] = regress_cells(c[own, :clothes], scores[own], inside)
    return shared, on_head, remainder


def _bare(heads: Key, vocabulary: AttributeVocabulary, config: PriorConfig) -> Bool[Tensor, "f"]:
    """Heads whose hair does not hang over the clothes; all if it does on all of them.

    The colour of hair would be one of the clothes: locks at the neck of people with short hair, in any colour.
    """
    words = [
        {vocabulary.categories[name][v] for name, v in zip(heads.names, choice, strict=True) if v >= 0}
        for choice in heads.choices
    ]
    bare = torch.tensor([not own.intersection(config.hanging) for own in words])
    return bare | ~bare.any()


def _covariances(c: Float[Tensor, "n i"], key: Key, worn: str, shrinkage: float) -> list[Float[Tensor, "i i"]]:
    """Covariance of each choice's people: that of their colours and that of details.

    Colours are the leading principal directions of all people who have the same of `worn`, whatever their sex; few
    patterned people have those of many plain ones, but do not lend them their prints. Of details, which are what
    colours leave, `shrinkage` people are those of all choices alike in the last attribute: their colours would be
    sleeves that differ from the shirt.
    """
    if not len(c):
        return [torch.zeros(c.shape[1], c.shape[1]) for _ in key.choices]
    members, same, alike = key.design().T, key.alike(worn), key.alike(key.names[-1] if key.names else "")
    counts = members.sum(1)
    lends = same * (alike + (counts[None] > counts[:, None])).clamp_max(1)
    detail, colours = torch.empty_like(c), []
    for g, own in enumerate(members):
        weight = SAME_GARMENTS * (lends[g] @ members) + (1 - SAME_GARMENTS) * own
        weight = weight if float(weight.sum()) else torch.ones_like(own)
        deviation, direction = principal_directions(c * (weight * len(c) / weight.sum()).sqrt()[:, None], GROUP_COLOURS)
        colours.append((direction * deviation.square()) @ direction.T)
        detail[own > 0] = (c - c @ direction @ direction.T)[own > 0]
    scatter = torch.stack([(detail * own[:, None]).T @ detail for own in members])
    covariances = []
    for g, colour in enumerate(colours):
        share = SAME_GARMENTS * same[g] * alike[g] + shrinkage * alike[g] / (alike[g] @ counts).clamp_min(1)
        share[g] += 1 - SAME_GARMENTS
        covariances.append(colour + torch.einsum("h,hij->ij", share / (share @ counts).clamp_min(1e-6), scatter))
    return covariances


def _axes(
    covariances: Sequence[Float[Tensor, "i i"]], count: int
) -> tuple[Float[Tensor, "g a i"], Float[Tensor, "g a"], Float[Tensor, "g"]]:
    """`count` principal axes and variances of each covariance, and the mean variance of all directions left."""
    axes, variances, left = [], [], []
    for covariance in covariances:
        value, vector = torch.linalg.eigh(covariance.double())
        value = value.flip(0).clamp_min(max(float(value.max()) * 1e-7, 1e-12) if len(value) else 0.0)
        kept = min(count, len(value))
        axes.append(vector.flip(1)[:, :kept].T.float())
        variances.append(value[:kept].float())
        left.append(value[kept:].mean().float() if kept < len(value) else torch.tensor(0.0))
    return torch.stack(axes), torch.stack(variances), torch.stack(left)


def _kinds(group: int, keys: Sequence[Key]) -> list[Kind]:
    """Every kind of a group: all choices of the other keys that go with it.

    They go with a group where the attributes that both name agree; their shares are those among all people of whom
    these attributes are true.
    """
    groups = keys[0]
    kinds = [Kind(float((groups.of_person == group).float().mean()), (group,))]
    for key in keys[1:]:
        counts = torch.bincount(key.of_person, minlength=len(key.choices))
        both = [(key.names.index(name), groups.names.index(name)) for name in key.names if name in groups.names]
        fitting = [
            number
            for number, choice in enumerate(key.choices)
            if all(choice[mine] == groups.choices[group][theirs] for mine, theirs in both)
        ]
        shares = [float(counts[number] / counts[fitting].sum().clamp_min(1)) for number in fitting]
        kinds = [
            Kind(kind.share * share, (*kind.choices, number))
            for kind in kinds
            for number, share in zip(fitting, shares, strict=True)
        ]
    return kinds


def _kind_fields(
    effects: Sequence[Float[Tensor, "v r"]],
    mean: Float[Tensor, "r"],
    keys: Sequence[Key],
    vocabulary: AttributeVocabulary,
) -> dict[str, Tensor]:
    """Weights, centres, heads and conditions of the kinds of all groups."""
    groups = [_kinds(group, keys) for group in range(len(keys[0].choices))]
    size = len(groups), max(map(len, groups))
    log_weight, head = torch.full(size, IMPOSSIBLE), torch.zeros(size, dtype=torch.int64)
    centre, condition = torch.zeros(*size, len(mean)), torch.zeros(*size, vocabulary.width)
    blocks = vocabulary.blocks()
    for g, kinds in enumerate(groups):
        for m, kind in enumerate(kinds):
            log_weight[g, m], head[g, m] = kind.share, kind.choices[1]
            of_kind = (effect[number] for effect, number in zip(effects, kind.choices, strict=True))
            centre[g, m] = torch.stack([mean, *of_kind]).sum(0)
            for key, number in zip(keys, kind.choices, strict=True):
                for name, value in zip(key.names, key.choices[number], strict=True):
                    if value >= 0:
                        condition[g, m, blocks[name].start + value] = 1.0
    real = log_weight > 0
    log_weight[~real], log_weight[real] = IMPOSSIBLE, (log_weight[real] / log_weight[real].sum()).log()
    return {"log_weight": log_weight, "head": head, "centre": centre, "kind": condition}
