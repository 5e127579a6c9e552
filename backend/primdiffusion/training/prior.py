"""Fit the closed-form person prior, a mixture of Gaussians over person components, and the body shapes that go with it.

The mixture is fitted by `training/mixture.py`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.gaussian import PersonComponents, PersonPrior
from primdiffusion.diffusion.model import ShapePrior
from primdiffusion.editing.regions import region_of
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import CHUNK, LatentSet
from primdiffusion.training.mixture import fit_mixture


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
    too small: both are corrected by leaving `config.folds` parts of the geometries out in turn. Mean, rest and how
    frequent kinds are come from detailed people. `part` is that of each cell (None: `body_parts`).
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
    kinds = fit_mixture(c, clothes, people.condition, vocabulary, config, inside, detailed)
    components = {field.name: getattr(inside, field.name) for field in dataclasses.fields(inside)}
    return PersonPrior(**components, rest_variance=rest.clamp_min(1e-6), **kinds)


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


SHAPE_RIDGE = 30.0
"""Weight of the penalty on the regression of body shapes: people are fewer than coefficients."""


def fit_shapes(people: LatentSet, prior: PersonPrior) -> ShapePrior:
    """Body shapes by ridge regression on the person coefficients in standard deviations."""
    first = torch.searchsorted(people.geometry, torch.arange(len(people.betas)))
    x = torch.cat([prior.split(chunk.float())[0] for chunk in people.latents[first].split(CHUNK)])
    x = x / prior.marginal_variance().sqrt()
    bias = people.betas.mean(0)
    target = people.betas - bias
    gram = x @ x.T + SHAPE_RIDGE * torch.eye(len(x))
    dual = torch.linalg.solve(gram, target)
    left = dual / torch.linalg.inv(gram).diagonal()[:, None]  # of each person, by the regression on the others
    covariance = left.T @ left / len(left) + 1e-4 * torch.eye(left.shape[1])
    limit = people.betas.abs().amax(0).clamp_min(1.0)
    return ShapePrior((x.T @ dual).T, bias, torch.linalg.cholesky(covariance), limit)
