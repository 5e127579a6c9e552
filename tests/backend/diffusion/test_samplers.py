import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from primdiffusion.diffusion.samplers import RELEASED_END, ddim, ddpm, dpmpp_2m, gaussian_noise
from primdiffusion.diffusion.schedule import (
    CLEAN,
    Schedule,
    linear,
    released_steps,
    sqrt_linear,
    trailing_steps,
)
from support.errors import refused

F64 = torch.float64
CENTRES = torch.tensor([[2.0, -1.0, 0.5], [-1.0, 1.5, 0.0], [0.0, 0.0, -2.0]], dtype=F64)
SPREADS = torch.tensor([0.3, 0.7, 0.1], dtype=F64)
SHARES = torch.tensor([0.5, 0.3, 0.2], dtype=F64)


def of_mixture(schedule):
    """E[x0 | x] for x0 of a mixture of three Gaussians: nonlinear and steep where x lies between two of them."""

    def denoise(x, t):
        signal, noise = schedule.signal(t), schedule.noise(t)
        total = signal**2 * SPREADS**2 + noise**2
        off = x[..., None, :] - signal * CENTRES
        share = (SHARES.log() - 1.5 * total.log() - off.square().sum(-1) / (2 * total)).softmax(-1)
        means = CENTRES + (signal * SPREADS**2 / total)[:, None] * off
        return (share[..., None] * means).sum(-2)

    return denoise


def theirs(kind, schedule, x, steps, seed, extra=None, **settings):
    scheduler = kind(1000, prediction_type="sample", **settings)
    scheduler.set_timesteps(steps)
    # diffusers keeps its schedule in float32: give it ours, to compare the formulas and not the rounding
    scheduler.alphas_cumprod = schedule.alpha_bar
    scheduler.alphas = schedule.alpha_bar / torch.cat([torch.ones(1, dtype=F64), schedule.alpha_bar[:-1]])
    scheduler.betas, scheduler.one = 1 - scheduler.alphas, torch.ones((), dtype=F64)
    if kind is DPMSolverMultistepScheduler:
        alpha_bar = torch.cat([schedule.alpha_bar[scheduler.timesteps], torch.ones(1, dtype=F64)])
        scheduler.sigmas = ((1 - alpha_bar) / alpha_bar).sqrt()
    denoise, generator = of_mixture(schedule), torch.Generator().manual_seed(seed)
    for t in scheduler.timesteps:
        x = scheduler.step(denoise(x, int(t)), t, x, generator=generator, **(extra or {})).prev_sample
    return x, scheduler.timesteps.tolist()


def start(count=4):
    return torch.randn(count, 3, dtype=F64, generator=torch.Generator().manual_seed(5))


def seeded_generators(*seeds):
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def last(steps):
    *_, step = steps
    return step


both_schedules = pytest.mark.parametrize("schedule", [linear(), sqrt_linear()], ids=["linear", "sqrt_linear"])
every_sampler = pytest.mark.parametrize("sampler", [ddpm, ddim, dpmpp_2m])


@both_schedules
@pytest.mark.parametrize("steps", [1000, 40])
def test_ddpm_is_that_of_diffusers(schedule, steps):
    expected, chain = theirs(DDPMScheduler, schedule, start(), steps, 3, clip_sample=False, timestep_spacing="trailing")
    assert chain == trailing_steps(1000, steps)
    ours = last(ddpm(of_mixture(schedule), schedule, start(), chain, torch.Generator().manual_seed(3)))
    assert (ours.x - expected).abs().max() < 1e-5


@both_schedules
@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_ddim_is_that_of_diffusers(schedule, eta):
    settings = {"clip_sample": False, "timestep_spacing": "leading", "steps_offset": 1}
    expected, chain = theirs(DDIMScheduler, schedule, start(), 100, 3, {"eta": eta}, **settings)
    assert chain == released_steps(1000, 100)
    ours = last(ddim(of_mixture(schedule), schedule, start(), chain, torch.Generator().manual_seed(3), eta))
    assert (ours.x - expected).abs().max() < 1e-5


@both_schedules
@pytest.mark.parametrize(("steps", "chain"), [(100, released_steps(1000, 100)), (1000, list(range(999, -1, -1)))])
def test_ddim_that_ends_at_the_released_level_is_that_of_diffusers_without_a_clean_end(schedule, steps, chain):
    settings = {"clip_sample": False, "timestep_spacing": "leading", "steps_offset": int(steps < 1000)}
    settings |= {"set_alpha_to_one": False}
    kind = of_released_levels(schedule)
    expected, visited = theirs(kind, schedule, start(), steps, 3, **settings)
    assert visited == chain
    found = last(ddim(of_mixture(schedule), schedule, start(), chain, [], end=RELEASED_END))
    assert (found.x - expected).abs().max() < 1e-7
    assert (found.x - found.x0).abs().max() > 1e-4
    assert schedule.noise(0) == pytest.approx(0.01)


def of_released_levels(schedule):
    """diffusers' DDIM, whose last level is that of this schedule's step 0."""

    class Scheduler(DDIMScheduler):
        def set_timesteps(self, *arguments):
            super().set_timesteps(*arguments)
            self.final_alpha_cumprod = schedule.alpha_bar[0]

    return Scheduler


@both_schedules
@pytest.mark.parametrize("steps", [1, 2, 8, 30])
def test_dpmpp_2m_is_that_of_diffusers(schedule, steps):
    settings = {"algorithm_type": "dpmsolver++", "solver_type": "midpoint", "solver_order": 2}
    expected, chain = theirs(
        DPMSolverMultistepScheduler, schedule, start(), steps, 0, timestep_spacing="trailing", **settings
    )
    assert chain == trailing_steps(1000, steps)
    ours = last(dpmpp_2m(of_mixture(schedule), schedule, start(), chain, []))
    assert (ours.x - expected).abs().max() < 1e-5


# where the two leading errors of 2M have one sign: at 0.6 they cancel near 20 steps, and hide its order until 300
MEAN, STD, END = 1.0, 1.5, 99


def slope(sampler, schedule):
    """Measured order: error on the probability-flow ODE of Gaussian data against the number of steps from 999 to END.

    Where x0 ~ N(m, s^2), the flow keeps (x - signal m) / sqrt(signal^2 s^2 + noise^2), so its end is known exactly.
    It is read before the last denoising: that step has infinite length in half log SNR, and its error is the spread of
    x0 at level END, whatever came before.
    """

    def marginal(t):
        return (schedule.signal(t) ** 2 * STD**2 + schedule.noise(t) ** 2) ** 0.5

    def denoise(x, t):
        signal = schedule.signal(t)
        return MEAN + signal * STD**2 / marginal(t) ** 2 * (x - signal * MEAN)

    x = start()
    exact = schedule.signal(END) * MEAN + marginal(END) / marginal(999) * (x - schedule.signal(999) * MEAN)
    counts, errors = (30, 60, 100, 180, 300, 450), []
    for count in counts:
        chain = list(range(999, END - 1, -900 // count))
        *_, before_last, _ = sampler(denoise, schedule, x, chain, [])
        errors.append(float((before_last.x - exact).abs().max()))
    return -np.polyfit(np.log(counts), np.log(errors), 1)[0]


@both_schedules
@pytest.mark.parametrize(("sampler", "order"), [(ddim, 1), (dpmpp_2m, 2)])
def test_error_falls_with_the_sampler_s_order(schedule, sampler, order):
    assert slope(sampler, schedule) == pytest.approx(order, abs=0.06)


@every_sampler
@pytest.mark.parametrize("chain", [[10, 20], [10, 10], [5, CLEAN, 3]])
def test_steps_that_do_not_go_down_are_rejected(sampler, chain):
    with refused(ValueError, "earlier"):
        list(sampler(of_mixture(linear()), linear(), start(), chain, torch.Generator()))


@every_sampler
def test_a_sampler_that_is_not_asked_does_no_work(sampler):
    calls = []

    def counting(x, t):
        calls.append(t)
        return x

    running = sampler(counting, linear(), start(), trailing_steps(1000, 10), torch.Generator())
    next(running)
    next(running)
    running.close()
    assert len(calls) == 2


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_noise_of_a_sample_is_bit_identical_in_any_batch(dtype):
    like = torch.zeros(3, 2, 5, dtype=dtype)
    together = gaussian_noise(like, seeded_generators(1, 2, 3))
    assert together.dtype == dtype
    assert torch.equal(together[1:2], gaussian_noise(like[:1], seeded_generators(2)))
    assert torch.equal(together[[2, 0]], gaussian_noise(like[:2], seeded_generators(3, 1)))
    assert not torch.equal(together[0], together[1])


def test_too_few_generators_are_rejected():
    with refused(ValueError, "3 samples"):
        gaussian_noise(torch.zeros(3, 4), seeded_generators(1, 2))


def test_dpmpp_2m_starts_where_there_is_no_signal():
    # the first step is then infinitely long, and the second must not extrapolate from it
    root = linear().alpha_bar.sqrt()
    schedule = Schedule(((root - root[-1]) * root[0] / (root[0] - root[-1])) ** 2)  # Lin et al. 2024, alg. 1
    chain = trailing_steps(1000, 6)
    steps = list(dpmpp_2m(of_mixture(schedule), schedule, start(), chain, []))
    assert steps[-1].x.isfinite().all()
    first = next(iter(ddim(of_mixture(schedule), schedule, start(), chain, [])))
    assert torch.allclose(steps[0].x, first.x, atol=1e-12)
