"""Losses, noise levels and blends of the training of the diffusion model."""

import dataclasses
import math

import pytest
import torch
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.schedule import fine_linear, linear
from primdiffusion.training.cells import CellTask
from primdiffusion.training.config import NetworkTraining
from primdiffusion.training.latents import LatentSet
from primdiffusion.training.losses import (
    blend_conditions,
    blends,
    closed_form,
    mix,
    random_steps,
    weighted_error,
    x0_errors,
)


def latent_set(geometry):
    """Empty latents of these samples."""
    count, geometries = len(geometry), int(geometry.max()) + 1
    latents, betas, condition = torch.zeros(count, 1, 32, 32), torch.zeros(geometries, 10), torch.zeros(count, 0)
    return LatentSet(latents, geometry, betas, condition, torch.tensor(len(geometry)))


def test_a_network_that_knows_more_has_less_error(prepared_once):
    from primdiffusion.diffusion.denoiser import PersonDenoiser

    _, prepared = prepared_once
    denoiser = PersonDenoiser(None, prepared.prior, linear())
    guesses = {
        "nothing": lambda x, t: prepared.prior.mean.expand_as(x),
        "gaussian": closed_form(denoiser, single=True),
        "truth": lambda x, t: prepared.held.latents.float(),
    }
    errors = x0_errors(guesses, denoiser.schedule, prepared.held.latents[:16], levels=(300, 900))
    for level in (300, 900):
        assert errors["gaussian"][level] < errors["nothing"][level]
    assert errors["gaussian"][300] < errors["gaussian"][900]


def test_log_normal_levels_surround_the_spread_and_leave_no_level_untrained():
    schedule = fine_linear()
    t = random_steps(
        schedule,
        20_000,
        torch.Generator().manual_seed(0),
        NetworkTraining(steps=1, batch=1, levels="log_normal"),
        spread=0.05,
    )
    clean, noise = schedule.levels(t, torch.empty(0, 1))
    ratio = (noise / clean).flatten().log()
    assert abs(float(ratio.median()) - math.log(2 * 0.05)) < 0.3
    assert ((ratio > math.log(0.01)) & (ratio < math.log(1.0))).float().mean() > 0.75
    assert (ratio > math.log(10.0)).float().mean() > 0.02


def test_blends_stay_within_a_geometry_and_keep_the_variance():
    geometry = torch.tensor([0, 0, 0, 1, 1, 2])
    people = latent_set(geometry)
    weight, place = blends(people, 40_000, 1.0, torch.Generator().manual_seed(0))
    assert torch.equal(geometry[place[:, 0]], geometry[place[:, 1]])
    assert torch.allclose(weight.sum(1), torch.ones(40_000), atol=1e-6)
    assert weight.square().sum(1).mean().item() == pytest.approx(1.0, abs=0.02)
    assert torch.allclose(torch.bincount(place[:, 0]) / 40_000, torch.full((6,), 1 / 6), atol=0.01)
    alone, _ = blends(people, 100, 0.0, torch.Generator().manual_seed(0))
    assert torch.equal(alone[:, 1], torch.zeros(100))


def test_mixtures_are_weighted_sums_of_two():
    generator = torch.Generator().manual_seed(0)
    samples = torch.randn(5, 3, 4, generator=generator).half()
    weights = torch.tensor([[1.0, 0.0], [0.3, 0.7], [1.4, -0.4]])
    indices = torch.tensor([[0, 4], [1, 2], [3, 3]])
    expected = torch.einsum("bk,bkcd->bcd", weights, samples[indices].float())
    torch.testing.assert_close(mix(samples, weights, indices), expected)


def test_errors_count_by_the_deviation_of_the_closed_form_with_mean_one_at_every_level():
    assert weighted_error(torch.ones(2, 5), torch.rand(2, 5) + 0.1).item() == pytest.approx(1.0, abs=1e-5)
    wide = torch.tensor([[1.0, 3.0]])
    assert weighted_error(torch.tensor([[0.0, 1.0]]), wide).item() == pytest.approx(0.75, abs=1e-6)


def test_the_network_learns(prepared_once):
    config, prepared = prepared_once
    task = CellTask(config, prepared, torch.device("cpu"))
    task.network().requires_grad_(True)
    loss = task.objective.loss(torch.Generator().manual_seed(0))
    loss.backward()
    assert torch.isfinite(loss)
    assert task.network().outer.weight.grad.abs().max() > 0


def test_blends_are_asked_for_by_what_both_people_have():
    condition = torch.tensor([[1.0, 0, 1, 0], [1.0, 0, 0, 1]])
    words = AttributeVocabulary({"sex": ("female", "male"), "pattern": ("patterned", "plain")}, {})
    people = dataclasses.replace(latent_set(torch.zeros(2, dtype=torch.int64)), condition=condition)
    indices, weights = torch.tensor([[0, 1], [0, 1]]), torch.tensor([[0.6, 0.4], [1.0, 0.0]])
    asked = [
        blend_conditions(people, indices, weights, words, 0.0, torch.Generator().manual_seed(s)) for s in range(200)
    ]
    most = torch.stack(asked).amax(0)
    assert torch.equal(most, torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 1, 0]]))
