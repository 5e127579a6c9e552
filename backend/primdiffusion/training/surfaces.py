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
from torch.nn import functional

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.surfaces import (
    BRIGHTEST,
    DIMMEST,
    SURELY,
    Surfaces,
    seen,
    voxels_of,
    without_faces_and_skirts,
)
from primdiffusion.editing.regions import region_of
from primdiffusion.people.skirts import box_sizes
from primdiffusion.primitives.primitives import GRID, K, S
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import LatentSet
from primdiffusion.training.prints import FEWEST_GEOMETRIES, Print, find_prints

PASSES = 3
"""Regressions, each on the colour of what the former found."""
CHUNK = 16
"""People whose voxels are in memory at once."""
NO_HAIR, ALL_HAIR = 0.4, 0.8
"""Slopes of a voxel's colour on the hair's, as shares of its tone: below is no hair, above all of it is."""
DARKEST = 0.5
"""Tones below this count as this: chance is large beside a dark voxel's colour."""
FEWEST_VOXELS, SOLID = 8, 0.3
"""Voxels of hair, as dense as that, in a box; fewer are chance."""
BALD = 0.3
"""Share of the variance of hair that is not the skin's; with less the head is bald."""
COVERED, OTHERS = 0.85, 0.3
"""Least slope of a box's colour on the surface's, as a share of its tone, and largest slopes on other colours."""
UNEVEN = 0.04
"""Largest rms difference between a box's colour and its tone of the surface's."""
UNEVEN_GARMENT = 0.0136
"""The same in the median over a garment's boxes: more are prints and fades, which plain garments may have too."""
SMALL, UNEVEN_SMALL = 80, 0.03
"""Boxes of a garment without fades, of which others leave little, and the same of it: a shirt below a jacket."""
UNEVEN_BORDER = 0.12
"""The same of voxels where surfaces meet, in boxes that are wholly explained by them."""
UNEXPLAINED = 0.5
"""Largest share of their variance that the surfaces leave."""
LEAST_SHARE = 0.05
"""Of a voxel: less is chance."""
NO_CLOTH, ALL_CLOTH = 0.1, 0.43
"""Shares of a garment between the legs, below which there is none, and above which it hides all else."""
DENSE = 0.9
"""Quantile of people whose cloth between the legs is less dense."""
SURROUNDED = 0.7
"""Share of a box and its neighbours that a garment covers, above which the box is the garment's too."""
FEWEST_BOXES = 24
"""Of a garment, or of skin: socks and collars are too few to tell from chance."""


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
    fields = without_faces_and_skirts() | known.face()
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
        self.boxes = torch.cat([_mean(voxels, seen(voxels)) for voxels in self.voxels(torch.arange(count))])
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
        skin = _covered(boxes, region_of(("hands",)), beside, ~region_of(("hair",)))
        if skin is None or not (skin & face).any():
            return []
        skin &= ~between  # in fits of a skirt, the insides of the legs are hidden
        of_skin = self.rows(own, skin, read=face, drawn=~face)
        self.skin[own] = boxes[:, skin & face].mean(1)
        whoever, everyone = row, own
        row, own = self.with_all({**attributes, **plain}, hanging=False)
        patterned = everyone[~torch.isin(everyone, own)]
        boxes, parts, left = self.boxes[own], [skin & face], ~skin & ~region_of(("face", "hair", "hands"))
        while len(own) and (start := _largest(boxes, left)) is not None:
            garment = _covered(boxes, start, [boxes[:, part].mean(1) for part in parts], left)
            if garment is not None:
                garment |= _surrounded(garment) & left
                parts.append(garment)
            left &= ~(start if garment is None else start | garment)
        parts = [parts[0], *(part for part in parts[1:] if self.even(own, part))]
        if len(parts) == 1:
            return [_Surface(whoever, of_skin, natural=True)]
        meet = ~(skin | torch.stack(parts).any(0) | region_of(("face", "hair", "hands")))
        everywhere, found = torch.ones_like(skin), []
        for part, border in zip(parts, self.borders(own, parts, meet, between), strict=True):
            bare = part is parts[0]
            whole = of_skin if bare else self.rows(own, part, read=everywhere, drawn=everywhere)
            rows = _Rows(*(torch.cat(pair) for pair in zip(whole, border, strict=True)))
            if bare or (len(patterned) and self.even(patterned, part)):  # the pattern is another garment's
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
        """The boxes that are sized for the outfit's skirt, as dense as on most people: its cloth is at other places on
        each."""
        _, own = self.with_all(attributes)
        between = (sizes != 1).any(1).nonzero()[:, 0]
        dense = torch.cat([voxels[:, between, :, 3].clamp(0, 1) for voxels in self.voxels(own)]).quantile(DENSE, dim=0)
        return _Skirt(torch.full_like(between, surface), between, dense, sizes[between])

    def even(self, people: Int[Tensor, "n"], garment: Bool[Tensor, "k"]) -> bool:
        """Whether it has one colour on these people."""
        most = UNEVEN_SMALL if garment.sum() < SMALL else UNEVEN_GARMENT
        return bool(_tones(self.boxes[people], garment)[1][garment].median() < most)

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
        by_colour = sum(
            torch.einsum("nc,nkvc->kv", some, voxels[:, part, :, :3])
            for some, voxels in zip(colour.split(CHUNK), self.voxels(own), strict=True)
        )
        tones = (by_colour / colour.square().sum()).clamp(0, BRIGHTEST)
        return _Rows(part.nonzero()[:, 0], torch.ones_like(tones), tones, read[part], drawn[part])

    def borders(
        self,
        own: Int[Tensor, "n"],
        parts: Sequence[Bool[Tensor, "k"]],
        meet: Bool[Tensor, "k"],
        always: Bool[Tensor, "k"],
    ) -> Iterator[_Rows]:
        """Voxels of each of these surfaces in the boxes where some meet, if they explain the box on other people too,
        or in any case.

        A surface is drawn over those before it, so its share is that of what later ones leave.
        """
        cells = meet.nonzero()[:, 0]
        number = self.geometry[own].unique(return_inverse=True)[1]
        one, other = (
            _Meeting.of([self.boxes[half][:, part].mean(1) for part in parts], self.voxels(half), meet)
            for half in (own[number % 2 == 0], own[number % 2 == 1])
        )
        error, spread = ((a + b) / 2 for a, b in zip(one.tested(other), other.tested(one), strict=True))
        explained = (error < UNEXPLAINED * spread) & (error.sqrt() < UNEVEN_BORDER)
        both = _Meeting(*(a + b for a, b in zip(one, other, strict=True)))
        parts_of, tone = both.fitted()
        weight = both.seen / both.seen.sum(1, keepdim=True).clamp_min(1e-6)
        explained &= (parts_of * weight[..., None]).sum(1).amax(1) < COVERED
        explained |= always[cells]
        above = torch.zeros(len(cells), S**3)
        borders = []
        for of_part in reversed(parts_of.unbind(-1)):
            share = (of_part / (1 - above).clamp_min(1e-6)).clamp(0, 1)
            above += of_part
            cloth = ((share - NO_CLOTH) / (ALL_CLOTH - NO_CLOTH)).clamp(0, 1)
            share = torch.where(always[cells][:, None], cloth, share)
            kept = explained & (of_part > LEAST_SHARE).any(1)
            rows = share[kept], tone[kept], torch.zeros_like(kept)[kept], torch.ones_like(kept)[kept]
            borders.append(_Rows(cells[kept], *rows))
        return reversed(borders)

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
        if _left_of(colour, beside) < BALD:
            return []
        share = torch.zeros(len(cells), S**3)
        for number in range(PASSES):
            if number:
                sure = (share[on_part] - SURELY).clamp_min(0)
                of_part = (voxels[:, cells[on_part]] for voxels in self.voxels(own))
                colour = torch.cat([_mean(v.flatten(1, 2), (sure * seen(v)).flatten(1)) for v in of_part])
            normal, design = _normal([colour, beside])
            by_design, by_colour, density = (torch.zeros(len(cells), S**3, *size) for size in ((2,), (), ()))
            for x, some, voxels in zip(design.split(CHUNK), colour.split(CHUNK), self.voxels(own), strict=True):
                by_design += torch.einsum("ncq,nkvc->kvq", x, voxels[:, cells, :, :3])
                by_colour += torch.einsum("nc,nkvc->kv", some, voxels[:, cells, :, :3])
                density += voxels[:, cells, :, 3].sum(0) / len(own)
            tone = (by_colour / colour.square().sum().clamp_min(1e-6)).clamp(0, BRIGHTEST)
            slope = torch.linalg.solve(normal, by_design[..., None])[..., 0, 0]
            slope = _smooth(slope) / _smooth(tone).clamp(DARKEST, 1)
            share = ((slope - NO_HAIR) / (ALL_HAIR - NO_HAIR)).clamp(0, 1)
            share *= (((share > 0.5) & (density > SOLID)).sum(1) >= FEWEST_VOXELS)[:, None]
            if not share[on_part].any():
                return []
        kept = share.any(1)
        tone = tone * (share > 0)
        rows = _Rows(cells[kept], share[kept], tone[kept], on_part[kept], torch.ones_like(on_part[kept]))
        return [_Surface(row, rows)]


class _Meeting(NamedTuple):
    """Sums over people of boxes where surfaces meet: voxels, their colours as mixtures of those of Q surfaces."""

    normal: Float[Tensor, "q q"]
    by_design: Float[Tensor, "k 512 q"]
    total: Float[Tensor, "k 512 3"]
    square: Float[Tensor, "k 512"]
    seen: Float[Tensor, "k 512"]
    people: Int[Tensor, ""]

    @classmethod
    def of(
        cls,
        colours: Sequence[Float[Tensor, "n 3"]],
        people: Iterator[Float[Tensor, "m 1024 512 4"]],
        cells: Bool[Tensor, "k"],
    ) -> _Meeting:
        normal, design = _normal(colours, centred=False)
        parts = []
        for x, voxels in zip(design.split(CHUNK), people, strict=True):
            rgb = voxels[:, cells, :, :3]
            by_design = torch.einsum("ncq,nkvc->kvq", x, rgb)
            parts.append((by_design, rgb.sum(0), rgb.square().sum((0, 3)), seen(voxels[:, cells]).sum(0)))
        by_design, total, square, weight = (torch.stack(each).sum(0) for each in zip(*parts, strict=True))
        return cls(normal, by_design, total, square, weight, torch.tensor(len(design)))

    def fitted(self) -> tuple[Float[Tensor, "k 512 q"], Float[Tensor, "k 512"]]:
        """How much of a voxel each surface is, and its tone."""
        slopes = torch.linalg.solve(self.normal, self.by_design[..., None])[..., 0].clamp_min(0)
        slopes = torch.stack([_smooth(slope) for slope in slopes.unbind(-1)], dim=-1)
        shares = slopes / slopes.sum(-1, keepdim=True).clamp_min(1e-6)
        along, power = self._products(shares)
        return shares, (along / power).clamp(0, BRIGHTEST)

    def tested(self, other: _Meeting) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
        """Mean squares over each box of what the fit to others leaves, and of differences between people."""
        shares, tone = other.fitted()
        along, power = self._products(shares)
        error = self.square - 2 * tone * along + tone.square() * power
        spread = self.square - self.total.square().sum(-1) / self.people
        weight = self.seen / (3 * self.people * self.seen.sum(1, keepdim=True).clamp_min(1e-6))
        return (error * weight).sum(1), (spread * weight).sum(1)

    def _products(self, shares: Float[Tensor, "k 512 q"]) -> tuple[Float[Tensor, "k 512"], Float[Tensor, "k 512"]]:
        """Of mixtures with the voxels, and with themselves."""
        power = torch.einsum("kvq,qr,kvr->kv", shares, self.normal, shares)
        return (shares * self.by_design).sum(-1), power.clamp_min(1e-6)


def _mean(voxels: Float[Tensor, "*b v 4"], weight: Float[Tensor, "*b v"]) -> Float[Tensor, "*b 3"]:
    """Mean colour of voxels."""
    total = (voxels[..., :3] * weight[..., None]).sum(-2)
    return total / weight.sum(-1, keepdim=True).clamp_min(1e-6)


def _normal(
    colours: Sequence[Float[Tensor, "n 3"]], centred: bool = True
) -> tuple[Float[Tensor, "q q"], Float[Tensor, "n 3 q"]]:
    """The normal matrix of a regression on colours, with the same slope for red, green and blue, and its design."""
    design = torch.stack([colour - colour.mean(0) if centred else colour for colour in colours], dim=-1)
    return torch.einsum("ncq,ncr->qr", design, design) + 1e-2 * torch.eye(len(colours)), design


def _slopes(values: Float[Tensor, "n k 3"], colours: Sequence[Float[Tensor, "n 3"]]) -> Float[Tensor, "k q"]:
    normal, design = _normal(colours)
    return torch.linalg.solve(normal, torch.einsum("ncq,nkc->kq", design, values)[..., None])[..., 0]


def _tones(boxes: Float[Tensor, "n k 3"], part: Bool[Tensor, "k"]) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
    """Tones of boxes of a part's colour, and rms differences from them."""
    colour = boxes[:, part].mean(1)
    tone = torch.einsum("nc,nkc->k", colour, boxes) / colour.square().sum().clamp_min(1e-6)
    return tone, (boxes - tone[:, None] * colour[:, None]).square().mean((0, 2)).sqrt()


def _covered(
    boxes: Float[Tensor, "n k 3"],
    start: Bool[Tensor, "k"],
    others: Sequence[Float[Tensor, "n 3"]],
    within: Bool[Tensor, "k"],
) -> Bool[Tensor, "k"] | None:
    """The boxes `within` that follow the colour of those of the start, and no other; None if they are few."""
    covered = start
    for _ in range(PASSES):
        tone, uneven = _tones(boxes, covered)
        slope, by_others = _slopes(boxes, [boxes[:, covered].mean(1), *others]).split([1, len(others)], dim=-1)
        covered = (slope[:, 0] / tone.clamp(DARKEST, 1 / DARKEST) > COVERED) & (uneven < UNEVEN) & within
        covered &= (by_others.abs() < OTHERS).all(-1)
        if covered.sum() < FEWEST_BOXES:
            return None
    return covered


def _surrounded(part: Bool[Tensor, "k"]) -> Bool[Tensor, "k"]:
    """Boxes nearly all of whose neighbours on the grid are in the part: holes, where a few people wear a badge."""
    around = functional.avg_pool2d(part.float().view(1, GRID, GRID), 3, stride=1, padding=1)
    return around.flatten() > SURROUNDED


def _largest(boxes: Float[Tensor, "n k 3"], left: Bool[Tensor, "k"]) -> Bool[Tensor, "k"] | None:
    """The most boxes among those left that have the tones of one of them; None if they are few."""
    of_boxes = boxes[:, left].transpose(0, 1).flatten(1)
    products = of_boxes @ of_boxes.T
    tone = products / products.diagonal().clamp_min(1e-6)
    uneven = ((products.diagonal()[:, None] - tone * products).clamp_min(0) / of_boxes.shape[1]).sqrt()
    alike = (uneven < UNEVEN) & (tone > DARKEST) & (tone < 1 / DARKEST)
    if not len(alike) or alike.sum(0).max() < FEWEST_BOXES:
        return None
    return torch.zeros_like(left).masked_scatter(left, alike[:, alike.sum(0).argmax()])


def _left_of(colour: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"]) -> float:
    """Share of a colour's variance that another one does not explain."""
    centred, design = colour - colour.mean(0), other - other.mean(0)
    slope = (centred * design).sum() / design.square().sum().clamp_min(1e-6)
    return float((centred - slope * design).square().sum() / centred.square().sum().clamp_min(1e-6))


def _smooth(values: Float[Tensor, "c 512"]) -> Float[Tensor, "c 512"]:
    """Means over neighbouring voxels of each box: the slope of one voxel is noisy."""
    boxes = functional.pad(values.view(-1, 1, S, S, S), (1,) * 6, mode="replicate")
    return functional.avg_pool3d(boxes, 3, stride=1).view_as(values)
