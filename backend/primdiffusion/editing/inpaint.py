"""Resample a region of a human (RePaint, Lugmayr et al. 2022), or harmonise it with the rest.

The primitives outside the region stay bit-identical. Needs no training.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.samplers import Denoise, SamplerStep, ddpm_step, gaussian_noise
from primdiffusion.diffusion.schedule import CLEAN, Schedule
from primdiffusion.editing.edit import (
    OnStep,
    combine,
    conditional_denoiser,
    decode_latents,
    edit_generator,
    edit_timesteps,
    encode_human,
    kept_attributes,
    match_density,
    run_sampler,
    with_edit,
)
from primdiffusion.editing.regions import check_region, name_region
from primdiffusion.formats import requests
from primdiffusion.human import Human, model_provenance
from primdiffusion.runtime.device import on_fixed_threads

RESAMPLES = 2
"""Number of times that each step but the last is sampled; 1 disables resampling."""


def repaint(
    denoise: Denoise,
    schedule: Schedule,
    x: Float[Tensor, "b c h w"],
    known: Float[Tensor, "b c h w"],
    inside: Bool[Tensor, "h w"],
    steps: Sequence[int],
    generator: torch.Generator,
    resamples: int = RESAMPLES,
) -> Iterator[SamplerStep]:
    """Sample the region `inside` along the descending `steps`, conditioned on the clean latent `known` outside.

    At every level t the outside is q_sample(known, t) with fresh noise (SPEC 3); inside, a step samples the posterior
    (paper eq. 6-7). A single step fits the inside to an outside of a higher noise level; so after a step its noise is
    added to both again and it is repeated (their alg. 1, with jumps of one step: Lugmayr et al. jump 10 of 250, but
    with a few dozen longer steps these fit best for the same number of calls). Only the inside of `x`, a latent at
    steps[0], is used. The last x0 equals `known` outside.
    """
    moves = [move for move in pairwise(steps) for _ in range(resamples)] + [(steps[-1], CLEAN)]
    x = torch.where(inside, x, add_noise(schedule, known, steps[0], generator))
    for index, (t, t_next) in enumerate(moves):
        if index and moves[index - 1] == (t, t_next):
            x = renoise(schedule, x, t_next, t, generator)
        x0 = torch.where(inside, denoise(x, t), known)
        x = schedule.posterior_mean(x, x0, t, t_next)
        if t_next != CLEAN:
            x = x + schedule.posterior_std(t, t_next) * gaussian_noise(x, generator)
        x = torch.where(inside, x, add_noise(schedule, known, t_next, generator))
        yield SamplerStep(index, len(moves), t, x0, x)


def paste_after_steps(
    denoise: Denoise,
    schedule: Schedule,
    x: Float[Tensor, "b c h w"],
    known: Float[Tensor, "b c h w"],
    inside: Bool[Tensor, "h w"],
    steps: Sequence[int],
    generator: torch.Generator,
) -> Iterator[SamplerStep]:
    """Sample the region `inside` as the released code's mask does (SPEC 3), for comparison with `repaint`.

    A step from level t to t' samples everything (paper eq. 6-7), then pastes q_sample(known, t) outside, which is
    noisier by one step than the inside; nothing is sampled twice. `x` is used whole, so that the first step sees noise
    outside. The last x0 equals `known` outside, where the last x keeps the noise of the last step.
    """
    for index, (t, t_next) in enumerate(pairwise((*steps, CLEAN))):
        x0 = denoise(x, t)
        x = ddpm_step(schedule, x, x0, t, t_next, generator)
        x = torch.where(inside, x, add_noise(schedule, known, t, generator))
        yield SamplerStep(index, len(steps), t, torch.where(inside, x0, known), x)


def add_noise(schedule: Schedule, x0: Float[Tensor, "b c h w"], t: int, generator: torch.Generator) -> Tensor:
    """Noise clean latents to level t; unchanged for `CLEAN`."""
    if t == CLEAN:
        return x0
    level = torch.full((len(x0),), t, dtype=torch.int64, device=x0.device)
    return schedule.q_sample(x0, level, gaussian_noise(x0, generator))


def renoise(schedule: Schedule, x: Float[Tensor, "b c h w"], t: int, t_up: int, generator: torch.Generator) -> Tensor:
    """Noise latents of level t to the higher level t_up: a sample of q(x_up | x)."""
    ratio = schedule.signal(t_up) / schedule.signal(t)
    return ratio * x + (1 - ratio**2) ** 0.5 * gaussian_noise(x, generator)


MaskedSampler = Callable[
    [Denoise, Schedule, Tensor, Tensor, Tensor, Sequence[int], torch.Generator], Iterator[SamplerStep]
]
DRAWS = 64
"""Draws of the person prior to choose a start from."""
MASKED_SAMPLERS: Mapping[requests.InpaintMethod, MaskedSampler] = {"repaint": repaint, "released": paste_after_steps}
"""Samplers of a region by name."""


@on_fixed_threads
def inpaint(
    model: DiffusionModel,
    human: Human,
    region: Bool[Tensor, "k"],
    seed: int = 0,
    steps: int = requests.Sampling.steps,
    attributes: Mapping[str, str | float] = MappingProxyType({}),
    guidance: float = requests.Conditioning.guidance,
    on_step: OnStep | None = None,
    masking: requests.InpaintMethod = requests.InpaintRequest.masking,
) -> Human:
    """Return the human with the primitives of a region resampled to fit the others (`repaint`).

    The region starts from noise. Betas, and the payload outside the region, stay bit-identical: those primitives
    are never decoded. `attributes` condition the region; without any the result is unconditional. Costs nearly
    2 * `steps` denoiser calls. Deterministic as `human.generate`. With `masking` "released" the sampler is
    `paste_after_steps`, at `steps` calls.

        >>> changed = pd.inpaint(model, human, region, seed=1)
        >>> changed.payload.rgb[~region].equal(human.payload.rgb[~region])
        True

    Raises ValueError for a region that is empty, whole or not a mask of K, steps outside 1 ... T, a seed outside
    0 ... 2^63-1, unknown attributes and an unknown masking.
    """
    if masking not in MASKED_SAMPLERS:
        raise ValueError(f"masking is {masking!r}: choose one of {', '.join(map(repr, MASKED_SAMPLERS))}")
    region = check_region(region)
    if region.all():
        raise ValueError("the region is the whole human: use generate or vary instead")
    generator = edit_generator(seed)
    chain = model.chain(model.schedule.length, steps)
    model = match_density(model, human)
    denoise = conditional_denoiser(model, attributes, guidance)
    known, inside = encode_human(model, human), model.cell_mask(region)
    start = start_like(model, known, inside, chain[0], model.condition(attributes), generator)
    sampler = MASKED_SAMPLERS[masking](denoise, model.schedule, start, known, inside, chain, generator)
    x0 = run_sampler(sampler, on_step)
    edit = {"edit": "inpaint", "region": name_region(region, human.body_setup), "seed": seed, "steps": steps}
    edit = {**edit, "masking": masking, "attributes": dict(attributes), "guidance": guidance, **model_provenance(model)}
    return with_edit(human, edit, combine(region, decode_latents(model, x0), human.payload))


def start_like(
    model: DiffusionModel,
    known: Float[Tensor, "1 c h w"],
    inside: Bool[Tensor, "h w"],
    t: int,
    condition: Float[Tensor, "a"] | None,
    generator: torch.Generator,
) -> Float[Tensor, "1 c h w"]:
    """The start of a region at step t: of some draws of the person prior the one that is most like the known part.

    What people have in common, such as the tone of their skin, still shows there (`DiffusionModel.start`).
    """
    if not isinstance(model.denoiser, PersonDenoiser):
        return model.start([generator], t, condition)
    draws = model.denoiser.prior.sample(DRAWS, generator, None if condition is None else condition[None])
    distance = (draws - known).square().masked_fill(inside, 0).sum((1, 2, 3))
    return add_noise(model.schedule, draws[distance.argmin()][None], t, generator)


@on_fixed_threads
def harmonise(
    model: DiffusionModel,
    human: Human,
    region: Bool[Tensor, "k"],
    amount: float = 0.3,
    seed: int = 0,
    steps: int = requests.Sampling.steps,
    on_step: OnStep | None = None,
) -> Human:
    """Return the human with a region, for instance a transferred one, harmonised with the rest: noised and denoised.

    As `inpaint`, but the region starts from its present content, noised to a level that grows with `amount`: 0 leaves
    it unchanged, 1 starts from pure noise. The rest stays bit-identical. The region may be the whole human; the result
    is then a variant without the detail that the codec drops. Raises ValueError as `inpaint`, and for an amount outside
    0 ... 1.
    """
    region = check_region(region)
    generator = edit_generator(seed)
    model = match_density(model, human)
    chain = edit_timesteps(model, amount, steps)
    payload = human.payload
    if chain:
        known, inside = encode_human(model, human), model.cell_mask(region)
        start = add_noise(model.schedule, known, chain[0], generator)
        denoise = conditional_denoiser(model, kept_attributes(model, human, known, {}), guidance=1.0)
        x0 = run_sampler(repaint(denoise, model.schedule, start, known, inside, chain, generator), on_step)
        payload = combine(region, decode_latents(model, x0), human.payload)
    edit = {
        "edit": "harmonise",
        "region": name_region(region, human.body_setup),
        "amount": amount,
        "seed": seed,
        "steps": steps,
    }
    return with_edit(human, {**edit, **model_provenance(model)}, payload)
