import dataclasses
import itertools

import numpy as np
import pytest
import torch
from diffusion_people import prior_of_parts, random_prior
from scipy.stats import multivariate_normal

F64 = torch.float64
SHAPE = (2, 2, 3)


@pytest.fixture(params=["whole body", "parts"])
def prior(request):
    if request.param == "parts":
        return prior_of_parts(seed=1, asked=3)
    return random_prior(SHAPE, components=4, parts=3, seed=0, groups=2, asked=3).to(dtype=F64)


def levels(signal, count):
    column = torch.full((count, 1, 1, 1), signal, dtype=F64)
    return column, (1 - column**2).sqrt()


def pictures_of(prior):
    """The components as rows over all latents, by an identity matrix."""
    return prior.picture(torch.eye(len(prior.parity), dtype=F64)).flatten(1)


def spread(axes, variance, left):
    return axes.T @ torch.diag(variance) @ axes + left * (torch.eye(axes.shape[1], dtype=F64) - axes.T @ axes)


def coefficient_covariance(prior, group, kind):
    head = prior.head[group, kind]
    own = torch.block_diag(
        spread(prior.axes[group], prior.variance[group], prior.left[group]),
        spread(prior.head_axes[head], prior.head_variance[head], prior.head_left[head]),
    )
    shared = torch.cat([prior.shared[group], prior.head_shared[head]], dim=1)
    return own + shared.T @ shared


def covariance_of(prior, group, kind):
    basis = pictures_of(prior)
    outside = torch.eye(basis.shape[1], dtype=F64) - basis.T @ basis
    rest = outside @ torch.diag(prior.rest_variance.flatten()) @ outside
    return basis.T @ coefficient_covariance(prior, group, kind) @ basis + rest


def test_components_of_a_part_are_orthonormal_and_inside_of_it(prior):
    basis = pictures_of(prior)
    assert torch.allclose(basis @ basis.T, torch.eye(len(basis), dtype=F64), atol=1e-12)
    own = torch.arange(len(basis)) // len(prior.basis)
    outside = prior.part[None] != own[:, None]
    assert not basis.view(len(basis), SHAPE[0], -1).abs().sum(1)[outside].any()


def test_split_and_join_are_inverse(prior):
    z = torch.randn(5, *SHAPE, dtype=F64)
    assert torch.allclose(prior.join(*prior.split(z)), z, atol=1e-12)


@pytest.mark.parametrize("asked", [None, 1])
def test_mixture_denoiser_is_bayes_rule(prior, asked):
    # constant rest variance makes the split exact; the posterior mean then follows from whole-space Gaussians
    prior = dataclasses.replace(prior, rest_variance=torch.full(SHAPE, 0.05, dtype=F64))
    basis = pictures_of(prior)
    signal, noise = levels(0.8, 6)
    x = signal * prior.sample(6, torch.Generator().manual_seed(1)) + noise * torch.randn(6, *SHAPE, dtype=F64)
    condition = None if asked is None else torch.eye(3, dtype=F64)[asked].expand(6, -1)
    for one, guess in zip(x, prior.denoise(x, signal, noise, condition), strict=True):
        likelihood, means = [], []
        for group, part in itertools.product(range(2), range(3)):
            if asked is not None and not prior.kind[group, part, asked]:
                continue
            centre = prior.mean.flatten() + prior.centre[group, part] @ basis
            covariance = covariance_of(prior, group, part)
            total = 0.64 * covariance + 0.36 * torch.eye(12, dtype=F64)
            away = one.flatten() - 0.8 * centre
            means.append(centre + 0.8 * covariance @ torch.linalg.solve(total, away))
            likelihood.append(
                prior.log_weight[group, part].exp().item()
                * multivariate_normal(np.zeros(12), total.numpy()).pdf(away.numpy())
            )
        share = torch.tensor(likelihood, dtype=F64) / sum(likelihood)
        assert torch.allclose(guess.flatten(), share @ torch.stack(means), atol=1e-9)


def test_shares_of_kinds_of_clean_coefficients_are_bayes_rule(prior):
    coefficients = prior.split(prior.sample(5, torch.Generator().manual_seed(1)))[0]
    for one, found in zip(coefficients, prior.kind_shares(coefficients), strict=True):
        weight = torch.zeros(2, 3, dtype=F64)
        for group, part in itertools.product(range(2), range(3)):
            covariance = coefficient_covariance(prior, group, part)
            density = multivariate_normal(prior.centre[group, part].numpy(), covariance.numpy()).pdf(one)
            weight[group, part] = prior.log_weight[group, part].exp() * float(density)
        assert torch.allclose(found, weight / weight.sum(), atol=1e-4)


@pytest.mark.parametrize("head", [None, 1])
def test_people_of_a_group_are_one_gaussian_with_their_mean_and_covariance(head):
    prior = prior_of_parts(seed=1)
    prior = dataclasses.replace(prior, left=prior.left * 0, head_left=prior.head_left * 0)
    kinds = [kind for kind in range(3) if head is None or prior.head[0, kind] == head]
    weight = prior.log_weight[0, kinds].softmax(0)
    mean = weight @ prior.centre[0, kinds]
    wanted = sum(
        w * (coefficient_covariance(prior, 0, kind) + torch.outer(*2 * [prior.centre[0, kind] - mean]))
        for w, kind in zip(weight, kinds, strict=True)
    )
    found = prior.gaussian_of(0, head).leading(20)
    assert torch.allclose(found.mean, mean)
    assert torch.allclose(found.factor.T @ found.factor, wanted, atol=1e-6)
    leading = found.leading(2).factor
    assert torch.allclose(leading.square().sum(), torch.linalg.eigvalsh(wanted)[-2:].sum(), rtol=1e-5)
    assert prior.heads_of(0) == [0, 1]


def test_coefficients_move_with_what_is_changed_as_on_people_of_their_kind():
    prior = prior_of_parts(seed=1)
    prior = dataclasses.replace(prior, left=prior.left * 0, head_left=prior.head_left * 0)
    factor, centre = prior.gaussian_of(0, int(prior.head[0, 2])).factor.numpy(), prior.centre[0, 2]
    h, change = np.random.default_rng(0).normal(size=(2, len(prior.parity))), np.array([0.3, -0.2])
    wanted = factor.T @ factor @ h.T @ np.linalg.solve(h @ factor.T @ factor @ h.T, change)
    moved = prior.moved(centre, torch.from_numpy(h), torch.from_numpy(change)) - centre
    assert np.allclose(moved, wanted, rtol=0.02, atol=0.01 * np.abs(wanted).max())


def test_all_people_are_one_gaussian(prior):
    single, found = prior.gaussian(), prior.gaussian_of_all(directions=20)
    assert torch.allclose(found.mean, single.centre[0, 0])
    assert torch.allclose(found.factor.T @ found.factor, spread(single.axes[0], single.variance[0], 0), atol=1e-9)


def test_samples_have_the_prior_s_moments(prior):
    z = prior.sample(60_000, torch.Generator().manual_seed(0))
    coefficients, rest = prior.split(z)
    centre = torch.einsum("gm,gmr->r", prior.log_weight.exp(), prior.centre)
    assert (z.mean(0) - prior.mean - (centre @ pictures_of(prior)).unflatten(0, SHAPE)).abs().max() < 0.05
    assert torch.allclose(coefficients.var(0), prior.marginal_variance(), rtol=0.05)
    assert rest.square().sum(0).sum() < 1.05 * prior.rest_variance.sum() * 60_000


def test_single_gaussian_has_the_mixture_s_mean_and_covariance(prior):
    single = prior.gaussian()
    c = prior.split(prior.sample(80_000, torch.Generator().manual_seed(3)))[0]
    expected = single.axes[0].T @ torch.diag(single.variance[0]) @ single.axes[0]
    assert (torch.cov(c.T) - expected).abs().max() < 0.05 * expected.abs().max()
    assert torch.allclose(single.centre[0, 0], c.mean(0), atol=0.05)


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
    nobody = dataclasses.replace(prior, kind=torch.zeros_like(prior.kind))
    asked = torch.eye(3, dtype=F64)[:1]
    assert torch.equal(nobody.log_weights(asked)[0], nobody.log_weight)
