import itertools

import numpy as np
import pytest
import torch
from diffusion_people import random_prior
from scipy.stats import multivariate_normal

F64 = torch.float64
SHAPE = (2, 2, 3)


@pytest.fixture
def prior():
    return random_prior(SHAPE, components=4, parts=3, seed=0, groups=2, asked=3).to(dtype=F64)


def levels(signal, count):
    column = torch.full((count, 1, 1, 1), signal, dtype=F64)
    return column, (1 - column**2).sqrt()


def covariance_of(prior, group):
    person = prior.axes[group].T @ torch.diag(prior.variance[group]) @ prior.axes[group]
    outside = torch.eye(prior.basis.shape[1], dtype=F64) - prior.basis.T @ prior.basis
    rest = outside @ torch.diag(prior.rest_variance.flatten()) @ outside
    return prior.basis.T @ person @ prior.basis + rest


def test_split_and_join_are_inverse(prior):
    z = torch.randn(5, *SHAPE, dtype=F64)
    assert torch.allclose(prior.join(*prior.split(z)), z, atol=1e-12)


@pytest.mark.parametrize("asked", [None, 1])
def test_mixture_denoiser_is_bayes_rule(prior, asked):
    # constant rest variance makes the split exact; the posterior mean then follows from whole-space Gaussians
    prior = type(prior)(**{**vars(prior), "rest_variance": torch.full(SHAPE, 0.05, dtype=F64)})
    signal, noise = levels(0.8, 6)
    x = signal * prior.sample(6, torch.Generator().manual_seed(1)) + noise * torch.randn(6, *SHAPE, dtype=F64)
    condition = None if asked is None else torch.eye(3, dtype=F64)[asked].expand(6, -1)
    for one, guess in zip(x, prior.denoise(x, signal, noise, condition), strict=True):
        likelihood, means = [], []
        for group, part in itertools.product(range(2), range(3)):
            if asked is not None and not prior.kind[group, part, asked]:
                continue
            centre = prior.mean.flatten() + prior.centre[group, part] @ prior.basis
            covariance = covariance_of(prior, group)
            total = 0.64 * covariance + 0.36 * torch.eye(12, dtype=F64)
            away = one.flatten() - 0.8 * centre
            means.append(centre + 0.8 * covariance @ torch.linalg.solve(total, away))
            likelihood.append(
                prior.log_weight[group, part].exp().item()
                * multivariate_normal(np.zeros(12), total.numpy()).pdf(away.numpy())
            )
        share = torch.tensor(likelihood, dtype=F64) / sum(likelihood)
        assert torch.allclose(guess.flatten(), share @ torch.stack(means), atol=1e-9)


def test_posterior_mean_of_white_noise_is_what_the_denoiser_gives(prior):
    y = torch.randn(5, 4, dtype=F64, generator=torch.Generator().manual_seed(5))
    signal, noise = (level[..., 0, 0] for level in levels(0.7, 5))
    wanted = prior.denoise_coefficients(y, signal, noise)
    ratio = (signal / noise.square())[0, 0]
    precision = 0.7 * ratio * torch.eye(4, dtype=F64)
    got = torch.stack([prior.posterior(precision, ratio * one)[0] for one in y])
    assert torch.allclose(got, wanted, atol=1e-9)


def test_evidence_is_the_mean_likelihood_over_the_prior(prior):
    generator = torch.Generator().manual_seed(5)
    matrix, y = (torch.randn(*shape, generator=generator, dtype=F64) for shape in ((6, 4), (6,)))
    variance = 0.3
    _, evidence = prior.posterior(matrix.T @ matrix / variance, matrix.T @ y / variance)
    wanted = 0.0
    for group, part in itertools.product(range(2), range(3)):
        own = prior.axes[group].T @ torch.diag(prior.variance[group]) @ prior.axes[group]
        covariance = matrix @ own @ matrix.T + variance * torch.eye(6, dtype=F64)
        density = multivariate_normal((matrix @ prior.centre[group, part]).numpy(), covariance.numpy()).pdf(y.numpy())
        wanted += prior.log_weight[group, part].exp().item() * density
    white = multivariate_normal(np.zeros(6), variance * np.eye(6)).pdf(y.numpy())
    assert evidence == pytest.approx(np.log(wanted / white), abs=1e-9)


def test_group_means_are_those_of_samples_of_a_group(prior):
    weight = prior.log_weight.exp()
    wanted = torch.stack([(w[:, None] * c).sum(0) / w.sum() for w, c in zip(weight, prior.centre, strict=True)])
    assert torch.allclose(prior.group_means(), wanted, atol=1e-12)


def test_posterior_samples_have_the_posterior_s_mean_and_follow_what_is_observed(prior):
    precision = torch.diag(torch.tensor([2.0, 0.5, 0.0, 1e6], dtype=F64))
    vector = torch.tensor([1.0, -0.3, 0.0, 0.7e6], dtype=F64)
    generator = torch.Generator().manual_seed(5)
    drawn = torch.stack([prior.posterior_sample(precision, vector, generator) for _ in range(4000)])
    mean, _ = prior.posterior(precision, vector)
    assert ((drawn.mean(0) - mean).abs() < 4 * drawn.std(0) / 4000**0.5 + 1e-6).all()
    assert torch.allclose(drawn[:, 3], torch.tensor(0.7, dtype=F64), atol=0.01)
    everything = prior.posterior_sample(torch.zeros(4, 4, dtype=F64), torch.zeros(4, dtype=F64), generator)
    assert everything.shape == (4,)


def test_samples_have_the_prior_s_moments(prior):
    z = prior.sample(60_000, torch.Generator().manual_seed(0))
    coefficients, rest = prior.split(z)
    centre = torch.einsum("gm,gmr->r", prior.log_weight.exp(), prior.centre)
    assert (z.mean(0) - prior.mean - (centre @ prior.basis).unflatten(0, SHAPE)).abs().max() < 0.03
    assert torch.allclose(coefficients.var(0), prior.marginal_variance(), rtol=0.05)
    assert rest.square().sum(0).sum() < 1.05 * prior.rest_variance.sum() * 60_000


def test_single_gaussian_has_the_mixture_s_mean_and_covariance(prior):
    single = prior.gaussian()
    c = prior.split(prior.sample(80_000, torch.Generator().manual_seed(3)))[0]
    expected = single.axes[0].T @ torch.diag(single.variance[0]) @ single.axes[0]
    assert (torch.cov(c.T) - expected).abs().max() < 0.05 * expected.abs().max()
    assert torch.allclose(single.centre[0, 0], c.mean(0), atol=0.05)


def test_no_closed_form_beats_the_mixture_on_its_own_people(prior):
    signal, noise = levels(0.6, 4000)
    z = prior.sample(4000, torch.Generator().manual_seed(2))
    x = signal * z + noise * torch.randn(z.shape, dtype=F64, generator=torch.Generator().manual_seed(4))
    mixture = (prior.denoise(x, signal, noise) - z).square().mean()
    single = (prior.gaussian().denoise(x, signal, noise) - z).square().mean()
    assert mixture < 0.97 * single


def test_without_noise_the_denoiser_changes_nothing(prior):
    z = prior.sample(3, torch.Generator().manual_seed(5))
    one = torch.ones(3, 1, 1, 1, dtype=F64)
    assert torch.allclose(prior.denoise(z, one, 1e-5 * one), z, atol=1e-6)


def test_draws_are_of_the_kind_that_is_asked_for(prior):
    condition = torch.eye(3, dtype=F64)[2:]
    share = prior.log_weights(condition)[0].exp()
    assert torch.equal(share.flatten().nonzero(), prior.kind[..., 2].flatten().nonzero())
    c = prior.split(prior.sample(40_000, torch.Generator().manual_seed(6), condition))[0]
    share = share / share.sum()
    assert torch.allclose(c.mean(0), torch.einsum("gm,gmr->r", share, prior.centre), atol=0.05)


def test_kinds_are_drawn_as_often_as_their_parts_occur(prior):
    draws = prior.sample_kinds(40_000, torch.Generator().manual_seed(7))
    expected = torch.einsum("gm,gma->a", prior.log_weight.exp(), prior.kind)
    assert torch.allclose(draws.mean(0), expected, atol=0.01)
    asked = torch.eye(3, dtype=F64)[2:]
    assert torch.equal(prior.sample_kinds(50, torch.Generator().manual_seed(7), asked)[:, 2], torch.ones(50, dtype=F64))


def test_an_unknown_kind_excludes_no_part(prior):
    nobody = type(prior)(**{**vars(prior), "kind": torch.zeros_like(prior.kind)})
    asked = torch.eye(3, dtype=F64)[:1]
    assert torch.equal(nobody.log_weights(asked)[0], nobody.log_weight)
