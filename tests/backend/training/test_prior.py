"""The prior fitted to latents: person components, and the mixture of their kinds."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from primdiffusion.diffusion.codec import mirror_cells
from primdiffusion.diffusion.conditioning import NOTHING, AttributeVocabulary
from primdiffusion.diffusion.gaussian import IMPOSSIBLE, PersonComponents
from primdiffusion.people.stored_people import find_payloads
from primdiffusion.primitives.primitives import GRID
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import split_people
from primdiffusion.training.mixture import fit_mixture
from primdiffusion.training.prior import fit_prior
from primdiffusion.training.regression import regress_cells


def test_the_prior_s_components_are_even_or_odd_in_the_mirror(prepared_once):
    _, prepared = prepared_once
    prior, codec = prepared.prior, prepared.codec
    pictures = prior.picture(torch.eye(len(prior.parity)))
    varying = prior.marginal_variance() > 1e-3  # people of few kinds leave some components without variance
    assert varying.sum() >= 12
    mirrored = pictures * prior.parity[:, None, None, None]
    assert torch.allclose(codec.mirror(pictures)[varying], mirrored[varying], atol=1e-3)
    rows = pictures.flatten(1)
    assert torch.allclose(rows @ rows.T, torch.eye(len(rows)), atol=1e-4)
    assert torch.allclose(codec.mirror(prior.mean), prior.mean, atol=1e-3)
    assert torch.allclose(mirror_cells(codec.mean), codec.mean, atol=1e-3)


def test_the_prior_describes_the_people_it_was_fitted_to(prepared_once):
    _, prepared = prepared_once
    z = prepared.train.latents.float()
    energy = (z - prepared.prior.mean).square().sum((1, 2, 3)).mean()
    described = prepared.prior.marginal_variance().sum() + prepared.prior.rest_variance.sum()
    assert described.item() == pytest.approx(energy.item(), rel=0.2)  # less what F tests doubt
    assert prepared.prior.log_weight.shape == (2, 1)


def test_shapes_learn_what_the_person_shows(prepared_once):
    # the first beta of these people sets their density, so it can be read off them; the others are constant
    _, prepared = prepared_once
    held, prior = prepared.held, prepared.prior
    first = torch.searchsorted(held.geometry, torch.arange(len(held.betas)))
    features = prior.split(held.latents[first].float())[0] / prior.marginal_variance().sqrt()
    left = prepared.shapes.scale @ prepared.shapes.scale.T
    assert features.shape[1] == prepared.shapes.weight.shape[1]
    assert left[0, 0] < 0.8 * prepared.train.betas[:, 0].var()


def test_person_components_live_in_the_leading_channels_alone(prepared_once):
    config, prepared = prepared_once
    z = prepared.train.latents[:8].float()
    prior = fit_prior(
        prepared.train, prepared.codec, prepared.vocabulary, dataclasses.replace(config.prior, channels=2)
    )
    assert prior.basis.shape[1:] == (GRID * GRID, 2)
    coefficients, rest = prior.split(z)
    assert torch.equal(rest[:, 2:], z[:, 2:] - prior.mean[2:])
    assert torch.allclose(prior.join(coefficients, rest), z, atol=1e-4)
    assert (prior.split(prior.join(coefficients, torch.zeros_like(rest)))[0] - coefficients).abs().max() < 1e-3


def test_held_out_geometries_are_never_trained_on(people):
    paths = find_payloads(people)
    train_paths, held = split_people(paths, 0.2, seed=0)
    assert len(held) == 3
    assert set(train_paths).isdisjoint(held)
    assert sorted(train_paths + held) == paths
    assert split_people(paths, 0.2, seed=0) == (train_paths, held)
    assert split_people(paths, 0.2, seed=1)[1] != held


WORDS = AttributeVocabulary(
    {
        "sex": ("female", "male"),
        "outfit": ("dress", "jeans"),
        "hair": ("bob", "crew", "long"),
        "shoes": ("boots", "pumps"),
    },
    {"height": (1.7, 0.1)},
)
CONFIG = PriorConfig(shrinkage=0.4, axes=4, shared=1)
ONE_EACH = PersonComponents(torch.zeros(1, 1, 7), torch.ones(1, 7, 1), torch.arange(7), torch.ones(7))
"""A component for each of seven cells."""
DRESS = {"sex": "female", "outfit": "dress"}
PEOPLE = [
    *[{**DRESS, "hair": "bob", "shoes": "boots"}] * 300,
    *[{**DRESS, "hair": "long", "shoes": "boots"}] * 100,
    *[{"sex": "female", "outfit": "jeans", "hair": "bob", "shoes": "pumps"}] * 200,
    *[{"sex": "male", "outfit": "jeans", "hair": "crew", "shoes": "boots"}] * 400,
]
CLOTHES = 5
"""Components of the clothes; of the other two, the first is the hands' and the second the head's."""


def components(spread=0.1):
    """Of PEOPLE: the outfit moves the first, long hair the second, pumps the third; jeans vary in the fourth, and long
    hair in the last. A tone of the skin is in the hands, in the head and, of dresses alone, in the fifth."""
    generator = torch.Generator().manual_seed(0)
    c = spread * torch.randn(len(PEOPLE), CLOTHES + 2, generator=generator)
    for row, skin, person in zip(c, torch.randn(len(PEOPLE), generator=generator), PEOPLE, strict=True):
        row[0] += 10 * (person["outfit"] == "jeans")
        row[1] += 5 * (person["hair"] == "long")
        row[2] += 3 * (person["shoes"] == "pumps")
        row[3] *= 20 if person["outfit"] == "jeans" else 1
        row[6] *= 10 if person["hair"] == "long" else 1
        row[4] += 2 * skin * (person["outfit"] == "dress")
        row[5:] += torch.stack([skin, 3 * skin])
    return c


def fitted(people, c, config=CONFIG, **counted):
    condition = torch.stack([WORDS.encode({**person, "height": 1.7}) for person in people])
    return SimpleNamespace(**fit_mixture(c, CLOTHES, condition, WORDS, config, ONE_EACH, **counted))


@pytest.fixture(scope="module")
def mixture():
    return fitted(PEOPLE, components())


def part(mixture, **asked):
    """Where the part of a kind is."""
    wanted = WORDS.encode(asked)
    places = ((mixture.kind * wanted).sum(-1) == len(asked)).nonzero().tolist()
    assert len(places) == 1
    return tuple(places[0])


def test_kinds_are_all_that_can_be_put_together_and_weights_sum_to_one(mixture):
    real = mixture.log_weight > IMPOSSIBLE / 2
    assert mixture.log_weight.exp().sum().item() == pytest.approx(1, abs=1e-5)
    # two outfits of women with two hair styles, one of men; two pairs of shoes each
    assert real.sum() == 2 * 2 * 2 + 1 * 2
    assert mixture.log_weight.shape == (3, 4)
    assert not mixture.kind[..., WORDS.blocks()["hair"]][~real].any()


def test_no_human_gets_the_hair_of_the_other_sex(mixture):
    male, crew = WORDS.encode({"sex": "male"}), WORDS.encode({"hair": "crew"})
    assert torch.equal((mixture.kind @ male).bool(), (mixture.kind @ crew).bool())


def test_an_unseen_kind_is_the_sum_of_the_effects_of_its_attributes(mixture):
    # nobody wears jeans and pumps with long hair
    new = part(mixture, sex="female", outfit="jeans", hair="long", shoes="pumps")
    assert torch.allclose(mixture.centre[new][:3], torch.tensor([10.0, 5.0, 3.0]), atol=0.8)
    seen = part(mixture, **DRESS, hair="bob", shoes="boots")
    assert torch.allclose(mixture.centre[seen][:3], torch.zeros(3), atol=0.3)


def test_shares_are_those_of_the_people_given_the_sex(mixture):
    share = mixture.log_weight[part(mixture, **DRESS, hair="long", shoes="boots")].exp().item()
    women_with_long_hair, with_boots = 100 / 600, 800 / 1000
    assert share == pytest.approx(0.4 * women_with_long_hair * with_boots, rel=1e-4)


def test_further_people_do_not_make_their_kind_more_frequent(mixture):
    further = [{"sex": "male", "outfit": "jeans", "hair": "crew", "shoes": "pumps"}] * 300
    c = torch.cat([components(), torch.zeros(300, CLOTHES + 2)])
    both = fitted([*PEOPLE, *further], c, counted=len(PEOPLE))
    torch.testing.assert_close(both.log_weight.exp(), mixture.log_weight.exp())
    unseen = fitted([*further, *PEOPLE[::-1]], c.flip(0), counted=300)
    assert unseen.log_weight.exp()[part(unseen, **further[0])] == pytest.approx(1)
    assert (unseen.log_weight > IMPOSSIBLE / 2).sum() == 1


def test_groups_keep_their_own_variance(mixture):
    spread = [
        variances(mixture.axes[group], mixture.variance[group], mixture.left[group])[3]
        for group in (part(mixture, **DRESS, hair="bob", shoes="boots")[0],
                      part(mixture, sex="male", outfit="jeans", hair="crew", shoes="boots")[0])
    ]  # fmt: skip
    assert spread[1].item() == pytest.approx(4.0, rel=0.3)
    assert spread[0] < 0.1


def variances(axes, variance, left):
    return torch.einsum("i,ij,ij->j", variance - left, axes, axes) + left


def test_heads_keep_the_variance_of_their_hair(mixture):
    spread = []
    for hair in ("long", "bob"):
        head = mixture.head[part(mixture, **DRESS, hair=hair, shoes="boots")]
        own = variances(mixture.head_axes[head], mixture.head_variance[head], mixture.head_left[head])
        spread.append((own + mixture.head_shared[head, 1:].square().sum(0))[1])
    assert spread[0].item() == pytest.approx(1.0, rel=0.3)
    assert spread[1] < 0.2


def test_what_happens_to_go_with_hair_and_skin_does_not_colour_clothes():
    few = [{**DRESS, "hair": hair, "shoes": "boots"} for hair in ("bob",) * 20 + ("long",) * 5]
    c = torch.randn(len(few), CLOTHES + 2, generator=torch.Generator().manual_seed(1))
    mixture = fitted(few, c)
    bob, long = (part(mixture, **DRESS, hair=hair, shoes="boots") for hair in ("bob", "long"))
    by_chance = (c[20:] - c[:20].mean(0)).mean(0)[:CLOTHES].square().sum()
    assert (mixture.centre[long] - mixture.centre[bob])[:CLOTHES].square().sum() < 0.3 * by_chance
    assert mixture.shared[0, 0, :CLOTHES].square().sum() < 0.2


def test_the_variance_is_that_of_the_people_however_little_of_it_is_explained():
    few = [{**DRESS, "hair": hair, "shoes": shoes} for hair in ("bob", "crew") for shoes in ("boots", "pumps")] * 10
    for seed in range(5):
        c = torch.randn(len(few), CLOTHES + 2, generator=torch.Generator().manual_seed(seed))
        mixture = fitted(few, c)
        weight = mixture.log_weight[0].exp()
        mean = weight @ mixture.centre[0]
        spread = weight @ (mixture.centre[0] - mean).square()[:, :CLOTHES] + mixture.shared[0].square().sum(0)
        spread += variances(mixture.axes[0], mixture.variance[0], mixture.left[0])
        assert spread.sum() == pytest.approx(c[:, :CLOTHES].square().mean(0).sum().item(), rel=0.1)


def test_the_other_sex_in_the_same_garments_counts_by_half():
    women, men = [PEOPLE[400]] * 10, [PEOPLE[-1]] * 40
    c = 0.01 * torch.randn(50, CLOTHES + 2, generator=torch.Generator().manual_seed(0))
    c[10:, 3] *= 200
    mixture = fitted(women + men, c, PriorConfig(shrinkage=0.0, axes=4, shared=1))
    women_s, men_s = (variances(mixture.axes[g], mixture.variance[g], mixture.left[g])[3].item() for g in range(2))
    assert women_s == pytest.approx(4 * 20 / (10 + 20), rel=0.3)
    assert men_s == pytest.approx(4 * 40 / (40 + 5), rel=0.3)


def test_few_patterned_people_do_not_lend_their_prints_to_many_plain_ones():
    words = AttributeVocabulary({"outfit": ("dress",), "pattern": ("patterned", "plain")}, {})
    people = [{"outfit": "dress", "pattern": "plain"}] * 60 + [{"outfit": "dress", "pattern": "patterned"}] * 20
    c = 0.01 * torch.randn(80, CLOTHES + 2, generator=torch.Generator().manual_seed(0))
    c[:, 0] += torch.randn(80, generator=torch.Generator().manual_seed(1))
    c[60:, 1] += 3 * torch.randn(20, generator=torch.Generator().manual_seed(2))
    condition = torch.stack([words.encode(person) for person in people])
    config = PriorConfig(shrinkage=1.0, axes=4, shared=1)
    mixture = SimpleNamespace(**fit_mixture(c, CLOTHES, condition, words, config, ONE_EACH))
    plain, patterned = (
        variances(mixture.axes[g], mixture.variance[g], mixture.left[g])[:2]
        for g in ((mixture.kind[:, 0] @ words.encode({"pattern": word})).argmax() for word in ("plain", "patterned"))
    )
    assert plain[0].item() == pytest.approx(1, rel=0.4)
    assert plain[1] < 0.05
    assert patterned[1] > 2


def test_details_of_others_are_lent_but_not_their_colours():
    # a dress is of one cloth; of jeans, two parts have colours of their own, and a fifth has detail
    women, men = [PEOPLE[400]] * 200, [{**DRESS, "hair": "bob", "shoes": "boots"}] * 12
    c = 0.01 * torch.randn(212, CLOTHES + 2, generator=torch.Generator().manual_seed(0))
    c[:200, :4] *= 300
    c[:200, 4] *= 50
    c[200:, :2] += 2 * torch.randn(12, 1, generator=torch.Generator().manual_seed(1))
    dress = fitted(women + men, c, PriorConfig(groups=("outfit", "sex"), shrinkage=10.0, axes=4, shared=1))
    g = part(dress, **DRESS, hair="bob", shoes="boots")[0]
    own = dress.axes[g].T @ torch.diag(dress.variance[g] - dress.left[g]) @ dress.axes[g]
    seam = torch.tensor([1.0, -1.0, 0.0, 0.0, 0.0])
    assert seam @ own @ seam + 2 * dress.left[g] < 0.05
    assert (own + dress.left[g] * torch.eye(CLOTHES))[4, 4].item() == pytest.approx(0.25 * 10 / 22, rel=0.3)


def test_skin_is_shared_by_hands_and_head_and_by_clothes_that_show_it(mixture):
    dress, jeans = (
        mixture.shared[part(mixture, sex="female", outfit=outfit, hair="bob", shoes="boots")[0], 0]
        for outfit in ("dress", "jeans")
    )
    heads = mixture.head_shared[:, 0]
    sign = heads[0, 0].sign()
    assert torch.allclose(sign * heads, torch.tensor([1.0, 3.0]).expand(3, -1), rtol=0.1)
    assert sign * dress[4] == pytest.approx(2.0, rel=0.1)
    assert jeans[4].abs() < 0.2
    g = part(mixture, **DRESS, hair="bob", shoes="boots")[0]
    own = variances(mixture.axes[g], mixture.variance[g], mixture.left[g])[4]
    assert own < 0.1, "the tone is in the shared direction alone: else dress and face would differ"
    assert mixture.axes.shape == (3, 4, CLOTHES)
    assert mixture.head_axes.shape == (3, 2, 2)


def test_hair_that_hangs_over_clothes_is_no_colour_of_theirs():
    c = components()
    long = torch.tensor([person["hair"] == "long" for person in PEOPLE])
    c[long, 2] += 20 * torch.randn(int(long.sum()), generator=torch.Generator().manual_seed(2))
    mixture = fitted(PEOPLE, c)
    for hair in ("bob", "long"):
        g, _ = part(mixture, **DRESS, hair=hair, shoes="boots")
        assert variances(mixture.axes[g], mixture.variance[g], mixture.left[g])[2] < 0.1
    everybody = [{**person, "hair": "long"} for person in PEOPLE]
    assert fitted(everybody, c).variance.isfinite().all()  # no bare clothes at all


def test_people_of_whom_nothing_is_known_are_one_gaussian():
    unknown = torch.zeros(len(PEOPLE), 0)
    mixture = SimpleNamespace(**fit_mixture(components(), CLOTHES, unknown, NOTHING, CONFIG, ONE_EACH))
    assert mixture.log_weight.shape == (1, 1)
    assert torch.allclose(mixture.centre[0, 0], components().mean(0), atol=0.1)


CELLS, CHANNELS = 3, 8
INSIDE = PersonComponents(
    torch.zeros(CHANNELS, 1, CELLS),
    torch.eye(CELLS * CHANNELS).unflatten(1, (CELLS, CHANNELS)),
    torch.zeros(CELLS, dtype=torch.int64),
    torch.ones(CELLS * CHANNELS),
)
"""A component for each channel of each of three cells."""


def people(count, seed):
    """The first cell follows the design, the second half, the third not at all."""
    generator = torch.Generator().manual_seed(seed)
    design = torch.randn(count, 2, generator=generator)
    effect = torch.randn(2, CELLS, CHANNELS, generator=generator) * torch.tensor([2.0, 0.5, 0.0])[:, None]
    noise = torch.randn(count, CELLS, CHANNELS, generator=generator)
    return (torch.einsum("nq,qkd->nkd", design, effect) + noise).flatten(1), design, effect.flatten(1)


def test_cells_that_follow_the_design_keep_their_effect_and_others_have_next_to_none():
    c, design, effect = people(60, 0)
    shown, _ = regress_cells(c, design, INSIDE)
    shown, effect = shown.unflatten(1, (CELLS, CHANNELS)), effect.unflatten(1, (CELLS, CHANNELS))
    assert (shown - effect)[:, 0].square().mean() < 0.03 * effect[:, 0].square().mean()
    plain = torch.linalg.lstsq(design, c).solution.unflatten(1, (CELLS, CHANNELS))
    assert shown[:, 2].square().sum() < 0.2 * plain[:, 2].square().sum()


def test_what_follows_the_design_is_gone_from_what_is_left_and_the_rest_stays():
    c, design, effect = people(400, 0)
    _, left = regress_cells(c, design, INSIDE)
    parts, truth = left.unflatten(1, (CELLS, CHANNELS)), c - design @ effect
    assert (design.T @ parts[:, 0] / 400).abs().max() < 0.05
    assert torch.allclose(left[:, :CHANNELS], truth[:, :CHANNELS], atol=0.5)
    assert left[:, 2 * CHANNELS :].var() == pytest.approx(1, abs=0.05)


def test_people_no_more_than_the_design_has_columns_show_nothing():
    c, design, _ = people(2, 0)
    shown, left = regress_cells(c, design, INSIDE)
    assert not shown.any()
    assert torch.equal(left, c)
