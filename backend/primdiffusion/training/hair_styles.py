"""Find where styles of hair have hair: in voxels whose colours follow that of the person's hair.

A regression for each style, of every voxel on the colour of the hair and on that of the hands: dark hair often goes
with dark skin. The hair's colour is first that of the region of hair, then that of the voxels found.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.hair import BRIGHTEST, SURELY, HairStyles, mean_colour, voxels_of
from primdiffusion.editing.regions import region_of
from primdiffusion.primitives.primitives import K, S
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import LatentSet

FEWEST_GEOMETRIES = 4
"""With fewer people of a style, chance looks like hair."""
NO_HAIR, ALL_HAIR = 0.4, 0.8
"""Slopes of a voxel's colour against that of hair of its tone, between which its share of hair rises from 0 to 1."""
DARKEST = 0.5
"""Tones below this count as this: chance is large beside a dark voxel's colour."""
FEWEST_VOXELS, SOLID = 8, 0.3
"""Voxels of hair, as dense as that, in a box; fewer are chance."""
PASSES = 2
"""Regressions, each on the colour of the voxels that the former found."""
CHUNK = 16
"""People whose voxels are in memory at once."""


def fit_hair_styles(
    people: LatentSet, codec: LinearCodec, vocabulary: AttributeVocabulary, config: PriorConfig
) -> HairStyles | None:
    """Styles of detailed people without hats; None if they have no attribute `config.hair`, or no style has enough."""
    head, below = region_of(("head",)), region_of(("torso", "hips", "arms"))
    condition, geometry = people.condition[: people.detailed], people.geometry[: people.detailed]
    hatless = {"hat": "none"} if "none" in vocabulary.categories.get("hat", ()) else {}
    rows, styles = [], []
    for name in vocabulary.categories.get(config.hair, ()):
        row = vocabulary.encode({config.hair: name, **hatless})
        own = (condition @ row >= row.sum()).nonzero()[:, 0]
        if len(geometry[own].unique()) >= FEWEST_GEOMETRIES:
            rows.append(row)
            styles.append(_style(people.latents[own], codec, head | below if name in config.hanging else head))
    if not styles:
        return None
    share, tone = (torch.stack(each) for each in zip(*styles, strict=True))
    cells = share.any(2).any(0).nonzero()[:, 0]
    return HairStyles(torch.stack(rows), cells, head[cells], share[:, cells], tone[:, cells])


def _style(
    latents: Float[Tensor, "n c 32 32"], codec: LinearCodec, region: Tensor
) -> tuple[Float[Tensor, "k 512"], Float[Tensor, "k 512"]]:
    """Share of hair and its tone in all voxels, which are 0 where there is none."""
    cells, head = region.nonzero()[:, 0], region_of(("head",))
    ones = torch.ones(K, S**3)
    skin, hair = (
        torch.cat([mean_colour(voxels[:, part], ones[part]) for voxels in _people(latents, codec)])
        for part in (region_of((name,)) for name in ("hands", "hair"))
    )
    share = ones
    for number in range(PASSES):
        if number:
            sure = (share[head] - SURELY).clamp_min(0)
            hair = torch.cat([mean_colour(voxels[:, head], sure) for voxels in _people(latents, codec)])
        design = torch.stack([hair - hair.mean(0), skin - skin.mean(0)], dim=-1)  # [n, 3, 2]
        by_design, by_hair, density = (torch.zeros(len(cells), S**3, *size) for size in ((2,), (), ()))
        for voxels, rows, own in zip(_people(latents, codec), design.split(CHUNK), hair.split(CHUNK), strict=True):
            by_design += torch.einsum("ncq,nkvc->kvq", rows, voxels[:, cells, :, :3])
            by_hair += torch.einsum("nc,nkvc->kv", own, voxels[:, cells, :, :3])
            density += voxels[:, cells, :, 3].sum(0) / len(latents)
        normal = torch.einsum("ncq,ncr->qr", design, design) + 1e-4 * torch.eye(2)
        slope = torch.linalg.solve(normal, by_design[..., None])[..., 0, 0]
        tone = (by_hair / hair.square().sum().clamp_min(1e-6)).clamp(0, BRIGHTEST)
        slope = _smooth(slope) / _smooth(tone).clamp(DARKEST, 1)  # dark strands follow with a part of the hair's colour
        share = ((slope - NO_HAIR) / (ALL_HAIR - NO_HAIR)).clamp(0, 1)
        found = ((share > 0.5) & (density > SOLID)).sum(1) >= FEWEST_VOXELS
        share = torch.zeros(K, S**3).index_copy(0, cells, share * found[:, None])
    return share, torch.zeros(K, S**3).index_copy(0, cells, tone) * (share > 0)


def _people(latents: Float[Tensor, "n c 32 32"], codec: LinearCodec) -> Iterator[Float[Tensor, "m 1024 512 4"]]:
    for chunk in latents.split(CHUNK):
        yield voxels_of(codec.decode(chunk.float()))


def _smooth(values: Float[Tensor, "c 512"]) -> Float[Tensor, "c 512"]:
    """Means over neighbouring voxels of each box: the slope of one voxel is noisy."""
    boxes = functional.pad(values.view(-1, 1, S, S, S), (1,) * 6, mode="replicate")
    return functional.avg_pool3d(boxes, 3, stride=1).view_as(values)
