"""Resample a region of a human, or harmonise it with the rest; the other primitives stay bit-identical."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from jaxtyping import Bool
from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.editing.edit import (
    OnStep,
    combined,
    conditional_denoiser,
    decoded,
    edit_generator,
    edit_timesteps,
    encoded,
    match_density,
    run_sampler,
    with_edit,
)
from primdiffusion.editing.regions import check_region, name_region
from primdiffusion.editing.repaint import noised, repaint
from primdiffusion.formats import requests
from primdiffusion.human import Human, made_by


def inpaint(
    model: DiffusionModel,
    human: Human,
    region: Bool[Tensor, "k"],
    seed: int = 0,
    steps: int = requests.STEPS,
    attributes: Mapping[str, str | float] = MappingProxyType({}),
    guidance: float = requests.GUIDANCE,
    on_step: OnStep | None = None,
) -> Human:
    """Return the human with the primitives of a region resampled to fit the others (`repaint`).

    The region starts from pure noise. Betas, and the payload outside the region, stay bit-identical: those primitives
    are never decoded. `attributes` condition the region; without any the result is unconditional. Costs nearly
    2 * `steps` denoiser calls, twice as many with attributes. Deterministic for a model, human, seed and device.

    Raises ValueError for a region that is empty, whole or not a mask of K, steps outside 1 ... T, a seed outside
    0 ... 2^63-1 and unknown attributes.
    """
    region = check_region(region)
    if region.all():
        raise ValueError("the region is the whole person: generate or vary instead of inpainting")
    generator = edit_generator(seed)
    chain = model.chain(model.schedule.length, steps)
    model = match_density(model, human)
    denoise = conditional_denoiser(model, attributes, guidance)
    known, inside = encoded(model, human), model.cell_mask(region)
    start = model.start([generator], chain[0], model.condition(attributes))
    x0 = run_sampler(repaint(denoise, model.schedule, start, known, inside, chain, generator), on_step)
    edit = {"edit": "inpaint", "region": name_region(region, human.body_setup), "seed": seed, "steps": steps}
    edit = {**edit, "attributes": dict(attributes), "guidance": guidance, **made_by(model)}
    return with_edit(human, edit, combined(region, decoded(model, x0), human.payload))


def harmonise(
    model: DiffusionModel,
    human: Human,
    region: Bool[Tensor, "k"],
    amount: float = 0.3,
    seed: int = 0,
    steps: int = requests.STEPS,
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
    chain = edit_timesteps(model.schedule, amount, steps)
    payload = human.payload
    if chain:
        known, inside = encoded(model, human), model.cell_mask(region)
        start = noised(model.schedule, known, chain[0], generator)
        x0 = run_sampler(repaint(model.denoise, model.schedule, start, known, inside, chain, generator), on_step)
        payload = combined(region, decoded(model, x0), human.payload)
    edit = {
        "edit": "harmonise",
        "region": name_region(region, human.body_setup),
        "amount": amount,
        "seed": seed,
        "steps": steps,
    }
    return with_edit(human, {**edit, **made_by(model)}, payload)
