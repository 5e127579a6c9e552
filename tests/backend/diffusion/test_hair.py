"""Styles of hair: found in people whose hair is known, drawn in one colour, stored in bytes."""

import dataclasses

import pytest
import torch
from primdiffusion.diffusion.checkpoint import load_checkpoint, save_checkpoint
from primdiffusion.diffusion.codec import SCALE_VALUE, VALUES, LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.hair import BRIGHTEST, HairStyles, voxels_of
from primdiffusion.diffusion.model import check_hair
from primdiffusion.editing.regions import region_of
from primdiffusion.primitives.primitives import K, S
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.hair_styles import fit_hair_styles
from primdiffusion.training.latents import LatentSet
from support.errors import refused
from support.tiny import model_of_two_kinds

WORDS = AttributeVocabulary({"hair": ("bald", "long", "short"), "hat": ("cap", "none")}, {})
GEOMETRIES, COLOURINGS = 8, 6
OUTER, INNER = slice(S**3 // 2, S**3), slice(0, S**3 // 2)
"""Halves of a box, away from the body and near it."""
FAR_OUT, FAR_IN = slice(S**3 // 2 + S**2, S**3), slice(0, S**3 // 2 - S**2)
"""Without the layers next to the other half, which smoothing reaches."""
DARKER = 0.6
"""Tone of hair that hangs."""


@pytest.fixture(scope="module")
def codec():
    """Without loss for boxes whose halves have one colour and density each."""
    basis = torch.zeros(2, 4, 4, S**3)
    for half, voxels in enumerate((INNER, OUTER)):
        basis[half, torch.arange(4), torch.arange(4), voxels] = (S**3 / 2) ** -0.5
    basis = torch.nn.functional.pad(basis.flatten(2).flatten(0, 1), (0, 3))
    mean = torch.nn.functional.pad(torch.zeros(K, VALUES - 3), (0, 3), value=SCALE_VALUE)
    return LinearCodec(mean, basis[None], torch.ones(1, 8), torch.zeros(K, dtype=torch.int64))


@pytest.fixture(scope="module")
def people(codec):
    """Hair on the outer half of each box of the hair, and long hair on that of each box of the torso."""
    generator = torch.Generator().manual_seed(1)
    cells, conditions = [], []
    names = ["long"] * GEOMETRIES + ["short"] * GEOMETRIES + ["bald"] * 2
    for geometry, name in enumerate(names):
        for _ in range(COLOURINGS):
            hair, skin, shirt = (0.15 + 0.7 * torch.rand(3, generator=generator) for _ in range(3))
            cells.append(dressed(name, hair, (skin + hair) / 2, shirt))
            hat = "cap" if geometry == 0 else "none"
            conditions.append(WORDS.encode({"hair": name, "hat": hat}))
    geometry = torch.arange(len(names)).repeat_interleave(COLOURINGS)
    latents = codec.encode(torch.stack(cells)).half()
    count = torch.tensor(len(latents))
    return LatentSet(latents, geometry, torch.zeros(len(names), 10), torch.stack(conditions), count)


def dressed(name, hair, skin, shirt, hanging=None):
    """Cells of a person; `hanging` is another colour of the hair on the torso."""
    voxels = torch.zeros(K, S**3, 4)
    voxels[..., :3], voxels[..., 3] = skin, 1.0
    voxels[region_of(("torso", "hips", "arms")), :, :3] = shirt
    if name != "bald":
        voxels[region_of(("hair",)), OUTER, :3] = hair
    if name == "long":
        voxels[region_of(("torso",)), OUTER, :3] = DARKER * hair if hanging is None else hanging
    return torch.nn.functional.pad(voxels.mT.flatten(1), (0, 3), value=SCALE_VALUE)


@pytest.fixture(scope="module")
def styles(people, codec):
    return fit_hair_styles(people, codec, WORDS, PriorConfig())


def within(share, cells, region, voxels):
    """Values of a region's boxes."""
    return share[region_of((region,))[cells], voxels]


def test_hair_is_found_where_people_of_a_style_have_it(styles):
    long, short = styles.condition.argmax(1).tolist().index(1), styles.condition.argmax(1).tolist().index(2)
    assert len(styles.condition) == 2
    assert torch.equal(styles.condition[long], WORDS.encode({"hair": "long", "hat": "none"}))
    for style in (long, short):
        assert float(within(styles.share[style], styles.cells, "hair", FAR_OUT).min()) > 0.9
        assert float(within(styles.share[style], styles.cells, "hair", FAR_IN).max()) < 0.1
    assert float(within(styles.share[long], styles.cells, "torso", FAR_OUT).min()) > 0.9
    assert float(within(styles.share[long], styles.cells, "torso", FAR_IN).max()) < 0.1
    assert not within(styles.share[short], styles.cells, "torso", FAR_OUT).any()
    assert not region_of(("legs", "hands"))[styles.cells].any()
    tone = within(styles.tone[long], styles.cells, "torso", FAR_OUT)
    torch.testing.assert_close(tone, torch.full_like(tone, DARKER), atol=0.03, rtol=0)


def test_hair_that_took_the_shirt_s_colour_gets_that_of_the_head(styles):
    hair, skin, shirt = torch.tensor([0.5, 0.3, 0.1]), torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.1, 0.8, 0.9])
    right, tinted = (dressed("long", hair, skin, shirt, hanging) for hanging in (None, (hair + shirt) / 2))
    asked = WORDS.encode({"hair": "long", "hat": "none"})[None]
    mended = styles.recolour(tinted[None], styles.of_people(asked))[0]
    torso = region_of(("torso",))

    def error(cells):
        return float((voxels_of(cells) - voxels_of(right))[torso, FAR_OUT, :3].abs().mean())

    assert error(mended) < 0.15 * error(tinted)
    others = ~(torso | region_of(("head",)))
    assert torch.equal(mended[others], tinted[others])
    assert torch.equal(voxels_of(mended)[..., 3], voxels_of(tinted)[..., 3])


@pytest.mark.parametrize("known", [{"hair": "bald", "hat": "none"}, {"hair": "long", "hat": "cap"}, {}])
def test_people_without_a_known_style_stay_as_they_are(styles, known):
    cells = torch.rand(1, K, VALUES)
    style = styles.of_people(WORDS.encode(known)[None])
    assert style.tolist() == [-1]
    assert torch.equal(styles.recolour(cells, style), cells)


def test_too_few_people_have_no_style(people, codec):
    few = torch.isin(people.geometry, torch.tensor([1, 2, 3, 9, 10, 11]))
    some = dataclasses.replace(
        people, latents=people.latents[few], geometry=people.geometry[few], condition=people.condition[few],
        detailed=few.sum(),
    )  # fmt: skip
    assert fit_hair_styles(some, codec, WORDS, PriorConfig()) is None
    assert fit_hair_styles(people, codec, WORDS, PriorConfig(hair="nothing")) is None


def styled_model():
    """Women in jeans, whose hair is known, and men in suits."""
    model = model_of_two_kinds()
    generator = torch.Generator().manual_seed(0)
    share, tone = (torch.rand(1, 5, S**3, generator=generator) for _ in range(2))
    head = torch.tensor([True, True, True, False, False])
    hair = HairStyles(torch.tensor([[1.0, 0, 1, 0]]), torch.arange(40, 45), head, share, BRIGHTEST * tone)
    return dataclasses.replace(model, hair=hair)


def test_decoding_recolours_people_who_show_the_style():
    model = styled_model()
    assert isinstance(model.denoiser, PersonDenoiser)
    prior = model.denoiser.prior
    woman, man = (prior.join(c[None], torch.zeros(1, *model.codec.shape)) for c in prior.centre[0])
    plain = dataclasses.replace(model, hair=None)
    for x0, changes in ((woman, True), (man, False)):
        before, after = plain.decode(x0[0]), model.decode(x0[0])
        assert torch.equal(before.density, after.density)
        changed = (before.rgb != after.rgb).flatten(1).any(1)
        assert bool(changed[40:45].any()) == changes
        assert not changed[:40].any()
    both = model.decode(torch.stack([woman, man]))  # any leading dimensions
    assert both.rgb.shape == (2, 1, K, 3, S, S, S)
    assert torch.equal(both.rgb[1, 0], model.decode(man[0]).rgb)


def test_styles_are_stored_in_bytes(tmp_path):
    model = styled_model()
    save_checkpoint(tmp_path / "model.safetensors", model, "linear")
    loaded, hair = load_checkpoint(tmp_path / "model.safetensors").hair, model.hair
    assert loaded is not None
    assert hair is not None
    torch.testing.assert_close(loaded.share, hair.share, atol=0.5 / 255 + 1e-6, rtol=0)
    torch.testing.assert_close(loaded.tone, hair.tone, atol=0.5 * BRIGHTEST / 255 + 1e-6, rtol=0)
    for name in ("condition", "cells", "head"):
        assert torch.equal(getattr(loaded, name), getattr(hair, name))


@pytest.mark.parametrize(
    "damage",
    [
        {"cells": torch.arange(K, K + 5)},
        {"cells": torch.arange(4)},
        {"condition": torch.ones(1, 3)},
        {"share": torch.full((1, 5, S**3), 1.5)},
        {"tone": torch.full((1, 5, S**3), -0.5)},
    ],
)
def test_styles_that_do_not_fit_are_refused(damage):
    model = styled_model()
    assert model.hair is not None
    with refused(ValueError):
        check_hair(dataclasses.replace(model.hair, **damage), model.vocabulary)
