"""Variants of a human: partial noising and denoising (SDEdit, Meng et al. 2022)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch

from primdiffusion.diffusion.model import DiffusionModel, unfollowed
from primdiffusion.diffusion.samplers import ddim, gaussian_noise
from primdiffusion.editing.edit import (
    OnStep,
    add_residual,
    conditional_denoiser,
    decode_latents,
    difference,
    edit_generator,
    edit_timesteps,
    encode_human,
    kept_attributes,
    match_density,
    run_sampler,
    with_edit,
)
from primdiffusion.formats import requests
from primdiffusion.human import Human, model_provenance
from primdiffusion.runtime.device import on_fixed_threads


def vary(
    model: DiffusionModel,
    human: Human,
    amount: float = 0.5,
    seed: int = 0,
    steps: int = requests.Sampling.steps,
    on_step: OnStep | None = None,
    attributes: Mapping[str, str | float] = MappingProxyType({}),
    guidance: float = requests.Conditioning.guidance,
) -> Human:
    """Return a variant with the same body: the latent is noised to a level that grows with `amount`, then DDIM samples.

    Amount 0 returns the payload unchanged; 1 keeps only what remains visible through the noise of step T-1. In between,
    coarse features (garments, colours) persist longer than fine ones. Detail that the codec drops is added back in
    proportion to the signal at the noise level, so small amounts change little. Betas are unchanged, so armature and
    poses still fit. Deterministic as `human.generate`.

        >>> varied = pd.vary(model, human, amount=0.6, seed=1)
        >>> varied.betas.equal(human.betas)
        True

    Raises ValueError for an amount outside 0 ... 1, steps outside 1 ... T, a seed outside 0 ... 2^63-1 and unknown
    attributes.
    """
    return vary_batch(model, human, amount, [seed], steps, on_step, attributes, guidance)[0]


@on_fixed_threads
def vary_batch(
    model: DiffusionModel,
    human: Human,
    amount: float,
    seeds: Sequence[int],
    steps: int = requests.Sampling.steps,
    on_step: OnStep | None = None,
    attributes: Mapping[str, str | float] = MappingProxyType({}),
    guidance: float = requests.Conditioning.guidance,
) -> list[Human]:
    """Return variants for several seeds, sampled as one batch; equal to `vary` up to rounding. Raises as `vary`."""
    generators = [edit_generator(seed) for seed in seeds]
    model = match_density(model, human)
    conditional_denoiser(model, attributes, guidance)  # what it refuses is an error for any amount
    chain = edit_timesteps(model, amount, steps)
    payloads, missed = [human.payload.to("cpu")] * len(seeds), [{}] * len(seeds)
    if chain:
        x0 = encode_human(model, human)
        denoise = conditional_denoiser(model, kept_attributes(model, human, x0, attributes), guidance)
        residual = difference(payloads[0], decode_latents(model, x0))
        clean = x0.expand(len(seeds), *x0.shape[1:])
        level = torch.full((len(seeds),), chain[0], device=x0.device)
        x = model.schedule.q_sample(clean, level, gaussian_noise(clean, generators))
        varied = run_sampler(ddim(denoise, model.schedule, x, chain, generators), on_step)
        signal = model.schedule.signal(chain[0])
        payloads = [add_residual(decode_latents(model, one[None]), residual, signal) for one in varied]
        missed = [{"unfollowed": names} if names else {} for names in unfollowed(model, varied, attributes)]
    edit = {"edit": "vary", "amount": amount}
    shared = {"steps": steps, "attributes": dict(attributes), "guidance": guidance, **model_provenance(model)}
    return [
        with_edit(human, {**edit, "seed": seed, **shared, **names}, payload)
        for seed, payload, names in zip(seeds, payloads, missed, strict=True)
    ]
