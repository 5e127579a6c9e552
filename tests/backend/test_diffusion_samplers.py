import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler
from primdiffusion.diffusion.samplers import ddim, ddpm
from primdiffusion.diffusion.schedule import leading_steps, linear, trailing_steps

F64 = torch.float64


def crooked(x, t):
    """A denoiser that is nonlinear and depends on t, so that a mistake in any coefficient shows."""
    return torch.tanh(x * (0.5 + t / 1000)) + 0.1 * x.flip(-1)


def theirs(kind, x, steps, seed, extra=None, **settings):
    scheduler = kind(1000, prediction_type="sample", clip_sample=False, **settings)
    scheduler.set_timesteps(steps)
    # diffusers keeps its schedule in float32: give it ours, to compare the formulas and not the rounding
    scheduler.alphas_cumprod = linear().alpha_bar
    scheduler.alphas = scheduler.alphas_cumprod / torch.cat([torch.ones(1, dtype=F64), scheduler.alphas_cumprod[:-1]])
    scheduler.betas, scheduler.one = 1 - scheduler.alphas, torch.ones((), dtype=F64)
    generator = torch.Generator().manual_seed(seed)
    for t in scheduler.timesteps:
        x = scheduler.step(crooked(x, int(t)), t, x, generator=generator, **(extra or {})).prev_sample
    return x, scheduler.timesteps.tolist()


def start():
    return torch.randn(2, 3, 4, dtype=F64, generator=torch.Generator().manual_seed(5))


def last(steps):
    *_, step = steps
    return step


@pytest.mark.parametrize("steps", [1000, 40])
def test_ddpm_is_that_of_diffusers(steps):
    expected, chain = theirs(DDPMScheduler, start(), steps, 3, timestep_spacing="trailing")
    assert chain == trailing_steps(1000, steps)
    ours = last(ddpm(crooked, linear(), start(), chain, torch.Generator().manual_seed(3)))
    assert (ours.x - expected).abs().max() < 1e-5


@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_ddim_is_that_of_diffusers(eta):
    expected, chain = theirs(DDIMScheduler, start(), 100, 3, {"eta": eta}, timestep_spacing="leading", steps_offset=1)
    assert chain == leading_steps(1000, 100)
    ours = last(ddim(crooked, linear(), start(), chain, torch.Generator().manual_seed(3), eta))
    assert (ours.x - expected).abs().max() < 1e-5


@pytest.mark.parametrize(
    ("sampler", "steps", "tolerance"), [(ddpm, 1000, 0.03), (ddim, 1000, 0.03), (ddim, 100, 0.05), (ddpm, 30, 0.35)]
)
def test_an_exact_denoiser_gives_back_its_gaussian(sampler, steps, tolerance):
    # few ancestral steps are known to narrow the distribution: the tolerance says by how much at 30
    mean, std, schedule = 2.0, 0.6, linear()

    def exact(x, t):
        signal, noise = schedule.signal(t), schedule.noise(t)
        return mean + signal * std**2 / (signal**2 * std**2 + noise**2) * (x - signal * mean)

    generator = torch.Generator().manual_seed(0)
    x = torch.randn(40_000, 1, dtype=F64, generator=generator)
    x = last(sampler(exact, schedule, x, trailing_steps(1000, steps), generator)).x
    assert x.mean().item() == pytest.approx(mean, abs=0.03)
    assert x.std().item() == pytest.approx(std, rel=tolerance)


@pytest.mark.parametrize("sampler", [ddpm, ddim])
def test_steps_count_up_go_down_and_end_clean(sampler):
    steps = list(sampler(crooked, linear(), start(), trailing_steps(1000, 7), torch.Generator()))
    assert [s.index for s in steps] == list(range(7))
    assert {s.total for s in steps} == {7}
    assert [s.t for s in steps] == trailing_steps(1000, 7)
    assert torch.equal(steps[-1].x, steps[-1].x0)


@pytest.mark.parametrize("sampler", [ddpm, ddim])
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


def test_ddim_without_eta_draws_nothing():
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    list(ddim(crooked, linear(), start(), trailing_steps(1000, 5), generator))
    assert torch.equal(before, generator.get_state())
