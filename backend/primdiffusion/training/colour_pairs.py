"""Colours of people for those of draws of the prior.

A Gaussian has the mean and the covariance of people's colours, but these lie in clusters: jeans are blue, shirts white,
hair black or brown. The optimal transport from draws to people says which draw becomes which person's colour, so that
what is generated has colours as often as people have them.
"""

from __future__ import annotations

import dataclasses

import torch
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
    count, with_attributes = int(people.detailed), prior.kind.shape[-1] == surfaces.condition.shape[1]
    of_people: dict[int, list[Tensor]] = {}
    for latents, kind in zip(people.latents[:count], people.condition[:count], strict=True):
        for surface, colour in surfaces.colours(codec.decode(latents[None].float())[0], kind).items():
            of_people.setdefault(surface, []).append(colour)
    pairs = []
    for surface, colours in sorted(of_people.items()):
        if len(colours) >= FEWEST_COLOURS and with_attributes:
            drawn = _drawn(surfaces, surface, codec, prior, generator)
            worn = torch.stack(colours)[torch.randperm(len(colours), generator=generator)]
            worn = worn[torch.arange(len(drawn)) % len(worn)]
            rows, columns = linear_sum_assignment(torch.cdist(drawn.double(), worn.double()).square().numpy())
            pairs.append((torch.full((len(rows),), surface), drawn[rows], worn[columns]))
    if not pairs:
        return surfaces
    kept = ~torch.isin(surfaces.paired, torch.cat([surface for surface, *_ in pairs]))
    pairs.append((surfaces.paired[kept], surfaces.sampled[kept], surfaces.worn[kept]))
    paired, sampled, worn = (torch.cat(each) for each in zip(*pairs, strict=True))
    return dataclasses.replace(surfaces, paired=paired, sampled=sampled, worn=worn)


def _drawn(
    surfaces: Surfaces, surface: int, codec: LinearCodec, prior: PersonPrior, generator: torch.Generator
) -> Tensor:
    """Colours of the surface on draws of people who have it [n, 3]."""
    colours = []
    for _ in range(DRAWS):
        kind = prior.sample_kinds(1, generator, surfaces.condition[surface : surface + 1])
        cells = codec.decode(prior.sample(1, generator, kind))
        found = surfaces.colours(cells[0], kind[0])
        if surface in found:
            colours.append(found[surface])
    return torch.stack(colours) if colours else torch.zeros(0, 3)
