"""Find surfaces of one colour: boxes and voxels whose colours follow that of a surface on all people who have it.

Hair, hats, garments and skin are found by regressions on the colour of the surface, first that of a few boxes, then
that of what was found, and on colours that it may go with: dark hair often goes with dark skin. Hair, hats and shoes
are found in voxels, as they lie over skin and clothes; plain garments and skin in boxes, which they cover from border
to border, and in voxels where they meet.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.surfaces import (
    BRIGHTEST,
    DIMMEST,
    SURELY,
    Surfaces,
    density_weight,
    optional_fields,
    seen,
    voxels_of,
)
from primdiffusion.editing.regions import region_of
from primdiffusion.primitives.primitives import K, S
from primdiffusion.primitives.skirts import box_sizes, voxel_heights
from primdiffusion.training.box_colours import (
    CHUNK,
    DARKEST,
    PASSES,
    UNEVEN,
    Meeting,
    covered_by,
    largest_part,
    mean_colour,
    normal_equations,
    smooth,
    spread,
    surrounded,
    tones_of,
    unexplained_share,
)
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import LatentSet
from primdiffusion.training.prints import FEWEST_GEOMETRIES, Print, find_prints

NO_HAIR, ALL_HAIR = 0.4, 0.8
"""Slopes of a voxel's colour on the hair's, as shares of its tone: below it is not hair, above all of it is."""
FEWEST_VOXELS, SOLID = 8, 0.3
"""Voxels of hair, as dense as that, in a box; fewer are chance."""
BALD = 0.3
"""Share of the variance of hair that is not the skin's; with less the head is bald."""
UNEVEN_GARMENT = 0.0136
"""Largest unevenness of a plain garment; more are prints and fades, which plain garments may have too."""
SMALL, UNEVEN_SMALL = 80, 0.03
"""Boxes of a garment without fades, of which others leave little, and the same of it: a shirt below a jacket."""
UNEVEN_BORDER = 0.12
"""Largest rms difference of voxels where surfaces meet, in boxes that are wholly explained by them."""
WHOLE = 0.93
"""Least share of one surface in a box that it covers from border to border: a little of another one is a hem."""
UNEXPLAINED = 0.5
"""Largest share of their variance that the surfaces leave."""
MOST_READ = 48
"""Boxes, those most alike, that tell the colour of a garment that is not drawn in one: jeans with fades."""
LEAST_SHARE = 0.02
"""Least share of a surface in what is seen of a box: less is chance."""
NO_CLOTH, ALL_CLOTH = 0.1, 0.43
"""Shares of a garment between the legs, below which there is none, and above which it hides all else."""
DENSE = 0.9
"""Quantile of people whose cloth between the legs is less dense."""
BELOW_HEM, LONGER = 0.02, 0.3
"""Share of a skirt's voxels between the legs that are below its hem by chance, and of skirts that are longer."""


class _Rows(NamedTuple):
    """Boxes of one surface, as fields of `Surfaces`."""

    cell: Int[Tensor, "n"]
    share: Float[Tensor, "n 512"]
    tone: Float[Tensor, "n 512"]
    read: Bool[Tensor, "n"]
    drawn: Bool[Tensor, "n"]


class _Surface(NamedTuple):
    """A surface, as fields of `Surfaces`."""

    condition: Float[Tensor, "a"]
    rows: _Rows
    natural: bool = False
    patterned: bool = False
    """Whether people who have it wear a pattern there."""


class _Skirt(NamedTuple):
    """Boxes of an outfit's skirt, as fields of `Surfaces`."""

    skirt: Int[Tensor, "g"]
    between: Int[Tensor, "g"]
    dense: Float[Tensor, "g 512"]
    size: Float[Tensor, "g 3"]


def fit_surfaces(
    people: LatentSet, codec: LinearCodec, vocabulary: AttributeVocabulary, config: PriorConfig
) -> Surfaces | None:
    """Skin and garments of each outfit, styles of hair, hats and shoes, of detailed people; None if nothing is found.

    The people's attributes say who has them: `config.outfit`, `config.hair`, "pattern" (plain), "hat" (or none) and
    "shoes".
    """
    known = _People(people, codec, vocabulary, config)
    found: list[_Surface] = []
    skirts: list[_Skirt] = []
    for outfit in vocabulary.categories.get(config.outfit, ()):
        sizes = box_sizes(outfit)
        between = (torch.ones(K, 3) if sizes is None else sizes).ne(1).any(1)
        worn = known.worn({config.outfit: outfit}, known.only("pattern", "plain"), between)
        if worn and sizes is not None:
            skirts.append(known.skirt({config.outfit: outfit}, sizes, len(found)))
        found += worn
    for hair in vocabulary.categories.get(config.hair, ()):
        styles = known.in_voxels({config.hair: hair}, known.only("hat", "none"), hair in config.hanging)
        found += [style._replace(natural=True) for style in styles]
    for hat in vocabulary.categories.get("hat", ()):
        if hat != "none":
            found += known.in_voxels({"hat": hat})
    for shoes in vocabulary.categories.get("shoes", ()):
        found += known.in_voxels({"shoes": shoes}, where=("feet", "feet", "shins"))
    if not found:
        return None
    rows = _Rows(*(torch.cat(each) for each in zip(*(one.rows for one in found), strict=True)))
    surface = torch.cat([torch.full((len(one.rows.cell),), number) for number, one in enumerate(found)])
    garment, printed, box, second = [], [surface[:0]], [surface[:0]], [rows.share[:0]]
    for number, one in enumerate(found):
        boxes = (surface == number).nonzero()[:, 0]
        for found_print in known.prints(one):
            printed.append(torch.full((len(found_print.box),), len(garment)))
            garment.append(number)
            box.append(boxes[found_print.box])
            second.append(found_print.second)
    fields = optional_fields() | known.face()
    if skirts:
        fields |= {name: torch.cat([getattr(skirt, name) for skirt in skirts]) for name in _Skirt._fields}
    return Surfaces(
        condition=torch.stack([one.condition for one in found]),
        natural=torch.tensor([one.natural for one in found]),
        surface=surface,
        **rows._asdict(),
        garment=torch.tensor(garment, dtype=torch.int64),
        printed=torch.cat(printed),
        box=torch.cat(box),
        second=torch.cat(second),
        **fields,
    )


class _People:
    """Detailed people, with the mean colours of their boxes."""

    def __init__(
        self, people: LatentSet, codec: LinearCodec, vocabulary: AttributeVocabulary, config: PriorConfig
    ) -> None:
        count = int(people.detailed)
        self.latents, self.codec, self.vocabulary = people.latents[:count], codec, vocabulary
        self.condition, self.geometry = people.condition[:count], people.geometry[:count]
        self.hanging = torch.zeros(count, dtype=torch.bool)
        for hair in vocabulary.categories.get(config.hair, ()):
            if hair in config.hanging:
                self.hanging |= self.condition @ vocabulary.encode({config.hair: hair}) > 0
        self.boxes = torch.cat([mean_colour(voxels, seen(voxels)) for voxels in self.voxels(torch.arange(count))])
        self.skin = torch.full((count, 3), torch.nan)
        """The colour of faces, where it is known."""

    def only(self, name: str, value: str) -> Mapping[str, str]:
        """The attribute, unless it is unknown."""
        return {name: value} if value in self.vocabulary.categories.get(name, ()) else {}

    def voxels(self, people: Int[Tensor, "n"]) -> Iterator[Float[Tensor, "m 1024 512 4"]]:
        """Voxels of people, some at a time."""
        for some in people.split(CHUNK):
            yield voxels_of(self.codec.decode(self.latents[some].float()))

    def with_all(
        self, attributes: Mapping[str, str], hanging: bool = True
    ) -> tuple[Float[Tensor, "a"], Int[Tensor, "n"]]:
        """A condition, and the people of whom it is true; none if they are of few geometries.

        Hanging hair covers clothes: without, people who have it are left out.
        """
        row = self.vocabulary.encode(attributes)
        return row, self.of(row, hanging)

    def of(self, row: Float[Tensor, "a"], hanging: bool) -> Int[Tensor, "n"]:
        """The people of a condition, as `with_all`."""
        own = (self.condition @ row >= row.sum()) & (hanging | ~self.hanging)
        few = len(self.geometry[own].unique()) < FEWEST_GEOMETRIES
        return (own & (not few)).nonzero()[:, 0]

    def worn(
        self, attributes: Mapping[str, str], plain: Mapping[str, str], between: Bool[Tensor, "k"]
    ) -> list[_Surface]:
        """Skin and plain garments of an outfit, in the boxes that they cover and in the voxels where they meet, and in
        all boxes `between` the legs."""
        row, own = self.with_all(attributes, hanging=False)
        boxes, face = self.boxes[own], region_of(("face",))
        if not len(own):
            return []
        beside = [boxes[:, region_of((name,))].mean(1) for name in ("torso", "hips")]
        skin = covered_by(boxes, region_of(("hands",)), beside, ~region_of(("hair",)))
        if skin is None or not (skin & face).any():
            return []
        self.skin[own] = boxes[:, skin & face].mean(1)
        whoever, everyone = row, own
        row, own = self.with_all({**attributes, **plain}, hanging=False)
        patterned = everyone[~torch.isin(everyone, own)]
        boxes, parts, left = self.boxes[own], [skin & face], ~skin & ~region_of(("face", "hair", "hands"))
        while len(own) and (start := largest_part(boxes, left)) is not None:
            garment = covered_by(boxes, start, [boxes[:, part].mean(1) for part in parts], left)
            if garment is not None:
                garment |= surrounded(garment) & left
                parts.append(garment)
            left &= ~(start if garment is None else start | garment)
        found, everywhere = [], torch.ones_like(skin)
        for part in parts[1:]:
            if self.unevenness(own, part) > (UNEVEN_SMALL if part.sum() < SMALL else UNEVEN_GARMENT):
                parts = [each for each in parts if each is not part]
                alike = self.alike(own, part)
                found.append(_Surface(whoever, self.rows(own, alike, read=everywhere, drawn=~everywhere)))
        if len(parts) == 1:
            return [*found, _Surface(whoever, self.rows(everyone, skin, read=face, drawn=~face), natural=True)]
        borders = self.borders(own, parts, between)
        meet = torch.zeros_like(skin).index_fill(0, torch.cat([border.cell for border in borders]), True)
        for part, border in zip(parts, borders, strict=True):
            if not (part & ~meet).any():  # no box says what its colour is
                continue
            bare = part is parts[0]
            read, drawn = (face, ~face) if bare else (everywhere, everywhere)
            whole = self.rows(*((everyone, skin & ~meet) if bare else (own, part & ~meet)), read, drawn)
            rows = _Rows(*(torch.cat(pair) for pair in zip(whole, border, strict=True)))
            if bare or (len(patterned) and self.unevenness(patterned, part) < UNEVEN):  # patterned elsewhere
                found.append(_Surface(whoever, rows, natural=bare))
                continue
            found.append(_Surface(row, rows))
            others = {*self.vocabulary.categories.get("pattern", ())} - {*plain.values()} if plain else ()
            for pattern in sorted(others):
                condition = whoever + self.vocabulary.encode({"pattern": pattern})
                if (self.condition @ condition >= condition.sum()).any():
                    found.append(_Surface(condition, rows._replace(drawn=~rows.read), patterned=True))
        return found

    def face(self) -> dict[str, Tensor]:
        """Regressions of the face's colours on the skin, as fields of `Surfaces`; none without people in outfits."""
        own = (~self.skin.isnan().any(1)).nonzero()[:, 0]
        if not len(own):
            return {}
        skin, face = self.skin[own], region_of(("face",)).nonzero()[:, 0]
        mean = skin.mean(0)
        features, by_skin = (torch.zeros(len(face), S**3, *size) for size in ((3,), ()))
        for some, voxels in zip((skin - mean).split(CHUNK), self.voxels(own), strict=True):
            colours = voxels[:, face, :, :3]
            features += colours.sum(0) / len(own)
            by_skin += torch.einsum("nc,nkvc->kv", some, colours)
        by_skin = (by_skin / (skin - mean).square().sum().clamp_min(1e-6)).clamp(0, BRIGHTEST)
        skins = torch.stack([mean, skin[skin.mean(1).argmin()]])
        return {"face": face, "features": features.clamp(0, 1), "by_skin": by_skin, "skin": skins}

    def skirt(self, attributes: Mapping[str, str], sizes: Float[Tensor, "k 3"], surface: int) -> _Skirt:
        """The boxes that are sized for the outfit's skirt, as dense as on most people: its cloth is at other places
        on each. Hems are at many heights; below that of the longer ones, boxes are as dense as on the middle person."""
        _, own = self.with_all(attributes)
        between = (sizes != 1).any(1).nonzero()[:, 0]
        everyone = torch.cat([voxels[:, between, :, 3].clamp(0, 1) for voxels in self.voxels(own)])
        height, away = voxel_heights(between, sizes[between]), torch.arange(S**3) >= S**3 // 2  # from the body
        cloth = (everyone > SOLID) & away
        hem = torch.stack([height[one].quantile(BELOW_HEM) for one in cloth if one.any()]).quantile(LONGER)
        dense = torch.where(height > hem, everyone.quantile(DENSE, dim=0), everyone.median(0).values)
        return _Skirt(torch.full_like(between, surface), between, dense, sizes[between])

    def unevenness(self, people: Int[Tensor, "n"], garment: Bool[Tensor, "k"]) -> float:
        """Median over its boxes of the rms difference from one colour on these people."""
        return float(tones_of(self.boxes[people], garment)[1][garment].median())

    def alike(self, people: Int[Tensor, "n"], garment: Bool[Tensor, "k"]) -> Bool[Tensor, "k"]:
        """The boxes of a garment that differ least from one colour on these people."""
        uneven = tones_of(self.boxes[people], garment)[1].masked_fill(~garment, torch.inf)
        return garment & (uneven <= uneven.sort().values[:MOST_READ].max())

    def prints(self, garment: _Surface) -> list[Print]:
        """Prints on a garment of patterned people."""
        own, rows = self.of(garment.condition, hanging=False), garment.rows
        if not garment.patterned or not len(own):
            return []
        voxels = torch.cat([voxels[:, rows.cell] for voxels in self.voxels(own)])
        weight = seen(voxels).mean(0) * rows.share * (rows.tone > DIMMEST)
        untoned = voxels[..., :3] / rows.tone.clamp_min(DIMMEST)[..., None]
        return find_prints(untoned, weight, rows.share, rows.read, self.geometry[own])

    def rows(
        self, own: Int[Tensor, "n"], part: Bool[Tensor, "k"], read: Bool[Tensor, "k"], drawn: Bool[Tensor, "k"]
    ) -> _Rows:
        """A surface in the boxes that it covers; its colour is that of boxes where it is read."""
        colour = self.boxes[own][:, part & read].mean(1)
        by_colour, weight = torch.zeros(2, int(part.sum()), S**3)
        for some, voxels in zip(colour.split(CHUNK), self.voxels(own), strict=True):
            counted = density_weight(voxels[:, part])
            by_colour += torch.einsum("nc,nkvc->kv", some, counted[..., None] * voxels[:, part, :, :3])
            weight += torch.einsum("nkv,n->kv", counted, some.square().sum(1))
        tones = (spread(by_colour) / spread(weight).clamp_min(1e-6)).clamp(0, BRIGHTEST)
        return _Rows(part.nonzero()[:, 0], torch.ones_like(tones), tones, read[part], drawn[part])

    def borders(
        self,
        own: Int[Tensor, "n"],
        parts: Sequence[Bool[Tensor, "k"]],
        always: Bool[Tensor, "k"],
    ) -> list[_Rows]:
        """Voxels of each of these surfaces in the boxes where some meet, if they explain the box on other people too,
        or in any case.

        A surface is drawn over those before it, so its share is that of what later ones leave.
        """
        anywhere = ~region_of(("face", "hair", "hands"))
        cells = anywhere.nonzero()[:, 0]
        number = self.geometry[own].unique(return_inverse=True)[1]
        one, other = (
            Meeting.of([self.boxes[half][:, part].mean(1) for part in parts], self.voxels(half), anywhere)
            for half in (own[number % 2 == 0], own[number % 2 == 1])
        )
        error, differences = ((a + b) / 2 for a, b in zip(one.tested(other), other.tested(one), strict=True))
        explained = (error < UNEXPLAINED * differences) & (error.sqrt() < UNEVEN_BORDER)
        both = Meeting(*(a + b for a, b in zip(one, other, strict=True)))
        parts_of, tone = both.fitted()
        of_boxes = (parts_of * both.seen[..., None]).sum(1) / both.seen.sum(1).clamp_min(1e-6)[:, None]
        explained = (explained & (of_boxes.amax(1) < WHOLE)) | always[cells]
        parts_of *= (of_boxes > LEAST_SHARE)[:, None]
        parts_of /= parts_of.sum(-1, keepdim=True).clamp_min(1e-6)
        above = torch.zeros(len(cells), S**3)
        borders = []
        for of_part, of_box in zip(reversed(parts_of.unbind(-1)), reversed(of_boxes.unbind(-1)), strict=True):
            share = (of_part / (1 - above).clamp_min(1e-6)).clamp(0, 1)
            above += of_part
            cloth = ((share - NO_CLOTH) / (ALL_CLOTH - NO_CLOTH)).clamp(0, 1)
            share = torch.where(always[cells][:, None], cloth, share)
            kept = explained & (of_box > LEAST_SHARE)
            rows = share[kept], tone[kept], torch.zeros_like(kept)[kept], torch.ones_like(kept)[kept]
            borders.append(_Rows(cells[kept], *rows))
        return borders[::-1]

    def in_voxels(
        self,
        attributes: Mapping[str, str],
        shown: Mapping[str, str] = {},
        hanging: bool = False,
        where: tuple[str, str, str] = ("head", "hair", "hands"),
    ) -> list[_Surface]:
        """The voxels of a style of hair, or a hat, on the head, and on the clothes if it hangs over them; or of shoes.

        They are found on people with the attributes `shown` too: those without a hat. `where` names the part on which
        they are, the one that has their colour, and one that has that of what is beside them.
        """
        row = self.vocabulary.encode(attributes)
        _, own = self.with_all({**attributes, **shown})
        if not len(own):
            return []
        part, below = region_of(where[:1]), region_of(("torso", "hips", "arms"))
        cells = (part | below if hanging else part).nonzero()[:, 0]
        on_part = part[cells]
        colour, beside = (self.boxes[own][:, region_of((name,))].mean(1) for name in where[1:])
        if unexplained_share(colour, beside) < BALD:
            return []
        share = torch.zeros(len(cells), S**3)
        for number in range(PASSES):
            if number:
                sure = (share[on_part] - SURELY).clamp_min(0)
                of_part = (voxels[:, cells[on_part]] for voxels in self.voxels(own))
                colour = torch.cat([mean_colour(v.flatten(1, 2), (sure * seen(v)).flatten(1)) for v in of_part])
            normal, design = normal_equations([colour, beside])
            by_design, by_colour, density = (torch.zeros(len(cells), S**3, *size) for size in ((2,), (), ()))
            for x, some, voxels in zip(design.split(CHUNK), colour.split(CHUNK), self.voxels(own), strict=True):
                by_design += torch.einsum("ncq,nkvc->kvq", x, voxels[:, cells, :, :3])
                by_colour += torch.einsum("nc,nkvc->kv", some, voxels[:, cells, :, :3])
                density += voxels[:, cells, :, 3].sum(0) / len(own)
            tone = (by_colour / colour.square().sum().clamp_min(1e-6)).clamp(0, BRIGHTEST)
            slope = torch.linalg.solve(normal, by_design[..., None])[..., 0, 0]
            slope = smooth(slope) / smooth(tone).clamp(DARKEST, 1)
            share = ((slope - NO_HAIR) / (ALL_HAIR - NO_HAIR)).clamp(0, 1)
            share *= (((share > 0.5) & (density > SOLID)).sum(1) >= FEWEST_VOXELS)[:, None]
            if not share[on_part].any():
                return []
        kept = share.any(1)
        tone = tone * (share > 0)
        rows = _Rows(cells[kept], share[kept], tone[kept], on_part[kept], torch.ones_like(on_part[kept]))
        return [_Surface(row, rows)]
