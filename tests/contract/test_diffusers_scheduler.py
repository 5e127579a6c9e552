"""The example of a scheduler, beside diffusers' own schedulers with the same betas."""

import sys
from pathlib import Path

import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from primdiffusion.diffusion.model import sample
from primdiffusion.formats import requests
from support.tiny import tiny_model

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from diffusers_scheduler import PrimDiffusionScheduler

SHAPE = (2, 3, 4, 4)
GUIDANCE = requests.Conditioning.guidance
TRAILING = {"beta_schedule": "linear", "beta_start": 1e-4, "beta_end": 0.02, "timestep_spacing": "trailing"}


def noise(seed):
    return torch.randn(SHAPE, generator=torch.Generator().manual_seed(seed))


def looped(scheduler, prediction, seed=1, **extra):
    """diffusers' loop with a made-up network, tanh of its input."""
    scheduler.set_timesteps(20)
    x, generator = noise(seed), torch.Generator().manual_seed(7)
    for t in scheduler.timesteps:
        seen = scheduler.scale_model_input(x, t)
        output = seen.tanh() if prediction == "sample" else 0.9 * seen
        x = scheduler.step(output, t, x, generator=generator, **extra).prev_sample
    return x


@pytest.mark.parametrize("prediction", ["sample", "epsilon"])
@pytest.mark.parametrize(
    ("sampler", "theirs", "settings"),
    [
        ("ddpm", DDPMScheduler, {"clip_sample": False}),
        ("ddim", DDIMScheduler, {"clip_sample": False}),
        ("dpmpp_2m", DPMSolverMultistepScheduler, {"algorithm_type": "dpmsolver++", "solver_order": 2}),
    ],
)
def test_the_loop_ends_where_diffusers_own_scheduler_does(sampler, theirs, settings, prediction):
    expected = looped(theirs(prediction_type=prediction, **TRAILING, **settings), prediction)
    ours = looped(PrimDiffusionScheduler(sampler=sampler, prediction_type=prediction), prediction)
    torch.testing.assert_close(ours, expected, atol=2e-4, rtol=2e-4)  # diffusers keeps its levels in float32


def test_eta_adds_the_noise_that_diffusers_adds():
    expected = looped(DDIMScheduler(prediction_type="sample", clip_sample=False, **TRAILING), "sample", eta=0.7)
    ours = looped(PrimDiffusionScheduler(eta=0.7), "sample")
    torch.testing.assert_close(ours, expected, atol=2e-4, rtol=2e-4)


def test_noise_is_added_as_diffusers_adds_it():
    t = torch.tensor([3, 900])
    expected = DDPMScheduler(**TRAILING).add_noise(noise(1), noise(2), t)
    torch.testing.assert_close(PrimDiffusionScheduler().add_noise(noise(1), noise(2), t), expected)


@pytest.mark.parametrize("sampler", ["ddim", "dpmpp_2m", "ddpm"])
def test_diffusers_loop_draws_the_model_s_own_samples(sampler):
    model = tiny_model()
    seeds = range(5, 13)
    *_, last = sample(model, seeds, steps=6, sampler=sampler)
    scheduler = PrimDiffusionScheduler.of(model, sampler)
    scheduler.set_timesteps(6)
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    condition = model.complete(generators)
    x = model.start(generators, int(scheduler.timesteps[0]), condition)
    for t in scheduler.timesteps:
        x, x0 = scheduler.step(model.denoise(x, int(t), condition, GUIDANCE), t, x, generators, return_dict=False)
    assert torch.equal(x0, last.x0)
