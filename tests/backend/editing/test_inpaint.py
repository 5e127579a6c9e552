"""Sampling a part: the rest at its own noise level at every step, and a part that fits the rest."""

import pytest
import torch
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.schedule import CLEAN, linear, trailing_steps
from primdiffusion.editing.inpaint import add_noise, paste_after_steps, renoise, repaint, start_like
from support.tiny import tiny_model

SCHEDULE = linear()
CHAIN = trailing_steps(SCHEDULE.length, 12)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


KNOWN = 3 + 2 * torch.randn(1, 4, 64, 64, generator=generator(1))
START = torch.randn(KNOWN.shape, generator=generator(2))
INSIDE = (torch.arange(64) >= 40).expand(64, 64)


@pytest.mark.parametrize("resamples", [1, 2])
def test_the_denoiser_always_sees_the_outside_with_the_noise_of_the_step_it_is_asked_about(resamples):
    seen = []

    def denoise(x, t):
        noise = ((x - SCHEDULE.signal(t) * KNOWN) / SCHEDULE.noise(t))[..., ~INSIDE]
        seen.append((t, float(noise.mean()), float(noise.std())))
        return torch.zeros_like(x)

    steps = list(repaint(denoise, SCHEDULE, START, KNOWN, INSIDE, CHAIN, generator(3), resamples))
    assert {t for t, _, _ in seen} == set(CHAIN)
    assert len(seen) == len(steps) == steps[0].total
    for t, mean, std in seen:
        assert abs(mean) < 0.05, t
        assert abs(std - 1) < 0.03, t


def test_what_a_step_leaves_outside_has_the_noise_of_the_level_it_leads_to():
    known = torch.randn(1, 4, 64, 64, generator=generator(1))
    inside = torch.zeros(64, 64, dtype=torch.bool)
    inside[0, 0] = True
    chain = trailing_steps(SCHEDULE.length, 5)
    steps = list(repaint(lambda x, t: x, SCHEDULE, known, known, inside, chain, generator(), 1))
    for step, t_next in zip(steps, [*chain[1:], CLEAN], strict=True):
        left = (step.x - SCHEDULE.signal(t_next) * known)[..., ~inside]
        assert float(left.std()) == pytest.approx(SCHEDULE.noise(t_next), rel=0.03)
    assert torch.equal(steps[-1].x0[..., ~inside], known[..., ~inside])


def test_as_released_the_outside_is_one_step_noisier_than_the_denoiser_is_told():
    """The known region is pasted at the wrong noise level by one step (SPEC 3), and no step is sampled twice."""
    seen = []

    def denoise(x, t):
        seen.append((t, x[..., ~INSIDE]))
        return torch.zeros_like(x)

    steps = list(paste_after_steps(denoise, SCHEDULE, START, KNOWN, INSIDE, CHAIN, generator(3)))
    assert [t for t, _ in seen] == CHAIN
    assert [(step.index, step.total) for step in steps] == [(index, 12) for index in range(12)]
    assert torch.equal(seen[0][1], START[..., ~INSIDE])
    for before, (t, outside) in zip(CHAIN, seen[1:], strict=False):
        added = outside - SCHEDULE.signal(before) * KNOWN[..., ~INSIDE]
        assert float(added.std()) == pytest.approx(SCHEDULE.noise(before), rel=0.03), t
    assert torch.equal(steps[-1].x0[..., ~INSIDE], KNOWN[..., ~INSIDE])


def test_noise_added_on_the_way_up_makes_a_sample_of_the_upper_level():
    known = torch.full((1, 8, 64, 64), 2.0)
    x = renoise(SCHEDULE, add_noise(SCHEDULE, known, 200, generator(1)), 200, 700, generator(2))
    assert float(x.mean()) == pytest.approx(2 * SCHEDULE.signal(700), abs=0.02)
    assert float(x.std()) == pytest.approx(SCHEDULE.noise(700), rel=0.01)


def correlated(covariance: torch.Tensor):
    """The exact denoiser of pairs of numbers that are normal with this covariance."""

    def denoise(x, t):
        signal, noise = SCHEDULE.signal(t), SCHEDULE.noise(t)
        gain = signal * covariance @ torch.linalg.inv(signal**2 * covariance + noise**2 * torch.eye(2))
        return x @ gain.T

    return denoise


def inside_mean(paint, *resamples: int) -> float:
    """Mean of one of a pair when the other is known to be 1.5; their correlation is 0.9."""
    denoise = correlated(torch.tensor([[1.0, 0.9], [0.9, 1.0]]))
    known = torch.tensor([1.5, 0.0]).expand(20000, 1, 1, 2)
    inside = torch.tensor([[False, True]])
    start, chain = torch.randn(known.shape, generator=generator(4)), trailing_steps(SCHEDULE.length, 30)
    *_, step = paint(denoise, SCHEDULE, start, known, inside, chain, generator(5), *resamples)
    return float(step.x0[..., 1].mean())


def test_the_more_often_steps_are_sampled_the_better_the_inside_fits_the_outside():
    fits = 0.9 * 1.5
    misses = [fits - inside_mean(repaint, resamples) for resamples in (1, 2, 5)]
    assert fits - inside_mean(paste_after_steps) > misses[1], "as released"
    assert misses[0] > misses[1] > misses[2] > 0
    assert misses[2] < 0.35 * misses[0]


def test_a_region_starts_from_a_draw_of_people_that_is_like_the_known_part():
    """A part alone does not say which skin goes with the rest; the start does."""
    model = tiny_model()
    assert isinstance(model.denoiser, PersonDenoiser)
    inside = torch.zeros(32, 32, dtype=torch.bool)
    inside[8:] = True
    draws = model.denoiser.prior.sample(200, generator(5))
    for known in draws[:3]:
        start = start_like(model, known.masked_fill(inside, 9.0)[None], inside, 0, None, generator(1))
        apart, inner = ((each - known).square().mean(1) for each in (torch.cat([start, draws[3:]]), draws[3:]))
        assert float(apart[0][~inside].mean()) < float(apart[1:][:, ~inside].mean(1).median()) / 3
        assert float(apart[0][inside].mean()) < float(inner[:, inside].mean(1).median()) / 3
