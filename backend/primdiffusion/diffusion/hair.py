"""Hair has one colour: that of a person's hair, wherever people with the same style have hair.

Person components are directions that all people have in common. Where hair hangs over clothes they give it the colour
of the shirt, and they put bands of several colours on heads. But a style is one mesh with one texture: a voxel of it
has nearly the same tone of the person's colour of hair on everybody (`training.hair_styles`).
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import VOXEL_VALUES
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import S

SURELY = 0.75
"""Share of hair above which a voxel of the head counts for the colour of the hair."""

BRIGHTEST = 2.0
"""Largest tone of hair."""


@dataclasses.dataclass(frozen=True)
class HairStyles(TensorRecord):
    """Where L styles have hair, in C boxes, and its colour."""

    condition: Float[Tensor, "l x"]
    """What tells people with each style: 1 at their hair and at having no hat (`AttributeVocabulary.encode`)."""
    cells: Int[Tensor, "c"]
    """The boxes."""
    head: Bool[Tensor, "c"]
    """Whether they are of the head, where the colour of a person's hair is read."""
    share: Float[Tensor, "l c 512"]
    """How much of a voxel's colour is that of hair, 0 ... 1."""
    tone: Float[Tensor, "l c 512"]
    """A voxel's sRGB-encoded colour as a multiple of the colour of the person's hair."""

    def of_people(self, condition: Float[Tensor, "b x"]) -> Int[Tensor, "b"]:
        """The style of people with these attributes; -1 for those with another style, or a hat."""
        missing, style = (self.condition.sum(1) - condition @ self.condition.T).min(1)
        return torch.where(missing < 0.5, style, -1)

    def recolour(self, cells: Float[Tensor, "b k v"], style: Int[Tensor, "b"]) -> Float[Tensor, "b k v"]:
        """Decoded cells (`LinearCodec.decode`) whose hair has one colour; people of style -1 stay as they are."""
        recoloured = cells.clone()
        for person in (style >= 0).nonzero()[:, 0].tolist():
            share, tone = self.share[style[person]], self.tone[style[person]]
            voxels = voxels_of(cells[person, self.cells])
            of_hair = mean_colour(voxels[None, self.head], (share[self.head] - SURELY).clamp_min(0))[0]
            rgb = torch.lerp(voxels[..., :3], tone[..., None] * of_hair, share[..., None])
            recoloured[person, self.cells, : 3 * S**3] = rgb.mT.flatten(1)
        return recoloured


def voxels_of(cells: Float[Tensor, "*b v"]) -> Float[Tensor, "*b 512 4"]:
    """Encoded colour and density of the voxels of cells."""
    return cells[..., :VOXEL_VALUES].unflatten(-1, (4, S**3)).mT


def mean_colour(voxels: Float[Tensor, "b c 512 4"], weight: Float[Tensor, "c 512"]) -> Float[Tensor, "b 3"]:
    """Mean colour of each person's voxels, which count by weight and density."""
    counts = weight * voxels[..., 3].clamp_min(0)
    total = (voxels[..., :3] * counts[..., None]).sum((1, 2))
    return total / counts.sum((1, 2)).clamp_min(1e-6)[:, None]
