"""Colours of people for those of draws of the prior.

A Gaussian has the mean and the covariance of people's colours, but these lie in clusters: jeans are blue, shirts white,
hair black or brown. The optimal transport from draws to people says which draw becomes which person's colour, so that
what is generated has colours as often as people have them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.surfaces import Surfaces
from primdiffusion.training.latents import LatentSet

DRAWS = 96
"""Draws of each surface's colour, and as many colours of people."""
FEWEST_COLOURS = 16
"""Colours of people with a surface that say how often it has which."""


def with_colour_pairs(
    surfaces: Surfaces, people: LatentSet, codec: LinearCodec, prior: PersonPrior, generator: torch.Generator
) -> Surfaces:
    """Surfaces with the colours that people, those learned from in detail, have of them, paired with draws of `prior`.

    A surface that few of them have keeps the colours that it has.
    """
    count = int(people.detailed)
    of_people = _by_surface(
        surfaces.colours(codec.decode(latents[None].float())[0], kind)
        for latents, kind in zip(people.latents[:count], people.condition[:count], strict=True)
    )
    of_draws: dict[int, list[Tensor]] = {}
    pairs = []
    for surface, colours in sorted(of_people.items()):
        if len(colours) < FEWEST_COLOURS:
            continue
        missing = DRAWS - len(of_draws.get(surface, ()))
        made = (_draw(surfaces, surface, codec, prior, generator) for _ in range(missing))
        for other, more in _by_surface(made).items():
            of_draws.setdefault(other, []).extend(more)
        if surface not in of_draws:  # no kind of the prior has it
            continue
        drawn, worn = torch.stack(of_draws[surface][:DRAWS]), torch.stack(colours)
        worn = worn[torch.randperm(len(worn), generator=generator)][torch.arange(len(drawn)) % len(worn)]
        rows, columns = linear_sum_assignment(torch.cdist(drawn.double(), worn.double()).square().numpy())
        pairs.append((torch.full((len(rows),), surface), drawn[rows], worn[columns]))
    if not pairs:
        return surfaces
    kept = ~torch.isin(surfaces.paired, torch.cat([surface for surface, *_ in pairs]))
    pairs.append((surfaces.paired[kept], surfaces.sampled[kept], surfaces.worn[kept]))
    paired, sampled, worn = (torch.cat(each) for each in zip(*pairs, strict=True))
    return dataclasses.replace(surfaces, paired=paired, sampled=sampled, worn=worn)


def _draw(
    surfaces: Surfaces, surface: int, codec: LinearCodec, prior: PersonPrior, generator: torch.Generator
) -> dict[int, Float[Tensor, "3"]]:
    """Colours of the surfaces of a draw of people who have this one."""
    kind = prior.sample_kinds(1, generator, surfaces.condition[surface : surface + 1])
    return surfaces.colours(codec.decode(prior.sample(1, generator, kind))[0], kind[0])


def _by_surface(people: Iterable[Mapping[int, Float[Tensor, "3"]]]) -> dict[int, list[Float[Tensor, "3"]]]:
    """The colours of each surface on those who have it."""
    found: dict[int, list[Float[Tensor, "3"]]] = {}
    for colours in people:
        for surface, colour in colours.items():
            found.setdefault(surface, []).append(colour)
    return found
