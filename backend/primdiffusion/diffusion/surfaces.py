"""Surfaces of one colour: hair, hats, plain garments and skin.

Person components are directions that all people have in common, so colours of one surface come to others: hair on a
back has the colour of the shirt, plain shirts have a shade of prints, arms are darker than the face. But a style of
hair, or a garment, is one mesh with one texture: a voxel of it has nearly the same tone of the surface's colour on
everybody (`training.surfaces`).
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import VOXEL_VALUES, window_weight
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import S

SURELY = 0.75
"""Share of a surface above which a voxel counts for the surface's colour."""
BRIGHTEST = 2.0
"""Largest tone."""


@dataclasses.dataclass(frozen=True)
class Surfaces(TensorRecord):
    """L surfaces in N boxes. Later ones cover earlier ones."""

    condition: Float[Tensor, "l x"]
    """What all people who have the surface are like: 1 at their values (`AttributeVocabulary.encode`)."""
    surface: Int[Tensor, "n"]
    """The surface that the box shows."""
    cell: Int[Tensor, "n"]
    """The box."""
    share: Float[Tensor, "n 512"]
    """How much of a voxel's colour is that of the surface, 0 ... 1, where no later one covers it."""
    tone: Float[Tensor, "n 512"]
    """The voxel's sRGB-encoded colour as a multiple of the surface's."""
    read: Bool[Tensor, "n"]
    """Whether the surface's colour is read here."""
    drawn: Bool[Tensor, "n"]
    """Whether it is drawn here; faces keep their own colours."""

    def recolour(self, cells: Float[Tensor, "b k v"], kind: Float[Tensor, "b x"]) -> Float[Tensor, "b k v"]:
        """Decoded cells (`LinearCodec.decode`) of people of these kinds, with each of their surfaces in one colour."""
        recoloured = cells.clone()
        missing = self.condition.sum(1) - kind @ self.condition.T
        for person, its in enumerate(missing < 0.5):
            surfaces = its.nonzero()[:, 0].tolist()
            covered = cells.new_zeros(cells.shape[1], S**3)
            colours = {}
            for surface in reversed(surfaces):
                own = self.surface == surface
                colours[surface] = self._colour(cells[person], own & self.read, 1 - covered)
                own &= self.drawn
                covered[self.cell[own]] = torch.maximum(covered[self.cell[own]], self.share[own])
            for surface in surfaces:
                own = (self.surface == surface) & self.drawn
                rgb = voxels_of(recoloured[person, self.cell[own]])[..., :3]
                rgb = torch.lerp(rgb, self.tone[own][..., None] * colours[surface], self.share[own][..., None])
                recoloured[person, self.cell[own], : 3 * S**3] = rgb.mT.flatten(1)
        return recoloured

    def _colour(
        self, cells: Float[Tensor, "k v"], rows: Bool[Tensor, "n"], bare: Float[Tensor, "k 512"]
    ) -> Float[Tensor, "3"]:
        """The median colour of a person's boxes, of voxels that no later surface covers."""
        voxels = voxels_of(cells[self.cell[rows]])
        whole = (self.share[rows] - SURELY).clamp_min(0) * seen(voxels)
        weight = whole * bare[self.cell[rows]]
        tone = (self.tone[rows] * weight).sum(1, keepdim=True)
        of_boxes = (voxels[..., :3] * weight[..., None]).sum(1) / tone.clamp_min(1e-6)
        sure = weight.sum(1) > whole.sum(1) / 2
        return of_boxes[sure].median(0).values if sure.any() else of_boxes.mean(0)


def voxels_of(cells: Float[Tensor, "*b v"]) -> Float[Tensor, "*b 512 4"]:
    """Encoded colour and density of the voxels of cells."""
    return cells[..., :VOXEL_VALUES].unflatten(-1, (4, S**3)).mT


def seen(voxels: Float[Tensor, "*b 512 4"]) -> Float[Tensor, "*b 512"]:
    """How much each voxel counts for the colour of its box: as dense as it is, and as the marcher's window shows it."""
    return voxels[..., 3].clamp(0, 1) * window_weight()[: S**3].to(voxels.device).square()
