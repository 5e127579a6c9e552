"""The prior fitted to latents."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from primdiffusion.diffusion.codec import mirror_cells
from primdiffusion.primitives.primitives import GRID
from primdiffusion.training.prior import fit_prior


def test_the_prior_s_components_are_even_or_odd_in_the_mirror(prepared_once):
    _, prepared = prepared_once
    prior, codec = prepared.prior, prepared.codec
    pictures = prior.picture(torch.eye(len(prior.parity)))
    varying = prior.marginal_variance() > 1e-3  # people of few kinds leave some components without variance
    assert varying.sum() >= 12
    mirrored = pictures * prior.parity[:, None, None, None]
    assert torch.allclose(codec.mirror(pictures)[varying], mirrored[varying], atol=1e-3)
    rows = pictures.flatten(1)
    assert torch.allclose(rows @ rows.T, torch.eye(len(rows)), atol=1e-4)
    assert torch.allclose(codec.mirror(prior.mean), prior.mean, atol=1e-3)
    assert torch.allclose(mirror_cells(codec.mean), codec.mean, atol=1e-3)


def test_the_prior_describes_the_people_it_was_fitted_to(prepared_once):
    _, prepared = prepared_once
    z = prepared.train.latents.float()
    energy = (z - prepared.prior.mean).square().sum((1, 2, 3)).mean()
    described = prepared.prior.marginal_variance().sum() + prepared.prior.rest_variance.sum()
    assert described.item() == pytest.approx(energy.item(), rel=0.2)  # less what F tests doubt
    assert prepared.prior.log_weight.shape == (2, 1)


def test_shapes_learn_what_the_person_shows(prepared_once):
    # the first beta of these people sets their density, so it can be read off them; the others are constant
    _, prepared = prepared_once
    held, prior = prepared.held, prepared.prior
    first = torch.searchsorted(held.geometry, torch.arange(len(held.betas)))
    features = prior.split(held.latents[first].float())[0] / prior.marginal_variance().sqrt()
    left = prepared.shapes.scale @ prepared.shapes.scale.T
    assert features.shape[1] == prepared.shapes.weight.shape[1]
    assert left[0, 0] < 0.8 * prepared.train.betas[:, 0].var()


def test_person_components_live_in_the_leading_channels_alone(prepared_once):
    config, prepared = prepared_once
    z = prepared.train.latents[:8].float()
    prior = fit_prior(
        prepared.train, prepared.codec, prepared.vocabulary, dataclasses.replace(config.prior, channels=2)
    )
    assert prior.basis.shape[1:] == (GRID * GRID, 2)
    coefficients, rest = prior.split(z)
    assert torch.equal(rest[:, 2:], z[:, 2:] - prior.mean[2:])
    assert torch.allclose(prior.join(coefficients, rest), z, atol=1e-4)
    assert (prior.split(prior.join(coefficients, torch.zeros_like(rest)))[0] - coefficients).abs().max() < 1e-3


def test_blurred_people_count_for_the_components_but_not_for_the_rest(prepared_once):
    config, prepared = prepared_once
    people = prepared.train
    blurred = dataclasses.replace(people, latents=people.latents.roll(1, 0) * 0.5)
    both = people.and_blurred(blurred, prepared.codec)
    assert len(both) == 2 * len(people)
    assert int(both.detailed) == len(people)
    assert torch.equal(both.geometry[len(people) :], people.geometry + len(people.betas))
    alone = fit_prior(people, prepared.codec, prepared.vocabulary, config.prior)
    prior = fit_prior(both, prepared.codec, prepared.vocabulary, config.prior)
    assert torch.allclose(prior.mean, alone.mean)
    z = people.latents.float()
    left = z - prior.mean - prior.picture(prior.split(z)[0])
    assert prior.rest_variance.sum() >= left.square().sum((1, 2, 3)).mean() * 0.99


def test_blurred_people_get_the_spread_of_detailed_ones(prepared_once):
    _, prepared = prepared_once
    people, codec = prepared.train, prepared.codec
    blurred = dataclasses.replace(people, latents=people.latents.flip(0) * 0.5 + 0.25)
    both = people.and_blurred(blurred, codec).latents.float()
    ours, theirs = both[: len(people)], both[len(people) :]
    pairs = [torch.cat([each, codec.mirror(each)]) for each in (ours, theirs)]
    assert torch.allclose(pairs[0].mean(0), pairs[1].mean(0), atol=0.02)
    assert torch.allclose(pairs[0].std(0), pairs[1].std(0), rtol=0.02, atol=0.02)
