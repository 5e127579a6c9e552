"""Neighbours of a person: some noise, and back (SDEdit, Meng et al. 2022)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.samplers import ddim, gaussian_noise
from primdiffusion.editing.edit import (
    OnStep,
    added,
    asked,
    chain_down,
    decoded,
    difference,
    edit_generator,
    encoded,
    fitted,
    last,
    with_edit,
)
from primdiffusion.formats import requests
from primdiffusion.human import Human, made_by


def vary(
    model: DiffusionModel,
    human: Human,
    amount: float = 0.5,
    seed: int = 0,
    steps: int = requests.STEPS,
    on_step: OnStep | None = None,
    attributes: Mapping[str, str | float] = MappingProxyType({}),
    guidance: float = requests.GUIDANCE,
) -> Human:
    """A variant of a person with the same body: noise of a level that grows with `amount`, then DDIM back.

    0 is the person themselves, exactly; 1 keeps nothing but what shows through the noise of step T-1. In between coarse
    things (which garments, which colours) stay longer than fine ones. Details that the model's codec leaves out are
    added again in proportion to the signal at that level, so small amounts change little. The betas are kept:
    the body, its armature and its poses stay. Deterministic for a model, person, seed and device.

    Raises ValueError for an amount outside 0 ... 1, steps outside 1 ... T, a seed outside 0 ... 2^63-1 and attributes
    that the model does not know.
    """
    return vary_batch(model, human, amount, [seed], steps, on_step, attributes, guidance)[0]


def vary_batch(
    model: DiffusionModel,
    human: Human,
    amount: float,
    seeds: Sequence[int],
    steps: int = requests.STEPS,
    on_step: OnStep | None = None,
    attributes: Mapping[str, str | float] = MappingProxyType({}),
    guidance: float = requests.GUIDANCE,
) -> list[Human]:
    """Variants of several seeds, who share the work; each as `vary` makes them, but for rounding. Errors likewise."""
    generators = [edit_generator(seed) for seed in seeds]
    model = fitted(model, human)
    denoise = asked(model, attributes, guidance)
    chain = chain_down(model.schedule, amount, steps)
    payloads = [human.payload.to("cpu")] * len(seeds)
    if chain:
        x0 = encoded(model, human)
        left_out = difference(payloads[0], decoded(model, x0))
        people = x0.expand(len(seeds), *x0.shape[1:])
        level = torch.full((len(seeds),), chain[0], device=x0.device)
        x = model.schedule.q_sample(people, level, gaussian_noise(people, generators))
        varied = last(ddim(denoise, model.schedule, x, chain, generators), on_step)
        signal = model.schedule.signal(chain[0])
        payloads = [added(decoded(model, one[None]), left_out, signal) for one in varied]
    edit = {"edit": "vary", "amount": amount}
    same = {"steps": steps, "attributes": dict(attributes), "guidance": guidance, **made_by(model)}
    return [
        with_edit(human, {**edit, "seed": seed, **same}, payload) for seed, payload in zip(seeds, payloads, strict=True)
    ]
