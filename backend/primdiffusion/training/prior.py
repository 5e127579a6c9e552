"""Fit the closed-form person prior, a mixture of Gaussians over person components, and the body shapes that go with it.

The mixture has all kinds of person that the training people suggest. Kinds are many (16 outfits of a sex, 9 styles of
hair and hat, 6 pairs of shoes, plain or patterned) and people of one kind few or none, so kinds share what they can: a
covariance of clothes for each group (sex, outfit and pattern) and one of the head for each hair style, for which small
groups lean on their like, and a mean that is a sum of effects: of the group, of the hair, of the shoes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.components import PersonComponents
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.gaussian import IMPOSSIBLE, PersonPrior
from primdiffusion.diffusion.model import ShapePrior
from primdiffusion.editing.regions import region_of
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.hanging_hair import HangingHair, find_hanging_hair
from primdiffusion.training.latents import CHUNK, LatentSet
from primdiffusion.training.regression import RIDGE, principal_directions, regress_cells

PASSES = 4
"""Rounds of backfitting."""
SAME_GARMENTS = 0.5
"""What a person of another group in the same garments counts for a group's covariance."""
GROUP_COLOURS = 4
"""Principal directions of a group in which its colours differ."""

Values = tuple[int, ...]
"""The value of each of some attributes, as its number in the vocabulary; -1 where unknown."""


def fit_mixture(
    c: Float[Tensor, "n r"],
    clothes: int,
    condition: Float[Tensor, "n x"],
    vocabulary: AttributeVocabulary,
    config: PriorConfig,
    inside: PersonComponents,
) -> dict[str, Tensor]:
    """Kinds, as fields of `PersonPrior`, for all that can be put together of the people's attributes; a single one if
    they have none.

    The leading `clothes` coefficients are those of the clothes, the others the head's.
    """
    groups, heads, *features = [
        [name for name in key if name in vocabulary.categories]
        for key in (config.groups, config.heads, *config.features)
    ]
    keys = [groups, heads, *filter(None, features)]
    values = _values(condition, vocabulary)
    rows = [[tuple(values[name][i] for name in key) for i in range(len(c))] for key in keys]
    choices = [sorted(set(row)) for row in rows]
    effects, remainder = _effects(c, clothes, rows, choices)
    outfits, hairs = (
        [tuple(v for name, v in zip(key, choice, strict=True) if name == kept) for choice in options]
        for key, options, kept in zip((groups, heads), choices, (config.outfit, config.hair), strict=False)
    )
    worn = [outfits[choices[0].index(group)] for group in rows[0]]
    skin, skin_of_head, remainder = _skin(remainder, clothes, rows[0], choices[0], worn, inside, config)
    style_of = [_hanging(head, heads, vocabulary, config) for head in choices[1]]
    if all(style_of) or clothes == c.shape[1]:  # no bare clothes to compare with, or no part for the head
        style_of = [None] * len(style_of)
    styles = [style_of[choices[1].index(head)] for head in rows[1]]
    bare = torch.tensor([style is None for style in styles])
    covariances = _covariances(remainder[bare, :clothes], list(compress(rows[0], bare)), choices[0], outfits, config)
    hair: dict[str | None, HangingHair] = {}
    for style in sorted(set(filter(None, styles))):
        own = torch.tensor([each == style for each in styles])
        hair[style], remainder[own, clothes:] = find_hanging_hair(
            remainder[bare, :clothes], remainder[own], inside, config.shared
        )
    directions = len(next(iter(hair.values())).of_head) if hair else 0
    hair[None] = HangingHair(
        torch.eye(clothes), torch.zeros(directions, clothes), torch.zeros(directions, c.shape[1] - clothes)
    )
    head_shared = torch.stack([torch.cat([skin_of_head, hair[style].of_head]) for style in style_of])
    head_axes = _axes(_covariances(remainder[:, clothes:], rows[1], choices[1], hairs, config), config)
    below = [
        (g, style, kinds)
        for g, group in enumerate(choices[0])
        for style in hair
        if (kinds := [
            each for each in _kinds(group, keys, rows, choices) if style_of[choices[1].index(each[1][1])] == style
        ])
    ]  # fmt: skip
    axes = _axes([hair[style].through.T @ covariances[g] @ hair[style].through for g, style, _ in below], config)
    shared = torch.stack([torch.cat([skin[g] @ hair[style].through, hair[style].of_clothes]) for g, style, _ in below])
    size = len(below), max(len(kinds) for *_, kinds in below)
    log_weight, head = torch.full(size, IMPOSSIBLE), torch.zeros(size, dtype=torch.int64)
    centre, kind = torch.zeros(*size, c.shape[1]), torch.zeros(*size, condition.shape[1])
    mean = c.mean(0)
    for g, (own, style, kinds) in enumerate(below):
        of_clothes = effects[0][own] - mean
        of_clothes[:clothes] = of_clothes[:clothes] @ hair[style].through
        for m, (log_share, chosen) in enumerate(kinds):
            log_weight[g, m] = log_share
            of_others = [effects[k][choices[k].index(v)] for k, v in enumerate(chosen) if k]
            centre[g, m] = torch.stack([mean, of_clothes, *of_others]).sum(0)
            head[g, m] = choices[1].index(chosen[1])
            kind[g, m] = _condition(chosen, keys, vocabulary)
    log_weight = log_weight - log_weight.flatten().logsumexp(0)
    return {
        "log_weight": log_weight, "centre": centre, "axes": axes[0], "variance": axes[1], "left": axes[2],
        "head": head, "head_axes": head_axes[0], "head_variance": head_axes[1], "head_left": head_axes[2],
        "shared": shared, "head_shared": head_shared, "kind": kind,
    }  # fmt: skip


def _skin(
    c: Float[Tensor, "n r"],
    clothes: int,
    group: Sequence[Values],
    groups: Sequence[Values],
    worn: Sequence[Values],
    inside: PersonComponents,
    config: PriorConfig,
) -> tuple[Float[Tensor, "g q o"], Float[Tensor, "q s"], Float[Tensor, "n r"]]:
    """Directions of the skin in the clothes of each group and in the head, and what they leave.

    Hands are bare in every outfit, so their leading principal directions are those of skin. Cells that an outfit leaves
    bare have its tone, those that it covers do not.
    """
    hands = c[:, clothes : (c.shape[1] + clothes) // 2]
    deviation, vector = principal_directions(hands, config.shared)
    scores = hands @ vector / deviation
    on_head = scores.T @ c[:, clothes:] / len(c)
    shared, remainder = c.new_zeros(len(groups), scores.shape[1], clothes), c.clone()
    remainder[:, clothes:] -= scores @ on_head
    for outfit in set(worn):
        own = torch.tensor([v == outfit for v in worn])
        shown, away = regress_cells(c[own, :clothes], scores[own], inside)
        remainder[own, :clothes] -= scores[own] @ away
        for g in {groups.index(v) for v, is_own in zip(group, own, strict=True) if is_own}:
            shared[g] = shown
    return shared, on_head, remainder


def _hanging(head: Values, names: Sequence[str], vocabulary: AttributeVocabulary, config: PriorConfig) -> str | None:
    """The value of a head that says that its hair hangs over the clothes; None if it does not."""
    words = [vocabulary.categories[name][v] for name, v in zip(names, head, strict=True) if v >= 0]
    return next((word for word in words if word in config.hanging), None)


def _values(condition: Float[Tensor, "n a"], vocabulary: AttributeVocabulary) -> dict[str, list[int]]:
    """Number of each person's value of each category; -1 where unknown."""
    found = {}
    for name, block in vocabulary.blocks().items():
        known = condition[:, block]
        found[name] = torch.where(known.amax(1) > 0, known.argmax(1), -1).tolist()
    return found


def _effects(
    c: Float[Tensor, "n r"], clothes: int, rows: Sequence[Sequence[Values]], choices: Sequence[Sequence[Values]]
) -> tuple[list[Float[Tensor, "v r"]], Float[Tensor, "n r"]]:
    """What every choice of every key adds to the mean, and what they leave, by backfitting.

    Groups say what clothes are like, and heads what hands and head are like. The other keys add what they show to:
    long hair hangs over a collar, but the shirts of the few people who have it do not colour everybody's.
    """
    designs = [
        functional.one_hot(torch.tensor([options.index(v) for v in row]), len(options)).float()
        for row, options in zip(rows, choices, strict=True)
    ]
    mean = c.mean(0)
    effects, remainder = [torch.zeros(len(options), c.shape[1]) for options in choices], c - mean
    for part, first in ((slice(0, clothes), 0), (slice(clothes, None), 1)):
        unknown: dict[int, Tensor] = {}
        for key in (first, *(k for k in range(len(rows)) if k != first)) * PASSES:
            design = designs[key]
            left = remainder[:, part] + design @ effects[key][:, part]
            if key == first:
                effect, unknown[key] = _ridge(left, design), torch.zeros(left.shape[1])
            else:
                effect, unknown[key] = _shown(left, design, design.shape[1] - 1)
            effects[key][:, part] = effect
            remainder[:, part] = left - design @ effect
        for key, share in unknown.items():
            remainder[:, part] += share * (designs[key] @ effects[key][:, part])
    effects[0] += mean
    return effects, remainder


def _ridge(c: Float[Tensor, "n r"], design: Float[Tensor, "n v"]) -> Float[Tensor, "v r"]:
    """Coefficients by ridge regression on a design."""
    normal = design.T @ design + RIDGE * torch.eye(design.shape[1])
    return torch.linalg.solve(normal.double(), (design.T @ c).double()).float()


def _shown(
    c: Float[Tensor, "n r"], design: Float[Tensor, "n v"], freedoms: int
) -> tuple[Float[Tensor, "v r"], Float[Tensor, "r"]]:
    """As `_ridge`, but each coefficient's part shrinks by s = 1 - 1/F (James and Stein), down to 0.

    F compares what the design's degrees of freedom explain with what they would explain by chance. The second is how
    much of the shrunk part belongs to what is left, independent of it, so that the variance stays what it was.
    """
    effect = _ridge(c, design)
    fitted = design @ effect
    chance = (c - fitted).square().sum(0) * freedoms / max(len(c) - freedoms, 1)
    s = (1 - chance / fitted.square().sum(0).clamp_min(1e-12)).clamp(1e-6, 1)
    people = design.square().sum(0)
    shrunk = s * (people / (people + RIDGE)).mean()
    return s * effect, 1 - (1 - (1 - shrunk**2).sqrt()) / shrunk


def _covariances(
    c: Float[Tensor, "n i"],
    group: Sequence[Values],
    groups: Sequence[Values],
    worn: Sequence[Values],
    config: PriorConfig,
) -> list[Float[Tensor, "i i"]]:
    """Covariance of each group's people: that of their colours and that of details.

    Colours are the leading principal directions of all people who wear the same, whatever their sex and pattern. Of
    details, which are what colours leave, `config.lean` people are those of all groups alike in the last value: their
    colours would be sleeves that differ from the shirt.
    """
    if not len(c):
        return [torch.zeros(c.shape[1], c.shape[1]) for _ in groups]
    members = torch.stack([torch.tensor([float(v == values) for v in group]) for values in groups])
    same = torch.tensor([[float(one == other) for other in worn] for one in worn])
    alike = torch.tensor([[float(one[-1:] == other[-1:]) for other in groups] for one in groups])
    detail, colours = torch.empty_like(c), []
    for g, own in enumerate(members):
        weight = SAME_GARMENTS * (same[g] @ members) + (1 - SAME_GARMENTS) * own
        weight = weight if float(weight.sum()) else torch.ones_like(own)
        deviation, direction = principal_directions(c * (weight * len(c) / weight.sum()).sqrt()[:, None], GROUP_COLOURS)
        colours.append((direction * deviation.square()) @ direction.T)
        detail[own > 0] = (c - c @ direction @ direction.T)[own > 0]
    scatter = torch.stack([(detail * own[:, None]).T @ detail for own in members])
    counts, covariances = members.sum(1), []
    for g, colour in enumerate(colours):
        share = SAME_GARMENTS * same[g] * alike[g] + config.lean * alike[g] / (alike[g] @ counts).clamp_min(1)
        share[g] += 1 - SAME_GARMENTS
        covariances.append(colour + torch.einsum("h,hij->ij", share / (share @ counts).clamp_min(1e-6), scatter))
    return covariances


def _axes(
    covariances: Sequence[Float[Tensor, "i i"]], config: PriorConfig
) -> tuple[Float[Tensor, "g a i"], Float[Tensor, "g a"], Float[Tensor, "g"]]:
    """`config.axes` principal axes and variances of each covariance, and the mean variance of all directions left."""
    axes, variances, left = [], [], []
    for covariance in covariances:
        value, vector = torch.linalg.eigh(covariance.double())
        value = value.flip(0).clamp_min(max(float(value.max()) * 1e-7, 1e-12) if len(value) else 0.0)
        kept = min(config.axes, len(value))
        axes.append(vector.flip(1)[:, :kept].T.float())
        variances.append(value[:kept].float())
        left.append(value[kept:].mean().float() if kept < len(value) else torch.tensor(0.0))
    return torch.stack(axes), torch.stack(variances), torch.stack(left)


def _kinds(
    group: Values,
    keys: Sequence[Sequence[str]],
    rows: Sequence[Sequence[Values]],
    choices: Sequence[Sequence[Values]],
) -> list[tuple[float, tuple[Values, ...]]]:
    """Logarithm of the share and the values of every kind of a group: all choices of features that go with it.

    Features go with a group where the attributes that both name agree; their shares are those among all people of whom
    these attributes are true.
    """
    total = len(rows[0])
    kinds = [(math.log(rows[0].count(group) / total), (group,))]
    for names, row, options in zip(keys[1:], rows[1:], choices[1:], strict=True):
        shared = [(names.index(name), keys[0].index(name)) for name in names if name in keys[0]]
        fitting = [v for v in options if all(v[mine] == group[theirs] for mine, theirs in shared)]
        counts = Counter(row)
        people = sum(counts[v] for v in fitting)
        kinds = [(share + math.log(counts[v] / people), (*values, v)) for share, values in kinds for v in fitting]
    return kinds


def _condition(
    chosen: Sequence[Values], keys: Sequence[Sequence[str]], vocabulary: AttributeVocabulary
) -> Float[Tensor, "a"]:
    """The condition that a kind meets."""
    condition, blocks = torch.zeros(vocabulary.width), vocabulary.blocks()
    for names, values in zip(keys, chosen, strict=True):
        for name, value in zip(names, values, strict=True):
            if value >= 0:
                condition[blocks[name].start + value] = 1.0
    return condition


def fit_prior(
    people: LatentSet,
    codec: LinearCodec,
    vocabulary: AttributeVocabulary,
    config: PriorConfig,
    part: Int[Tensor, "k"] | None = None,
) -> PersonPrior:
    """Principal components of each part of people and their mirror images, and a mixture of Gaussians of the people.

    Components are found from Gram matrices of the even and the odd parts of people, so that each is even or odd under
    the mirror. Variances of trailing components fitted to few people are too large for new people and those of the rest
    too small: both are corrected by leaving `config.folds` parts of the geometries out in turn. Mean and rest are those
    of detailed people. `part` is that of each cell (None: `body_parts`).
    """
    part = body_parts() if part is None else part
    detailed = int(people.detailed)
    mean = torch.stack([chunk.float().sum(0) for chunk in people.latents[:detailed].split(CHUNK)]).sum(0) / detailed
    mean = (mean + codec.mirror(mean)) / 2
    groups = [(part == number).nonzero()[:, 0] for number in range(int(part.max()) + 1)]
    fitted = [_components(people, codec, cells, config) for cells in groups]
    count = min(len(one.signs) for one in fitted)
    basis = torch.cat([one.basis[:count] for one in fitted], dim=1)
    signs = torch.cat([one.signs[:count] for one in fitted])
    kept = torch.cat([one.kept[:count] for one in fitted])
    inside = PersonComponents(mean, basis, part, signs)
    coefficients, rest_energy = [], torch.zeros_like(mean)
    for first in range(0, len(people), CHUNK):
        c, rest = inside.split(people.latents[first : first + CHUNK].float())
        coefficients.append(c)
        rest_energy += rest[: max(0, detailed - first)].square().sum(0)
    rest_ratio = torch.tensor([one.rest_ratio for one in fitted])[part].view(mean.shape[1:])
    rest = rest_energy / detailed
    rest = (rest + codec.mirror(rest).abs()) / 2 * rest_ratio
    c = torch.cat(coefficients) * kept.sqrt()
    clothes = max(count, len(signs) - 2 * count)  # the others are hands and head; a single part is all
    kinds = fit_mixture(c, clothes, people.condition, vocabulary, config, inside)
    return PersonPrior(**vars(inside), rest_variance=rest.clamp_min(1e-6), **kinds)


def body_parts() -> Int[Tensor, "k"]:
    """The part of each primitive: torso and neck, arms, legs, feet, hands, head.

    A collar goes with the shirt, and hair with the head.
    """
    names = (("torso", "hips", "neck"), ("arms",), ("legs",), ("feet",), ("hands",), ("face", "hair"))
    inside = torch.stack([region_of(part) for part in names])
    return inside.int().argmax(0)


class _Components(NamedTuple):
    """Components of one part of the body, in the order of their variance."""

    basis: Float[Tensor, "n k d"]
    signs: Float[Tensor, "n"]
    kept: Float[Tensor, "n"]
    """Variance of new people over that of fitted people."""
    rest_ratio: float
    """The same of the rest."""


def _components(people: LatentSet, codec: LinearCodec, cells: Int[Tensor, "k"], config: PriorConfig) -> _Components:
    parts = _mirror_parts(people, codec, cells, config.channels)
    grams = [part @ part.T for part in parts]
    vectors = [_principal(gram, config.components) for gram in grams]
    signs, order = _merge([variance for variance, _ in vectors], config.components)
    rows = torch.cat(
        [
            (vector.T @ part) / (variance * len(people)).sqrt()[:, None]
            for part, (variance, vector) in zip(parts, vectors, strict=True)
        ]
    )
    basis = torch.linalg.qr(rows[order].T)[0].T.unflatten(1, (-1, len(cells))).mT.contiguous()
    kept, rest_ratio = _held_out_ratios(grams, people.geometry, config)
    return _Components(basis, signs, kept, rest_ratio)


def _mirror_parts(people: LatentSet, codec: LinearCodec, cells: Int[Tensor, "k"], channels: int) -> list[Tensor]:
    """Centred rows of (z + Mz)/2, and rows of (z - Mz)/2, in the leading channels of some cells."""
    even, odd = [], []
    for chunk in people.latents.split(CHUNK):
        latents = chunk[:, :channels].float()
        mirrored = codec.mirror(latents)
        even.append(((latents + mirrored) / 2).flatten(2)[:, :, cells].flatten(1))
        odd.append(((latents - mirrored) / 2).flatten(2)[:, :, cells].flatten(1))
    whole = torch.cat(even)
    return [whole - whole.mean(0), torch.cat(odd)]


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
    padded = functional.pad(values.log()[None, None], (width // 2, width // 2), mode="replicate")
    return functional.avg_pool1d(padded, width, stride=1)[0, 0].exp()


def fit_shapes(people: LatentSet, prior: PersonPrior, ridge: float = 30.0) -> ShapePrior:
    """Body shapes by ridge regression on the person coefficients in standard deviations."""
    first = torch.searchsorted(people.geometry, torch.arange(len(people.betas)))
    x = torch.cat([prior.split(chunk.float())[0] for chunk in people.latents[first].split(CHUNK)])
    x = x / prior.marginal_variance().sqrt()
    bias = people.betas.mean(0)
    target = people.betas - bias
    gram = x @ x.T + ridge * torch.eye(len(x))  # people are fewer than coefficients
    dual = torch.linalg.solve(gram, target)
    left = dual / torch.linalg.inv(gram).diagonal()[:, None]  # of each person, by the regression on the others
    covariance = left.T @ left / len(left) + 1e-4 * torch.eye(left.shape[1])
    limit = people.betas.abs().amax(0).clamp_min(1.0)
    return ShapePrior((x.T @ dual).T, bias, torch.linalg.cholesky(covariance), limit)
