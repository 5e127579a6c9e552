"""Surfaces of one colour and prints in two: found in people whose colours are known, drawn, stored in bytes."""

import dataclasses

import pytest
import torch
from primdiffusion.diffusion.checkpoint import load_checkpoint, restore_surfaces, save_checkpoint, store_surfaces
from primdiffusion.diffusion.codec import SCALE_VALUE, VALUES, LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.model import check_surfaces
from primdiffusion.diffusion.surfaces import BLACK, BRIGHTEST, LARGEST, Surfaces, optional_fields, voxels_of
from primdiffusion.editing.regions import region_of
from primdiffusion.human import decode_humans
from primdiffusion.primitives.primitives import GRID, K, S
from primdiffusion.primitives.skirts import box_sizes, inside_legs, voxel_heights
from primdiffusion.training.colour_pairs import with_colour_pairs
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import LatentSet
from primdiffusion.training.surfaces import MOST_READ, fit_surfaces
from support.errors import refused
from support.tiny import model_of_two_kinds

WORDS = AttributeVocabulary(
    {
        "outfit": ("blouse and skirt", "jumper", "suit", "tee"),
        "pattern": ("patterned", "plain"),
        "hair": ("bald", "long", "short"),
        "hat": ("cap", "none"),
        "shoes": ("boots",),
    },
    {},
)
GEOMETRIES, COLOURINGS = 6, 6
WORN = ("hair", "tee", "trousers", "skin", "cap", "print", "boots")
INNER, OUTER = slice(0, S**3 // 2), slice(S**3 // 2, S**3)
"""Halves of a box, near the body and away from it."""
FAR_IN, FAR_OUT = slice(0, S**3 // 2 - S**2), slice(S**3 // 2 + S**2, S**3)
"""Without the layers next to the other half, which smoothing reaches."""
UPPER = torch.arange(S**3) // S % S >= S // 2
"""Half of a box, as far from the body as the other."""
HANGING, CUFF = 0.6, 0.8
"""Tones of hair that hangs, and of a tee's lower part."""
TOP, CUFFS, BARE = ("torso", "upper_arms"), ("upper_arms",), ("forearms", "hands", "shins", "face")
SKIRT = ("hips", "thighs", "shins")
COLLAR = ("neck",)
"""The upper half is the tee's; the lower one is skin."""
PRINTS = ("stripes", "block")


@pytest.fixture(scope="module")
def codec():
    """Without loss for boxes whose quarters have one colour and density each."""
    basis = torch.zeros(4, 4, 4, S**3)
    outer = torch.arange(S**3) >= S**3 // 2
    for number, quarter in enumerate(torch.stack([~outer & ~UPPER, ~outer & UPPER, outer & ~UPPER, outer & UPPER])):
        basis[number, torch.arange(4), torch.arange(4)] = quarter * (S**3 / 4) ** -0.5
    basis = torch.nn.functional.pad(basis.flatten(2).flatten(0, 1), (0, 3))
    mean = torch.nn.functional.pad(torch.zeros(K, VALUES - 3), (0, 3), value=SCALE_VALUE)
    return LinearCodec(mean, basis[None], torch.ones(1, 16), torch.zeros(K, dtype=torch.int64))


def below_hair():
    """Boxes of the torso over which long hair hangs."""
    return region_of(("torso",)).nonzero()[::4, 0]


def below_cap():
    """Boxes of hair that a cap covers."""
    return region_of(("hair",)).nonzero()[::2, 0]


def badge():
    """A box in the middle of the suit's jacket."""
    top = region_of(TOP).float().view(1, GRID, GRID)
    return int((torch.nn.functional.avg_pool2d(top, 3, 1, 1) == 1).flatten().nonzero()[0, 0])


def second_of(pattern):
    """Boxes of a tee and its collar in the second colour."""
    tee = region_of((*TOP, *COLLAR))
    every_third = torch.zeros(K, dtype=torch.bool).index_fill(0, tee.nonzero()[::3, 0], True)
    return {"stripes": every_third, "block": region_of(CUFFS)}[pattern]


def printed(colours, pattern, strength=1.0):
    """Colours of the boxes [K, 3] of a printed tee, of which the cuffs are darker."""
    boxes = torch.lerp(colours["tee"], colours["print"], strength * second_of(pattern).float()[:, None])
    return torch.where(region_of(CUFFS)[:, None], CUFF * boxes, boxes)


def dressed(hair, colours, generator, pattern="", cap=False, outfit="tee", boots=False):
    """Cells of a person in a tee with faded trousers or a skirt, or in a suit."""
    voxels = torch.zeros(K, S**3, 4)
    voxels[..., 3] = 1.0
    voxels[..., :3] = colours["skin"]
    trousers = region_of(("hips", "thighs", "feet"))
    fades = 1 + 0.14 * (torch.rand(int(trousers.sum()), 1, 1, generator=generator) - 0.5)
    voxels[trousers, :, :3] = fades * colours["trousers"]
    voxels[region_of(TOP), :, :3] = colours["tee"]
    voxels[region_of(CUFFS), :, :3] *= CUFF
    voxels[region_of(COLLAR), :, :3] = torch.where(UPPER[:, None], colours["tee"], colours["skin"])
    feet = region_of(("feet",))  # socks of the tee's colour, darker or brighter on everybody: no border of surfaces
    voxels[feet, :, :3] = (0.8 + 0.4 * torch.rand(int(feet.sum()), 1, 1, generator=generator)) * colours["tee"]
    if boots:
        voxels[feet, INNER, :3], voxels[feet, OUTER, :3] = colours["skin"], colours["boots"]
    if outfit == "blouse and skirt":
        voxels[region_of(SKIRT), :, :3] = colours["trousers"]
    if outfit == "suit":
        voxels[region_of((*TOP, "hips", "thighs")), :, :3] = colours["tee"]
    if pattern:
        voxels[region_of(TOP), :, :3] = printed(colours, pattern)[region_of(TOP), None]
        collar = printed(colours, pattern)[region_of(COLLAR), None]
        voxels[region_of(COLLAR), :, :3] = torch.where(UPPER[:, None], collar, colours["skin"])
    if hair == "bald":
        voxels[region_of(("hair",)), :, :3] *= 0.9 + 0.2 * torch.rand(1, generator=generator)
    else:
        voxels[region_of(("hair",)), OUTER, :3] = colours["hair"]
    if hair == "long":
        voxels[below_hair(), OUTER, :3] = HANGING * colours["hair"]
    if cap:
        voxels[below_cap(), :, :3] = colours["cap"]
    return torch.nn.functional.pad(voxels.mT.flatten(1), (0, 3), value=SCALE_VALUE)


def some_colours(generator):
    """Dark hair goes with dark skin."""
    drawn = {name: 0.15 + 0.7 * torch.rand(3, generator=generator) for name in WORN}
    drawn |= {name: drawn[name].sort(descending=True).values for name in ("hair", "skin")}
    return drawn | {"skin": 0.75 * drawn["skin"] + 0.25 * drawn["hair"]}


@pytest.fixture(scope="module")
def people(codec):
    generator = torch.Generator().manual_seed(1)
    cells, conditions = [], []
    names = [hair for hair in ("long", "short", "bald", "cap", "suit", "blouse and skirt") for _ in range(GEOMETRIES)]
    for geometry, name in enumerate(names):
        hair, outfit = (
            name if name in WORDS.categories[kind] else other for kind, other in (("hair", "short"), ("outfit", "tee"))
        )
        for number in range(COLOURINGS):
            pattern = PRINTS[geometry % 2] if number == 0 and outfit != "suit" else ""
            boots = geometry % 3 == 0
            cells.append(dressed(hair, some_colours(generator), generator, pattern, name == "cap", outfit, boots))
            known = {"outfit": outfit, "pattern": "patterned" if pattern else "plain"}
            known |= {"shoes": "boots"} if boots else {}
            conditions.append(WORDS.encode({**known, "hair": hair, "hat": "cap" if name == "cap" else "none"}))
    geometry = torch.arange(len(names)).repeat_interleave(COLOURINGS)
    latents = codec.encode(torch.stack(cells)).half().flatten(2)
    suits = geometry // GEOMETRIES == names.index("suit") // GEOMETRIES
    latents[suits, :, badge()] = latents[suits, :, badge()].roll(COLOURINGS + 1, 0)  # in another colour on everybody
    return LatentSet(
        latents.unflatten(2, (GRID, GRID)),
        geometry,
        torch.zeros(len(names), 10),
        torch.stack(conditions),
        torch.tensor(len(latents)),
    )


@pytest.fixture(scope="module")
def surfaces(people, codec):
    return fit_surfaces(people, codec, WORDS, PriorConfig())


def rows_of(surfaces, **known):
    """The rows of the surface of exactly these people, in their boxes' order."""
    found = (surfaces.condition == WORDS.encode(known)).all(1).nonzero()[:, 0]
    return [
        surfaces.map(
            lambda values, one=one: values[surfaces.surface == one] if len(values) == len(surfaces.cell) else values
        )
        for one in found
    ]


def over(values, cells):
    """Values of rows by their boxes; 0 in others."""
    return torch.zeros(K, *values.shape[1:], dtype=values.dtype).index_copy(0, cells, values)


def test_hair_is_found_where_people_of_a_style_have_it(surfaces):
    (long,), (short,) = (rows_of(surfaces, hair=hair) for hair in ("long", "short"))
    for style in (long, short):
        share = over(style.share, style.cell)[region_of(("hair",))]
        assert float(share[:, FAR_OUT].min()) > 0.9
        assert float(share[:, FAR_IN].max()) < 0.1
    share, tone = (over(each, long.cell)[below_hair()] for each in (long.share, long.tone))
    assert float(share[:, FAR_OUT].min()) > 0.9
    assert float(share[:, FAR_IN].max()) < 0.1
    torch.testing.assert_close(tone[:, FAR_OUT], torch.full_like(tone[:, FAR_OUT], HANGING), atol=0.03, rtol=0)
    bare = region_of(("torso",)).index_fill(0, below_hair(), False)
    assert not over(long.share, long.cell)[bare].any()
    assert not over(short.share, short.cell)[region_of(("torso", "legs", "hands"))].any()
    assert not rows_of(surfaces, hair="bald")  # whose scalp has the colour of the hands


def test_shoes_are_found_in_the_voxels_that_they_cover(surfaces):
    ((cell, share),) = ((each.cell, each.share) for each in rows_of(surfaces, shoes="boots"))
    assert torch.equal(over(torch.ones_like(cell), cell).bool(), region_of(("feet",)))
    assert float(share[:, FAR_OUT].min()) > 0.9
    assert float(share[:, FAR_IN].max()) < 0.1


def test_garments_and_skin_are_found_in_the_boxes_that_they_cover(surfaces):
    garments, (faded, skin) = rows_of(surfaces, outfit="tee", pattern="plain"), rows_of(surfaces, outfit="tee")
    tee = next(each for each in garments if region_of(("torso",))[each.cell].any())
    assert torch.equal(over(tee.read, tee.cell), region_of(TOP))
    tone = over(tee.tone, tee.cell)
    ratio = float(tone[region_of(CUFFS)].mean() / tone[region_of(("torso",))].mean())
    assert ratio == pytest.approx(CUFF, abs=0.02)
    assert region_of(BARE)[skin.cell].sum() == region_of(BARE).sum()
    assert not region_of((*TOP, "hips", "feet", "hair"))[skin.cell].any()
    assert torch.equal(skin.read, region_of(("face",))[skin.cell])
    assert torch.equal(skin.drawn, ~skin.read)
    assert not any(region_of(("thighs",))[each.cell].any() for each in garments)  # fades are no chance
    assert region_of(("hips", "thighs"))[faded.cell].all()
    assert (len(faded.cell), faded.read.all(), faded.drawn.any()) == (MOST_READ, True, False)


def test_a_suit_of_one_cloth_is_one_surface_with_the_box_of_another_colour_in_its_middle(surfaces):
    (suit,) = (each for each in rows_of(surfaces, outfit="suit", pattern="plain") if each.drawn.all())
    assert torch.equal(over(suit.read, suit.cell), region_of((*TOP, "hips", "thighs")))


def test_a_pattern_on_the_tee_leaves_the_skirt_in_one_colour(surfaces):
    _, skirt = rows_of(surfaces, outfit="blouse and skirt")
    assert torch.equal(over(skirt.drawn, skirt.cell), region_of(SKIRT))


def test_voxels_where_surfaces_meet_belong_to_each(surfaces):
    (_, bare), (tee,) = rows_of(surfaces, outfit="tee"), rows_of(surfaces, outfit="tee", pattern="plain")
    collar = region_of(COLLAR)
    assert region_of(("face",))[bare.cell[bare.read]].all()
    below, above = (over(part.share * part.drawn[:, None], part.cell) for part in (bare, tee))
    assert float(above[collar][:, UPPER].min()) > 0.9
    assert float(above[collar][:, ~UPPER].max()) < 0.1
    assert float(below[collar][:, ~UPPER].min()) > 0.9
    for part, share in ((bare, below), (tee, above)):
        assert not part.read[collar[part.cell]].any()
        assert not share[region_of(("feet", "thighs"))].any()  # which no two surfaces share


@pytest.mark.parametrize("cap", [False, True])
def test_what_took_other_colours_gets_its_own_back(surfaces, cap):
    generator = torch.Generator().manual_seed(7)
    colours = some_colours(generator)
    right = dressed("long", colours, generator, cap=cap)
    wrong = voxels_of(right).clone()
    below, bare = below_hair(), region_of(("forearms", "hands", "shins"))
    wrong[below, OUTER, :3] = (wrong[below, OUTER, :3] + colours["tee"]) / 2  # hair of the shirt's colour
    blotches = region_of(("torso",)).nonzero()[1::4, 0]
    wrong[blotches, :, :3] *= 0.7
    wrong[bare, :, :3] *= 0.8  # darker than the face
    crown = below_cap()[::4] if cap else region_of(("hair",)).nonzero()[::4, 0]
    wrong[crown, OUTER, :3] *= 0.5
    wrong = torch.nn.functional.pad(wrong.mT.flatten(1), (0, 3), value=SCALE_VALUE)
    kind = WORDS.encode({"outfit": "tee", "pattern": "plain", "hair": "long", "hat": "cap" if cap else "none"})[None]
    mended = surfaces.draw(wrong[None], kind)[0]
    for region, part in ((below, FAR_OUT), (crown, FAR_OUT), (blotches, slice(None)), (bare, slice(None))):
        before, after = (
            float((voxels_of(cells) - voxels_of(right))[region, part, :3].abs().mean()) for cells in (wrong, mended)
        )
        assert after < 0.15 * before
    face = region_of(("face",))
    torch.testing.assert_close(mended[face], wrong[face], atol=0.02, rtol=0)
    assert torch.equal(voxels_of(mended)[..., 3], voxels_of(wrong)[..., 3])


def test_what_lies_below_a_garment_does_not_change_its_colour(surfaces):
    generator = torch.Generator().manual_seed(11)
    right = dressed("bald", some_colours(generator), generator)
    other, tee = voxels_of(right).clone(), region_of(("torso",))
    other[tee, INNER, :3] += 0.2
    other = torch.nn.functional.pad(other.mT.flatten(1), (0, 3), value=SCALE_VALUE)
    kind = WORDS.encode({"outfit": "tee", "pattern": "plain", "hair": "bald", "hat": "none"})[None]
    drawn, wanted = (voxels_of(surfaces.draw(cells[None], kind)[0])[tee, OUTER, :3] for cells in (other, right))
    torch.testing.assert_close(drawn, wanted, atol=0.02, rtol=0)


def test_hair_and_skin_are_never_bluish_and_black_shows_folds(surfaces):
    natural = surfaces.condition[surfaces.natural]
    for name, values in {"hair": ("long", "short"), "outfit": ("tee", "suit", "blouse and skirt")}.items():
        assert all((natural == WORDS.encode({name: value})).all(1).any() for value in values)
    assert not (natural @ WORDS.encode({"hat": "cap"})).any()
    assert not (natural @ WORDS.encode({"pattern": "plain"})).any()
    colours = some_colours(torch.Generator().manual_seed(2))
    colours |= {"hair": torch.tensor([0.2, 0.25, 0.3]), "tee": torch.zeros(3)}
    cells = dressed("short", colours, torch.Generator(), outfit="suit")[None]
    kind = WORDS.encode({"outfit": "suit", "pattern": "plain", "hair": "short", "hat": "none"})[None]
    drawn = voxels_of(surfaces.draw(cells, kind)[0])[..., :3]
    assert float(drawn[region_of(("hair",))][:, FAR_OUT].std(-1).max()) < 0.01
    torch.testing.assert_close(drawn[region_of(("torso",))].mean((0, 1)), torch.full((3,), BLACK), atol=0.02, rtol=0)
    printed_tee = dressed("bald", colours | {"print": torch.ones(3)}, torch.Generator(), "block")[None]
    kind = WORDS.encode({"outfit": "tee", "pattern": "patterned", "hair": "bald", "hat": "none"})[None]
    drawn = voxels_of(surfaces.draw(printed_tee, kind)[0])[..., :3]
    assert float(drawn[region_of(("torso",)) & ~second_of("block")].min()) > BLACK / 2


@pytest.mark.parametrize("brightness", [0.5, 1.5])
def test_what_faces_differ_by_is_smaller_on_dark_skin(surfaces, brightness):
    skin = brightness * surfaces.skin[0]
    generator = torch.Generator().manual_seed(8)
    right = voxels_of(dressed("short", some_colours(generator) | {"skin": skin}, generator))
    wrong, freckled = right.clone(), region_of(("face",)).nonzero()[::4, 0]
    wrong[freckled, :, :3] += 0.1
    cells = torch.nn.functional.pad(wrong.mT.flatten(1), (0, 3), value=SCALE_VALUE)
    kind = WORDS.encode({"outfit": "tee", "pattern": "plain", "hair": "short", "hat": "none"})[None]
    left = (voxels_of(surfaces.draw(cells[None], kind)[0]) - right)[freckled, :, :3]
    torch.testing.assert_close(left, torch.full_like(left, 0.1 * min(brightness, 1)), atol=0.02, rtol=0)


def test_skin_is_not_darker_than_that_of_all_people(surfaces):
    generator = torch.Generator().manual_seed(8)
    cells = dressed("short", some_colours(generator) | {"skin": torch.zeros(3)}, generator)[None]
    kind = WORDS.encode({"outfit": "tee", "pattern": "plain", "hair": "short", "hat": "none"})[None]
    hands = voxels_of(surfaces.draw(cells, kind)[0])[region_of(("hands",)), :, :3]
    darkest = surfaces.skin[1].expand_as(hands)
    torch.testing.assert_close(hands, darkest, atol=0.02, rtol=0)


def test_skirts_are_as_dense_and_as_large_as_those_of_all_people(surfaces):
    sizes = box_sizes("blouse and skirt")
    torn = torch.rand(2, K, VALUES)
    skirt, tee = (WORDS.encode({"outfit": outfit, "pattern": "plain"}) for outfit in ("blouse and skirt", "tee"))
    worn, other = surfaces.draw(torn, torch.stack([skirt, tee]))
    between = (sizes != 1).any(1)
    torch.testing.assert_close(worn[between, VALUES - 3 :], sizes[between] * SCALE_VALUE)
    torch.testing.assert_close(voxels_of(worn)[between, :, 3], torch.ones(int(between.sum()), S**3), atol=1e-3, rtol=0)
    inside = inside_legs()
    for drawn, before, ends in ((worn, torn[0], inside & ~between), (other, torn[1], inside)):
        kept = ~(ends | between) if drawn is worn else ~ends
        assert torch.equal(drawn[kept, 3 * S**3 :], before[kept, 3 * S**3 :])
        outwards = voxels_of(torch.stack([before, drawn]))[:, ends, :, 3].unflatten(-1, (S, S**2))
        assert torch.equal(outwards[1], outwards[0].cummin(-2).values)  # beyond a gap is the other leg


def found_on(codec, outfit, change):
    """Surfaces of people in one outfit; `change` is made to the voxels of each geometry in its colours."""
    generator = torch.Generator().manual_seed(9)
    known = {"outfit": outfit, "pattern": "plain", "hair": "short", "hat": "none"}
    cells = []
    for geometry in torch.arange(GEOMETRIES).repeat_interleave(COLOURINGS):
        colours = some_colours(generator)
        voxels = voxels_of(dressed("short", colours, generator, outfit=outfit)).clone()
        change(voxels, colours, geometry, generator)
        cells.append(torch.nn.functional.pad(voxels.mT.flatten(1), (0, 3), value=SCALE_VALUE))
    latents, geometry = codec.encode(torch.stack(cells)), torch.arange(GEOMETRIES).repeat_interleave(COLOURINGS)
    condition = WORDS.encode(known).expand(len(latents), -1)
    people = LatentSet(latents.half(), geometry, torch.zeros(GEOMETRIES, 10), condition, torch.tensor(len(latents)))
    return fit_surfaces(people, codec, WORDS, PriorConfig())


def test_cloth_between_the_legs_hides_them_and_is_as_dense_as_on_most_people_down_to_their_hem(codec):
    sizes = box_sizes("blouse and skirt")
    between = (sizes != 1).any(1).nonzero()[:, 0]
    height, away = voxel_heights(between, sizes[between]), torch.arange(S**3) >= S**3 // 2
    dense = 0.31 + 0.3 * torch.rand(GEOMETRIES, generator=torch.Generator().manual_seed(9))

    def hang(voxels, colours, geometry, generator):
        cloth = 0.6 * colours["trousers"] + 0.4 * torch.rand(len(between), 1, 3, generator=generator)
        voxels[between, INNER, :3], voxels[between, OUTER, :3] = colours["skin"], cloth
        ends = -0.45 if geometry else -1.0
        voxels[between, :, 3] = dense[geometry] * ~(away & (height < ends))

    found = found_on(codec, "blouse and skirt", hang)
    each = dense.repeat_interleave(COLOURINGS)
    above, below = height.amin(1) > -0.44, away & (height < -0.5)
    assert above.any()
    assert below.any()
    torch.testing.assert_close(found.dense[above], each.quantile(0.9).expand(int(above.sum()), S**3), atol=0.01, rtol=0)
    assert float(found.dense[below].max()) < 0.2 < float(dense.min())
    hidden = torch.zeros(K, S**3)
    for surface in (~found.natural).nonzero()[:, 0]:
        own = found.surface == surface
        hidden[found.cell[own]] = torch.maximum(hidden[found.cell[own]], found.share[own])
    assert float(hidden[between[above]][:, OUTER].min()) > 0.95


def test_a_garment_ends_where_a_box_shows_a_little_of_the_skin(codec):
    hem = region_of(("torso",)).nonzero()[1::4, 0]

    def bare(voxels, colours, _geometry, _generator):
        voxels[hem[:, None], ~UPPER] = torch.cat([colours["skin"], torch.tensor([0.12])])

    found = found_on(codec, "tee", bare)
    (tee,) = (s for s in (~found.natural).nonzero()[:, 0] if torch.isin(hem, found.cell[found.surface == s]).all())
    share = found.share[(found.surface == tee) & torch.isin(found.cell, hem)]
    torch.testing.assert_close(share[:, OUTER], UPPER[OUTER].float().expand(len(share), -1), atol=0.1, rtol=0)


def test_empty_voxels_have_the_tone_of_those_below_them(codec):
    boxes = region_of(("torso",)).nonzero()[1::4, 0]

    def thin(voxels, _colours, geometry, generator):
        voxels[boxes, OUTER, :3] = torch.rand(len(boxes), 1, 3, generator=generator)
        voxels[boxes, OUTER, 3] = 0

    found = found_on(codec, "tee", thin)
    tone = found.tone[torch.isin(found.cell, boxes) & found.read]
    assert len(tone) == len(boxes)
    torch.testing.assert_close(tone[:, OUTER], tone[:, INNER].flip(1), atol=0.05, rtol=0)


def test_a_garment_that_no_box_shows_alone_is_not_drawn(codec):
    def bare(voxels, colours, _geometry, _generator):
        voxels[region_of(TOP).nonzero(), ~UPPER] = torch.cat([colours["skin"], torch.tensor([0.12])])

    found = found_on(codec, "tee", bare)
    assert all(found.read[found.surface == surface].any() for surface in range(len(found.condition)))


@pytest.mark.parametrize("known", [{"hair": "bald", "hat": "none"}, {}])
def test_people_without_known_surfaces_stay_as_they_are(surfaces, known):
    cells = torch.rand(1, K, VALUES)
    assert torch.equal(surfaces.draw(cells, WORDS.encode({"outfit": "jumper", **known})[None]), cells)


@pytest.mark.parametrize("density", [1.0, 0.0])
def test_patterned_garments_keep_their_pattern(surfaces, density):
    cells = torch.rand(1, K, VALUES)
    cells[..., 3 * S**3 : 4 * S**3] = density
    kind = WORDS.encode({"outfit": "tee", "pattern": "patterned", "hair": "bald", "hat": "none"})
    top = region_of(("torso",))
    assert torch.equal(surfaces.draw(cells, kind[None])[:, top], cells[:, top])


def test_prints_that_people_share_are_found(surfaces):
    assert len(surfaces.garment) == len(PRINTS)
    for garment in surfaces.garment:
        assert torch.equal(surfaces.condition[garment], WORDS.encode({"outfit": "tee", "pattern": "patterned"}))
    found = [
        over(surfaces.second[own], surfaces.cell[surfaces.box[own]])
        for own in (surfaces.printed == number for number in range(len(PRINTS)))
    ]
    for pattern in PRINTS:
        second = second_of(pattern)[region_of(TOP)].float()[:, None]
        errors = [float((one[region_of(TOP), FAR_OUT] - second).abs().max()) for one in found]
        assert min(errors) < 0.1


@pytest.mark.parametrize(("pattern", "hair"), [("stripes", "bald"), ("block", "bald"), ("stripes", "long")])
def test_a_mixture_of_prints_becomes_the_nearest_one(surfaces, pattern, hair):
    generator = torch.Generator().manual_seed(3)
    colours = some_colours(generator)
    mixed = voxels_of(dressed(hair, colours, generator, pattern)).clone()
    other = PRINTS[1 - PRINTS.index(pattern)]
    tee = region_of(TOP)
    if hair == "long":
        tee[below_hair()] = False
    mixed[tee, :, :3] = ((printed(colours, pattern, 0.7) + printed(colours, other, 0.4)) / 2)[tee, None]
    cells = torch.nn.functional.pad(mixed.mT.flatten(1), (0, 3), value=SCALE_VALUE)
    kind = WORDS.encode({"outfit": "tee", "pattern": "patterned", "hair": hair, "hat": "none"})
    drawn = voxels_of(surfaces.draw(cells[None], kind[None])[0])
    tone = torch.where(region_of(CUFFS)[tee], CUFF, 1.0)[:, None]
    second = second_of(pattern)[tee]
    before, after = (voxels[tee, FAR_OUT, :3].mean(1) / tone for voxels in (mixed, drawn))
    for part in (second, ~second):
        assert float(after[part].std(0).max()) < 0.02 < float(before[part].std(0).max())
    weaker, stronger = ((boxes[second].mean(0) - boxes[~second].mean(0)).norm() for boxes in (before, after))
    assert float(stronger) > float(weaker)
    torch.testing.assert_close(after.mean(0), before.mean(0), atol=0.02, rtol=0)


@pytest.mark.parametrize("pattern", PRINTS)
def test_a_print_goes_on_where_the_garment_meets_skin(surfaces, pattern):
    generator = torch.Generator().manual_seed(4)
    right = dressed("bald", some_colours(generator), generator, pattern)
    collar, wrong = region_of(COLLAR), voxels_of(right).clone()
    wrong[collar, :, :3] = torch.rand(int(collar.sum()), S**3, 3, generator=generator)
    wrong = torch.nn.functional.pad(wrong.mT.flatten(1), (0, 3), value=SCALE_VALUE)
    kind = WORDS.encode({"outfit": "tee", "pattern": "patterned", "hair": "bald", "hat": "none"})
    mended = surfaces.draw(wrong[None], kind[None])[0]
    for part in (UPPER, ~UPPER):
        error = (voxels_of(mended) - voxels_of(right))[collar][:, part, :3].abs()
        assert float(error.mean()) < 0.03


@pytest.mark.parametrize(("pattern", "even"), [("", True), *((pattern, False) for pattern in PRINTS)])
def test_plain_clothes_are_told_from_patterned_ones(surfaces, pattern, even):
    generator = torch.Generator().manual_seed(5)
    cells = dressed("bald", some_colours(generator), generator, pattern)
    cells = cells + 0.02 * torch.randn(cells.shape, generator=generator)
    kind = WORDS.encode({"outfit": "tee", "pattern": "plain", "hair": "long", "hat": "none"})
    assert surfaces.even(cells, kind, WORDS.encode({"pattern": "plain"})) == even
    assert not surfaces.even(cells, WORDS.encode({"outfit": "jumper", "pattern": "plain"}), kind)  # no garments known


def test_few_people_or_unknown_ones_have_no_surfaces(people, codec):
    few = people.geometry % GEOMETRIES == 1  # three geometries
    some = dataclasses.replace(
        people, latents=people.latents[few], geometry=people.geometry[few], condition=people.condition[few],
        detailed=few.sum(),
    )  # fmt: skip
    assert fit_surfaces(some, codec, WORDS, PriorConfig()) is None
    unknown = dataclasses.replace(people, condition=torch.zeros_like(people.condition))
    assert fit_surfaces(unknown, codec, WORDS, PriorConfig()) is None


def skirt_of(skirt=0, between=0, dense=1.0, size=1.0):
    """Fields of one box of a skirt."""
    numbers = {"skirt": torch.tensor([skirt]), "between": torch.tensor([between])}
    return {**numbers, "dense": torch.full((1, S**3), dense), "size": torch.full((1, 3), size)}


def model_with_surfaces():
    """Women in jeans, who have a surface, and men in suits."""
    model = model_of_two_kinds()
    generator = torch.Generator().manual_seed(0)
    share, tone = (torch.rand(5, S**3, generator=generator) for _ in range(2))
    read = torch.tensor([True, True, True, False, False])
    surfaces = Surfaces(
        torch.tensor([[1.0, 0, 1, 0]]), torch.tensor([True]), torch.zeros(5, dtype=torch.int64), torch.arange(40, 45),
        share, BRIGHTEST * tone, read, torch.ones_like(read),
        torch.zeros(1, dtype=torch.int64), torch.zeros(2, dtype=torch.int64),
        torch.arange(2), torch.rand(2, S**3, generator=generator), **optional_fields(),
    )  # fmt: skip
    return dataclasses.replace(model, surfaces=surfaces), surfaces


def test_decoding_recolours_people_who_have_the_surface():
    model, _ = model_with_surfaces()
    prior = model.denoiser.prior
    woman, man = (prior.join(c[None], torch.zeros(1, *model.codec.shape)) for c in prior.centre[0])
    plain = dataclasses.replace(model, surfaces=None)
    for x0, changes in ((woman, True), (man, False)):
        before, after = plain.decode(x0[0]), model.decode(x0[0])
        assert torch.equal(before.density, after.density)
        changed = (before.rgb != after.rgb).flatten(1).any(1)
        assert bool(changed[40:45].any()) == changes
        assert not changed[:40].any()
    both = model.decode(torch.stack([woman, man]))  # any leading dimensions
    assert both.rgb.shape == (2, 1, K, 3, S, S, S)
    assert torch.equal(both.rgb[1, 0], model.decode(man[0]).rgb)


@pytest.mark.parametrize("brightness", [-0.4, 0.3])
def test_what_goes_with_hair_goes_with_the_hair_that_is_drawn(brightness):
    model, surfaces = model_with_surfaces()
    codec, prior = model.codec.codec, model.denoiser.prior
    woman = prior.kind[0, 0]

    def grey(level):  # all boxes alike, as the components have them
        return prior.join(torch.full((1, 3), float(level)), torch.zeros(1, *model.codec.shape))

    darker, lighter = (surfaces.natural_colours(codec.decode(grey(level))[0], woman)[0].mean() for level in (0, 1))
    level, drawn_level = ((colour - darker) / (lighter - darker) for colour in (brightness, max(brightness, BLACK)))
    drawn, wanted = model.decode(grey(level)[0], woman[None]), model.codec.to_payload(grey(drawn_level)[0], 100.0)
    torch.testing.assert_close(drawn.rgb[:40], wanted.rgb[:40], atol=2e-3, rtol=0)
    cells = codec.decode(grey(level))[0].requires_grad_()
    (slope,) = torch.autograd.grad(surfaces.natural_colours(cells, woman)[0].sum(), cells)
    assert slope[:, : 3 * S**3].any()
    assert not slope[:, 3 * S**3 :].any()  # of colours alone


def test_what_is_generated_has_the_colours_that_people_have_as_often_as_they_have_them():
    model, surfaces = model_with_surfaces()
    codec, prior = model.codec.codec, dataclasses.replace(model.denoiser.prior, variance=torch.full((1, 3), 60.0**2))
    model.denoiser.load_state_dict({"prior_variance": prior.variance}, strict=False)
    generator = torch.Generator().manual_seed(0)

    def brightness(latents):
        return torch.stack([surfaces.colours(codec.decode(one[None])[0], prior.kind[0, 0])[0] for one in latents])

    rest = torch.zeros(40, *model.codec.shape)
    levels = prior.centre[0, 0] + torch.where(torch.arange(40) < 10, 150.0, -150.0)[:, None]
    people = LatentSet(prior.join(levels, rest).half(), torch.arange(40), torch.zeros(40, 10),
                       prior.kind[0, :1].expand(40, -1), torch.tensor(40))  # fmt: skip
    dark, light = brightness(people.latents.float())[[39, 0]]
    model = dataclasses.replace(model, surfaces=with_colour_pairs(surfaces, people, codec, prior, generator))
    drawn = torch.cat([prior.sample(1, generator, prior.kind[0, :1]) for _ in range(80)])
    made = brightness(model.with_peoples_colours(drawn))
    off = torch.stack([(made - each).abs().amax(1) for each in (dark, light)])
    assert float(off.amin(0).quantile(0.9)) < 0.1 * float((light - dark).mean())
    assert float((off[1] < off[0]).float().mean()) == pytest.approx(0.25, abs=0.1)
    (person,), moved = decode_humans(model, drawn[:1], [0]), model.with_peoples_colours(drawn[:1])[0]
    assert torch.equal(person.payload.rgb, model.decode(moved).rgb)
    assert not torch.equal(person.payload.rgb, model.decode(drawn[0]).rgb)  # people who are encoded stay as they are
    few = dataclasses.replace(people, detailed=torch.tensor(3))
    assert not len(with_colour_pairs(surfaces, few, codec, prior, generator).paired)


def test_surfaces_are_stored_in_bytes(tmp_path):
    model, surfaces = model_with_surfaces()
    face = {"face": torch.arange(2), "features": torch.rand(2, S**3, 3), "by_skin": BRIGHTEST * torch.rand(2, S**3)}
    share = surfaces.share.index_fill(0, torch.tensor([1, 3]), 1.0)
    pairs = {"paired": torch.zeros(1, dtype=torch.int64), "sampled": torch.ones(1, 3), "worn": torch.zeros(1, 3)}
    surfaces = dataclasses.replace(surfaces, share=share, **face, **skirt_of(dense=0.3, size=1.7), **pairs)
    save_checkpoint(tmp_path / "model.safetensors", dataclasses.replace(model, surfaces=surfaces), "linear")
    loaded = load_checkpoint(tmp_path / "model.safetensors").surfaces
    assert loaded is not None
    for name, value in vars(surfaces).items():
        off = 0.5 * LARGEST[name] / 255 + 1e-6 if name in LARGEST else 0
        torch.testing.assert_close(getattr(loaded, name), value, atol=off, rtol=0)


def test_earlier_checkpoints_have_neither_faces_nor_skirts():
    model, surfaces = model_with_surfaces()
    tensors = store_surfaces({f"surfaces.{name}": value for name, value in vars(surfaces).items()})
    earlier = {name.removeprefix("surfaces."): value for name, value in tensors.items()}
    for name in ("whole", *optional_fields()):
        del earlier[name]
    loaded = restore_surfaces(earlier, model.vocabulary)
    assert loaded is not None
    assert not len(loaded.face) + len(loaded.skirt)
    for damage in ({"whole": torch.ones(4)}, {"whole": torch.ones(5)}, {"share": torch.zeros(5, 3)}):
        with refused(ValueError, "share"):
            restore_surfaces({**earlier, **damage}, model.vocabulary)


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        ({"cell": torch.arange(K, K + 5)}, "cell"),
        ({"cell": torch.arange(4)}, ""),
        ({"natural": torch.ones(2, dtype=torch.bool)}, "natural"),
        ({"surface": torch.ones(5, dtype=torch.int64)}, "surface"),
        ({"condition": torch.ones(1, 3)}, "described"),
        ({"share": torch.full((5, S**3), 1.5)}, "share"),
        ({"tone": torch.full((5, S**3), -0.5)}, "tone"),
        ({"garment": torch.ones(1, dtype=torch.int64)}, "garment"),
        ({"printed": torch.tensor([0, -1])}, "printed"),
        ({"box": torch.tensor([0, 5])}, "box"),
        ({"second": torch.full((2, S**3), 1.5)}, "second"),
        ({"face": torch.zeros(1, dtype=torch.int64)}, "f"),
        ({"skin": -torch.ones(2, 3)}, "skin"),
        ({"paired": torch.ones(0, dtype=torch.int64), "worn": torch.ones(1, 3)}, "worn"),
        ({"paired": torch.ones(1, dtype=torch.int64), "worn": torch.ones(1, 3), "sampled": torch.ones(1, 3)}, "paired"),
        (skirt_of(skirt=1), "skirt"),
        (skirt_of(between=K), "between"),
        (skirt_of(dense=1.5), "dense"),
        (skirt_of(size=5.0), "size"),
    ],
)
def test_surfaces_that_do_not_fit_are_refused(damage, named):
    model, surfaces = model_with_surfaces()
    with refused(ValueError, named):
        check_surfaces(dataclasses.replace(surfaces, **damage), model.vocabulary)
