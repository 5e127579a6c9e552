"""Parts of a person made anew, or brought into agreement with the rest of them; nothing else changes by a bit."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from jaxtyping import Bool
from torch import Tensor

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.editing.edit import (
    OnStep,
    asked,
    chain_down,
    combined,
    decoded,
    edit_generator,
    encoded,
    fitted,
    last,
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
    """The person with the primitives of a region sampled anew so that they fit the others (`repaint`).

    The region starts as noise: nothing of what it was is kept. Outside it the payload, and the betas everywhere, are
    the person's own, bit for bit: those primitives are never decoded. `attributes` say what the region should become;
    without any it is whatever fits. Nearly 2 * `steps` calls of the denoiser, twice as many with attributes.
    Deterministic for a model, person, seed and device.

    Raises ValueError for a region that is empty, whole or no mask of K, steps outside 1 ... T, a seed outside
    0 ... 2^63-1 and attributes that the model does not know.
    """
    region = check_region(region)
    if region.all():
        raise ValueError("the region is the whole person: generate a new one, or vary this one")
    generator = edit_generator(seed)
    chain = model.chain(model.schedule.length, steps)
    model = fitted(model, human)
    denoise = asked(model, attributes, guidance)
    known, inside = encoded(model, human), model.cell_mask(region)
    start = model.start([generator], chain[0], model.condition(attributes))
    x0 = last(repaint(denoise, model.schedule, start, known, inside, chain, generator), on_step)
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
    """The person with a region, pasted there perhaps, brought into agreement with the rest by a little noise and back.

    As `inpaint`, but the region starts from what it is, with noise of a level that grows with `amount`: 0 is the
    person themselves, exactly; at 1 the region is made anew. Outside it nothing changes by a bit. The region may be all
    of the person; then it is a variant without the details that the codec leaves out. Raises ValueError as `inpaint`
    does, and for an amount outside 0 ... 1.
    """
    region = check_region(region)
    generator = edit_generator(seed)
    model = fitted(model, human)
    chain = chain_down(model.schedule, amount, steps)
    payload = human.payload
    if chain:
        known, inside = encoded(model, human), model.cell_mask(region)
        start = noised(model.schedule, known, chain[0], generator)
        x0 = last(repaint(model.denoise, model.schedule, start, known, inside, chain, generator), on_step)
        payload = combined(region, decoded(model, x0), human.payload)
    edit = {
        "edit": "harmonise",
        "region": name_region(region, human.body_setup),
        "amount": amount,
        "seed": seed,
        "steps": steps,
    }
    return with_edit(human, {**edit, **made_by(model)}, payload)
