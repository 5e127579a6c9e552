"""Surfaces of one colour: hair, hats, plain garments and skin; and prints in two.

Person components are directions that all people have in common, so colours of one surface come to others: hair on a
back has the colour of the shirt, plain shirts have a shade of prints, arms are darker than the face. But a style of
hair, or a garment, is one mesh with one texture: a voxel of it has nearly the same tone of the surface's colour on
everybody (`training.surfaces`).

Person components also mix prints: a shirt between stripes and checks is neither. But a print is at the same place of a
garment on everybody who has it, in two colours (`training.prints`).

Colours of people are few and strong: blue jeans, white shirts, black hair. Draws of a Gaussian are what lies between
them: grey, violet, olive. So what is generated gets the colours that people have (`peoples_colours`).

Dark faces would be blotched: what faces differ by is as large as their skin is bright, and in a Gaussian it is as large
on all. And skirts would be torn: between the legs each person's cloth is at a place of its own, of which boxes show a
part. But the boxes that are sized for a skirt (`primitives.skirts`) are nearly as dense on everybody who has it.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import SCALE_VALUE, VOXEL_VALUES, window_weight
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import K, S
from primdiffusion.primitives.skirts import inside_legs

SURELY = 0.75
"""Share of a surface above which a voxel counts for the surface's colour."""
BRIGHTEST = 2.0
"""Largest tone."""
LARGEST = {"share": 1.0, "tone": BRIGHTEST, "second": 1.0, "features": 1.0, "by_skin": BRIGHTEST, "dense": 1.0}
"""Fields with a value for each voxel, which are stored in bytes, and their largest values."""
LARGEST_SIZE = 4.0
NUMBERS = ("surface", "cell", "garment", "printed", "box", "face", "skirt", "between", "paired")
"""Fields of whole numbers."""
BLACK = 0.1
"""sRGB-encoded colour of what is black: folds would not show in less."""
DIMMEST = 0.3
"""Darker voxels say little of a garment's colours."""
EVEN, MOST_BOXES = 0.04, 0.75
"""Difference from the garment's colour that so many of its boxes stay below, on plain people."""
EXPLAINED = 0.5
"""Share of the variance of a garment's colours that its prints explain together, or it has another one."""
NEAR = 0.03
"""Distance between colours, of 0 ... 1 each, over which those of people that they become are mixed."""
OPAQUE = 5.0
"""Optical depth of a layer of full voxels: about 1.3 in each of the four boxes that overlap."""


@dataclasses.dataclass(frozen=True)
class Surfaces(TensorRecord):
    """L surfaces in N boxes, of which later ones cover earlier ones, Q prints on M of these boxes, F boxes of the face
    and G of skirts."""

    condition: Float[Tensor, "l x"]
    """Attributes of all people who have the surface: 1 at their values (`AttributeVocabulary.encode`)."""
    natural: Bool[Tensor, "l"]
    """Hair and skin, in which there is no more green than red, and no more blue than green."""
    surface: Int[Tensor, "n"]
    """The surface that the box shows."""
    cell: Int[Tensor, "n"]
    """The box."""
    share: Float[Tensor, "n 512"]
    """Share of the surface in a voxel's colour, 0 ... 1, where no later one covers it."""
    tone: Float[Tensor, "n 512"]
    """The voxel's sRGB-encoded colour as a multiple of the surface's."""
    read: Bool[Tensor, "n"]
    """Whether the surface's colour is read here."""
    drawn: Bool[Tensor, "n"]
    """Whether it is drawn here; faces keep their own colours, and patterned garments, except in a print."""
    garment: Int[Tensor, "q"]
    """The surface that the print is on; its other boxes have the first colour."""
    printed: Int[Tensor, "m"]
    """The print that the box shows."""
    box: Int[Tensor, "m"]
    """The box's place among the N."""
    second: Float[Tensor, "m 512"]
    """Share of the second colour in a voxel, 0 ... 1."""
    face: Int[Tensor, "f"]
    """The box."""
    features: Float[Tensor, "f 512 3"]
    """Mean colour of the voxel."""
    by_skin: Float[Tensor, "f 512"]
    """Ratio of the voxel's change of colour to that of the skin: small where eyes are white and lips are red."""
    skin: Float[Tensor, "2 3"]
    """Mean skin, and the darkest."""
    skirt: Int[Tensor, "g"]
    """The surface of the people who have the skirt."""
    between: Int[Tensor, "g"]
    """The box between their legs."""
    dense: Float[Tensor, "g 512"]
    """Density of that box, as stored in cells."""
    size: Float[Tensor, "g 3"]
    """Size of that box, as `delta_scale`."""
    paired: Int[Tensor, "t"]
    """The surface of a pair of colours."""
    sampled: Float[Tensor, "t 3"]
    """Its colour on a draw of the prior."""
    worn: Float[Tensor, "t 3"]
    """Its colour on the person whom the optimal transport of draws to people gives to that draw."""

    def draw(self, cells: Float[Tensor, "b k v"], kind: Float[Tensor, "b x"]) -> Float[Tensor, "b k v"]:
        """Decoded cells (`LinearCodec.decode`) of people of these kinds, with each of their surfaces in one colour, or
        in the two of a print, faces as even as their skin is dark, and whole skirts."""
        drawn_cells = cells.clone()
        for person, its in enumerate(_fitting(kind, self.condition)):
            surfaces = its.nonzero()[:, 0].tolist()
            colours, covered = self._colours(cells[person], surfaces)
            colours = {surface: self._as_drawn(surface, colour) for surface, colour in colours.items()}
            for surface in surfaces:
                if self._skin()[surface]:
                    face = self._face(cells[person], colours[surface])
                    drawn_cells[person, self.face, : 3 * S**3] = face.mT.flatten(1)
                own = (self.surface == surface).nonzero()[:, 0]
                drawn = self._printed(cells[person], own, (self.garment == surface).nonzero()[:, 0], 1 - covered)
                if drawn is None:
                    own = own[self.drawn[own]]
                    drawn = self.tone[own][..., None] * colours[surface].clamp_min(BLACK)
                rgb = voxels_of(drawn_cells[person, self.cell[own]])[..., :3]
                rgb = torch.lerp(rgb, drawn, self.share[own][..., None])
                drawn_cells[person, self.cell[own], : 3 * S**3] = rgb.mT.flatten(1)
            own = its[self.skirt]
            if surfaces:
                drawn_cells[person] = _without_other_leg(drawn_cells[person], self.between[own])
            shape = torch.cat([self.dense[own], self.size[own] * SCALE_VALUE], dim=1)
            drawn_cells[person, self.between[own], 3 * S**3 :] = shape
        return drawn_cells

    def colours(self, cells: Float[Tensor, "k v"], kind: Float[Tensor, "a"]) -> dict[int, Float[Tensor, "3"]]:
        """The colour of each surface of a person of this kind, as the cells have it."""
        return self._colours(cells, _fitting(kind[None], self.condition)[0].nonzero()[:, 0].tolist())[0]

    def natural_colours(self, cells: Float[Tensor, "k v"], kind: Float[Tensor, "a"]) -> Float[Tensor, "2 q 3"]:
        """Colours of the hair and the skin of a person of this kind: as the cells have them, and as they are drawn."""
        colours = self.colours(cells, kind).items()
        pairs = [(colour, self._as_drawn(one, colour)) for one, colour in colours if self.natural[one]]
        return torch.stack([torch.stack(pair) for pair in pairs], dim=1) if pairs else cells.new_zeros(2, 0, 3)

    def peoples_colours(self, cells: Float[Tensor, "k v"], kind: Float[Tensor, "a"]) -> Float[Tensor, "2 q 3"]:
        """Colours of the surfaces of a person of this kind: as the cells, a draw of the prior, have them, and as people
        do."""
        pairs = []
        for surface, colour in self.colours(cells, kind).items():
            own = self.paired == surface
            if own.any():
                distance = (self.sampled[own] - colour.detach()).square().sum(1)
                weight = (-distance / (2 * NEAR**2)).softmax(0)
                pairs.append(torch.stack([colour, weight @ self.worn[own]]))
        return torch.stack(pairs, dim=1) if pairs else cells.new_zeros(2, 0, 3)

    def hair(self, kind: Float[Tensor, "a"]) -> Float[Tensor, "k 512"]:
        """Share of hair in each voxel of people of this kind."""
        own = (_fitting(kind[None], self.condition)[0] & self.natural & ~self._skin())[self.surface]
        hair = self.share.new_zeros(K, S**3)
        hair[self.cell[own]] = self.share[own]
        return hair

    def _skin(self) -> Bool[Tensor, "l"]:
        """Which surfaces are skin, which, unlike hair, is not drawn on all its boxes."""
        partly = torch.zeros_like(self.natural).index_fill(0, self.surface[self.read & ~self.drawn], True)
        return self.natural & partly

    def _colours(
        self, cells: Float[Tensor, "k v"], surfaces: list[int]
    ) -> tuple[dict[int, Float[Tensor, "3"]], Float[Tensor, "k 512"]]:
        """The colours that the cells have of these surfaces, from the uppermost on, and what they cover together."""
        covered = torch.zeros_like(cells[:, : S**3])
        colours = {}
        for surface in reversed(surfaces):
            own = self.surface == surface
            colours[surface] = self._colours_of_boxes(cells, own & self.read, 1 - covered).median(0).values
            own &= self.drawn
            covered[self.cell[own]] = torch.maximum(covered[self.cell[own]], self.share[own])
        return colours, covered

    def _as_drawn(self, surface: int, colour: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
        """The colour that is drawn for that of the cells."""
        if self.natural[surface]:
            colour = colour.cummin(0).values
            if self._skin()[surface]:
                return torch.maximum(colour, self.skin[1])
        return colour.clamp_min(BLACK)

    def _face(self, cells: Float[Tensor, "k v"], skin: Float[Tensor, "3"]) -> Float[Tensor, "f 512 3"]:
        """The face's colours: what it has of its own is smaller on skin darker than the mean."""
        common = self.features + self.by_skin[..., None] * (skin - self.skin[0])
        own = voxels_of(cells[self.face])[..., :3] - common
        return common + (skin / self.skin[0]).clamp_max(1) * own

    def _printed(
        self,
        cells: Float[Tensor, "k v"],
        boxes: Int[Tensor, "r"],
        prints: Int[Tensor, "q"],
        bare: Float[Tensor, "k 512"],
    ) -> Float[Tensor, "r 512 3"] | None:
        """A garment's colours in one of these prints, as strong as they are; None if prints do not explain them.

        A sample is a mixture of prints: it gets the one whose two colours differ most.
        """
        if not len(prints):
            return None
        read = self.read[boxes]
        voxels, tone = voxels_of(cells[self.cell[boxes[read]]]), self.tone[boxes[read]]
        weight = (seen(voxels) * bare[self.cell[boxes[read]]] * (tone > DIMMEST)).flatten()
        weight = weight / weight.sum().clamp_min(1e-6)
        untoned = (voxels[..., :3] / tone.clamp_min(DIMMEST)[..., None]).flatten(0, 1)
        mean = weight @ untoned
        variance = weight @ (untoned - mean).square().sum(1)
        second = torch.stack([self._second(number)[boxes] for number in prints.tolist()])
        centred = second[:, read].flatten(1)
        average = centred @ weight
        centred = centred - average[:, None]
        gram, by_colour = (centred * weight) @ centred.T, (centred * weight) @ untoned
        together = torch.linalg.solve(gram + 1e-4 * torch.eye(len(gram)).to(gram), by_colour)
        if (together * by_colour).sum() <= EXPLAINED * variance:
            return None
        best = together.square().sum(1).argmax()
        slope = by_colour[best] / gram[best, best].clamp_min(1e-6)
        strength = (variance / (gram[best, best] * slope.square().sum()).clamp_min(1e-6)).sqrt()
        colours = mean + strength * (second[best] - average[best])[..., None] * slope
        return (self.tone[boxes][..., None] * colours.clamp_min(BLACK)).clamp_max(1)

    def _second(self, number: int) -> Float[Tensor, "n 512"]:
        """Share of a print's second colour in all voxels."""
        own, second = self.printed == number, torch.zeros_like(self.tone)
        second[self.box[own]] = self.second[own]
        return second

    def even(self, cells: Float[Tensor, "k v"], kind: Float[Tensor, "a"], plain: Float[Tensor, "a"]) -> bool:
        """Whether the garments that are `plain` on a person of this kind have one colour each; False without any."""
        garments = _fitting(kind[None], self.condition)[0] & (self.condition @ plain > 0.5)
        whole = garments[self.surface] & self.read & self.drawn
        bare = torch.ones_like(cells[:, : S**3])
        boxes = [
            self._colours_of_boxes(cells, whole & (self.surface == garment), bare)
            for garment in self.surface[whole].unique().tolist()
        ]
        differences = [(each - each.median(0).values).abs().mean(1) for each in boxes]
        return bool(boxes) and all(float(each.quantile(MOST_BOXES)) < EVEN for each in differences)

    def _colours_of_boxes(
        self, cells: Float[Tensor, "k v"], rows: Bool[Tensor, "n"], bare: Float[Tensor, "k 512"]
    ) -> Float[Tensor, "r 3"]:
        """The surface's colour by each of its boxes that are mostly bare; the mean of all if there are none. Gradients
        are of colours alone."""
        voxels = voxels_of(cells[self.cell[rows]])
        whole = (self.share[rows] - SURELY).clamp_min(0) * seen(voxels.detach())
        weight = whole * bare[self.cell[rows]]
        tone = (self.tone[rows] * weight).sum(1, keepdim=True)
        of_boxes = (voxels[..., :3] * weight[..., None]).sum(1) / tone.clamp_min(1e-6)
        sure = weight.sum(1) > whole.sum(1) / 2
        return of_boxes[sure] if sure.any() else of_boxes.mean(0, keepdim=True)


def optional_fields() -> dict[str, Tensor]:
    """Fields of surfaces without faces, skirts and pairs of colours, as in earlier checkpoints."""
    none = torch.zeros(0, dtype=torch.int64)
    voxels = torch.zeros(0, S**3)
    return {
        "face": none,
        "features": voxels[..., None].expand(0, S**3, 3),
        "by_skin": voxels,
        "skin": torch.tensor([[1.0] * 3, [0.0] * 3]),
        "skirt": none,
        "between": none,
        "dense": voxels,
        "size": voxels[:, :3],
        "paired": none,
        "sampled": voxels[:, :3],
        "worn": voxels[:, :3],
    }


def _without_other_leg(cells: Float[Tensor, "k v"], skirt: Int[Tensor, "g"]) -> Float[Tensor, "k v"]:
    """Cells on the insides of the legs end at a gap, but for those of a skirt: beyond is the other leg, which its own
    boxes show. On legs that are further apart it would float between them."""
    bare = inside_legs().to(cells.device).index_fill(0, skirt, False)
    layers = cells[bare, 3 * S**3 : VOXEL_VALUES].unflatten(1, (S, S**2))
    cells = cells.clone()
    cells[bare, 3 * S**3 : VOXEL_VALUES] = layers.cummin(1).values.flatten(1)
    return cells


def _fitting(kind: Float[Tensor, "b x"], condition: Float[Tensor, "n x"]) -> Bool[Tensor, "b n"]:
    """Tell which conditions are true of people of these kinds."""
    return condition.sum(1) - kind @ condition.T < 0.5


def voxels_of(cells: Float[Tensor, "*b v"]) -> Float[Tensor, "*b 512 4"]:
    """Encoded colour and density of the voxels of cells."""
    return cells[..., :VOXEL_VALUES].unflatten(-1, (4, S**3)).mT


def seen(voxels: Float[Tensor, "*b 512 4"]) -> Float[Tensor, "*b 512"]:
    """Weight of each voxel in the colour of its box: its density, as the marcher's window shows it, as far as denser
    layers do not hide it from outside. Fits leave other colours below a surface."""
    layers = density_weight(voxels).unflatten(-1, (S, S, S))  # from the body outwards
    above = layers.flip(-3).cumsum(-3).flip(-3) - layers
    return (layers * torch.exp(-OPAQUE * above)).flatten(-3)


def density_weight(voxels: Float[Tensor, "*b 512 4"]) -> Float[Tensor, "*b 512"]:
    """Density of each voxel as the marcher's window shows it."""
    return voxels[..., 3].clamp(0, 1) * window_weight()[: S**3].to(voxels.device).square()
