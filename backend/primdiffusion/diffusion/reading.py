"""Requested attributes that a sample does not show, as the person prior reads it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxtyping import Float
from torch import Tensor

from primdiffusion.diffusion.conditioning import Attributes
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import DiffusionModel

CERTAIN = 0.95
"""Smallest probability of a value that counts as shown."""


def unfollowed(model: DiffusionModel, x0: Float[Tensor, "b c h w"], attributes: Attributes) -> list[dict[str, str]]:
    """Return the categories that each clean sample does not show as asked: name -> the value that it shows instead.

    Empty for a model without a person prior. Height and weight are set on the body, so they are never among them.
    """
    categories, prior = model.vocabulary.categories, getattr(model.denoiser, "prior", None)
    asked = {name: attributes[name] for name in categories if name in attributes}
    if not asked or not isinstance(prior, PersonPrior) or not prior.kind.shape[-1]:
        return [{} for _ in x0]
    blocks = model.vocabulary.blocks()
    found = []
    shares = prior.kind_shares(prior.split(x0)[0]).flatten(1)
    for probability in (shares @ prior.kind.to(shares).flatten(0, 1)).cpu():
        shown = {name: probability[blocks[name]].max(0) for name in asked}
        values = {name: categories[name][int(best.indices)] for name, best in shown.items() if best.values > CERTAIN}
        found.append({name: value for name, value in values.items() if value != asked[name]})
    return found


def warnings_of(made: Mapping[str, Any]) -> list[str]:
    """Return a sentence on the attributes that a human does not show; none if it shows all.

    `made` is its provenance, or that of an edit: `unfollowed` beside the `attributes` that were asked for.
    """
    missed = made.get("unfollowed", {})
    if not missed:
        return []
    named = ", ".join(f"{name} {made['attributes'][name]!r} ({shown!r} instead)" for name, shown in missed.items())
    return [
        f"the human does not show {named}: few humans or none of the training set are all that was asked for; leave "
        "some attributes open, or try another seed"
    ]
