import math

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from primdiffusion.diffusion.schedule import (
    CLEAN,
    early_steps,
    fine_linear,
    linear,
    released_steps,
    sqrt_linear,
    trailing_steps,
)
from scipy.stats import kstest
from support.errors import refused


@pytest.mark.parametrize(("ours", "theirs"), [(linear, "linear"), (sqrt_linear, "scaled_linear")])
def test_schedules_are_those_of_diffusers(ours, theirs):
    expected = DDPMScheduler(1000, beta_start=1e-4, beta_end=2e-2, beta_schedule=theirs).alphas_cumprod
    assert torch.allclose(ours().alpha_bar.float(), expected, rtol=2e-5, atol=0)


def test_q_sample_has_the_schedule_s_mean_and_spread():
    schedule, generator = linear(), torch.Generator().manual_seed(0)
    x0 = torch.full((20_000, 1), 3.0, dtype=torch.float64)
    noise = torch.randn(x0.shape, generator=generator, dtype=torch.float64)
    x = schedule.q_sample(x0, torch.full((20_000,), 400), noise)
    standard = (x - schedule.signal(400) * 3.0) / schedule.noise(400)
    assert kstest(standard.numpy()[:, 0], "norm").pvalue > 1e-3


def test_one_step_posterior_follows_from_bayes_rule():
    # q(x_prev | x, x0) ~ q(x | x_prev) q(x_prev | x0): precisions add
    schedule, t = linear(), 300
    alpha = (schedule.signal(t) / schedule.signal(t - 1)) ** 2
    precision = alpha / (1 - alpha) + 1 / schedule.noise(t - 1) ** 2
    x, x0 = torch.tensor(0.7, dtype=torch.float64), torch.tensor(-0.4, dtype=torch.float64)
    mean = (alpha**0.5 * x / (1 - alpha) + schedule.signal(t - 1) * x0 / schedule.noise(t - 1) ** 2) / precision
    assert schedule.posterior_mean(x, x0, t, t - 1).item() == pytest.approx(mean.item(), abs=1e-12)
    assert schedule.posterior_std(t, t - 1) == pytest.approx(precision**-0.5, abs=1e-12)


def test_trailing_steps_begin_at_the_end_and_released_ones_end_before_the_first():
    assert trailing_steps(1000, 4) == [999, 749, 499, 249]
    assert released_steps(1000, 100)[:2] == [991, 981]
    assert released_steps(1000, 100)[-1] == 1
    assert trailing_steps(1000, 1000) == list(range(999, -1, -1))
    assert np.all(np.diff(trailing_steps(1000, 30)) < 0)


@pytest.mark.parametrize("steps", [1, 2, 7, 30, 100, 950, 1000])
def test_early_steps_are_evenly_spaced_from_the_end_to_a_level_of_noise(steps):
    chain = early_steps(1000, steps)
    assert len(chain) == steps
    assert chain[0] == 999
    gaps = -np.diff(chain)
    assert (gaps > 0).all()
    assert steps == 1 or gaps.max() - gaps.min() <= 1
    assert chain[-1] == {1: 999, 1000: 0}.get(steps, 50)


def test_the_fine_schedule_ends_as_the_paper_s_and_begins_with_less_noise():
    fine, paper = fine_linear(), linear()
    assert fine.noise(0) < 0.2 * paper.noise(0)
    assert fine.signal(999) == pytest.approx(paper.signal(999), rel=0.1)
    assert bool((fine.alpha_bar.diff() < 0).all())


@pytest.mark.parametrize("steps", [0, 1001, -3])
def test_impossible_numbers_of_steps_are_rejected(steps):
    with refused(ValueError, str(steps)):
        trailing_steps(1000, steps)
    with refused(ValueError, str(steps)):
        early_steps(1000, steps)


def test_steps_forward_and_noise_of_a_clean_sample_are_rejected():
    with refused(ValueError, "t_prev=5"):
        linear().posterior_std(5, 5)
    with refused(ValueError, "t_prev=7"):
        linear().half_log_snr_gain(5, 7)
    with refused(ValueError, "clean"):
        linear().epsilon(torch.zeros(1), torch.zeros(1), CLEAN)


@pytest.mark.parametrize("schedule", [linear(), sqrt_linear()])
def test_half_log_snr_is_the_logarithm_of_signal_over_noise(schedule):
    for t in (0, 10, 500, 999):
        assert schedule.half_log_snr(t) == pytest.approx(math.log(schedule.signal(t) / schedule.noise(t)), abs=1e-9)
    assert schedule.half_log_snr(CLEAN) == math.inf
    assert schedule.half_log_snr_gain(900, 100) == pytest.approx(
        schedule.half_log_snr_gain(900, 500) + schedule.half_log_snr_gain(500, 100), abs=1e-12
    )
