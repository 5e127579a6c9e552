"""The prior fitted to latents."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from primdiffusion.diffusion.codec import mirror_cells
from primdiffusion.people.stored_people import find_payloads
from primdiffusion.primitives.primitives import GRID
from primdiffusion.training.latents import split_people
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


def test_held_out_geometries_are_never_trained_on(people):
    paths = find_payloads(people)
    train_paths, held = split_people(paths, 0.2, seed=0)
    assert len(held) == 3
    assert set(train_paths).isdisjoint(held)
    assert sorted(train_paths + held) == paths
    assert split_people(paths, 0.2, seed=0) == (train_paths, held)
    assert split_people(paths, 0.2, seed=1)[1] != held
