"""The prior fitted to latents."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from primdiffusion.diffusion.codec import mirror_cells
from primdiffusion.diffusion.conditioning import NOTHING, AttributeVocabulary
from primdiffusion.diffusion.gaussian import IMPOSSIBLE
from primdiffusion.people.stored_people import find_people
from primdiffusion.primitives.primitives import GRID
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import split_people
from primdiffusion.training.prior import fit_mixture, fit_prior


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
    assert described.item() == pytest.approx(energy.item(), rel=0.15)
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


def test_blurred_people_count_for_the_components_but_not_for_the_rest(prepared_once):
    config, prepared = prepared_once
    people = prepared.train
    blurred = dataclasses.replace(people, latents=people.latents.roll(1, 0) * 0.5)
    both = people.and_blurred(blurred, prepared.codec)
    assert len(both) == 2 * len(people)
    assert int(both.detailed) == len(people)
    assert torch.equal(both.geometry[len(people) :], people.geometry + len(people.betas))
    alone = fit_prior(people, prepared.codec, prepared.vocabulary, config.prior)
    prior = fit_prior(both, prepared.codec, prepared.vocabulary, config.prior)
    assert torch.allclose(prior.mean, alone.mean)
    z = people.latents.float()
    left = z - prior.mean - prior.picture(prior.split(z)[0])
    assert prior.rest_variance.sum() >= left.square().sum((1, 2, 3)).mean() * 0.99


def test_blurred_people_get_the_spread_of_detailed_ones(prepared_once):
    _, prepared = prepared_once
    people, codec = prepared.train, prepared.codec
    blurred = dataclasses.replace(people, latents=people.latents.flip(0) * 0.5 + 0.25)
    both = people.and_blurred(blurred, codec).latents.float()
    ours, theirs = both[: len(people)], both[len(people) :]
    pairs = [torch.cat([each, codec.mirror(each)]) for each in (ours, theirs)]
    assert torch.allclose(pairs[0].mean(0), pairs[1].mean(0), atol=0.02)
    assert torch.allclose(pairs[0].std(0), pairs[1].std(0), rtol=0.02, atol=0.02)


WORDS = AttributeVocabulary(
    {
        "sex": ("female", "male"),
        "outfit": ("dress", "jeans"),
        "hair": ("bob", "crew", "long"),
        "shoes": ("boots", "pumps"),
    },
    {"height": (1.7, 0.1)},
)


CONFIG = PriorConfig(lean=0.4, axes=4, shared=1)


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


@pytest.fixture(scope="module")
def mixture():
    condition = torch.stack([WORDS.encode({**person, "height": 1.7}) for person in PEOPLE])
    return SimpleNamespace(**fit_mixture(components(), CLOTHES, condition, WORDS, CONFIG))


def part(mixture, **asked):
    """Where the part of a kind is."""
    wanted = WORDS.encode(asked)
    places = ((mixture.kind * wanted).sum(-1) == len(asked)).nonzero().tolist()
    assert len(places) == 1
    return tuple(places[0])


def test_kinds_are_all_that_can_be_put_together_and_weights_sum_to_one(mixture):
    real = mixture.log_weight > IMPOSSIBLE / 2
    assert mixture.log_weight.exp().sum().item() == pytest.approx(1, abs=1e-5)
    # two groups of women with two hair styles, one of men with one; two pairs of shoes each
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
        spread.append(variances(mixture.head_axes[head], mixture.head_variance[head], mixture.head_left[head])[1])
    assert spread[0].item() == pytest.approx(1.0, rel=0.3)
    assert spread[1] < 0.2


def test_skin_is_shared_by_hands_and_head_and_by_clothes_that_show_it(mixture):
    dress, jeans = (
        mixture.shared[part(mixture, sex="female", outfit=outfit, hair="bob", shoes="boots")[0], 0]
        for outfit in ("dress", "jeans")
    )
    sign = dress[5].sign()
    assert torch.allclose(sign * dress[4:], torch.tensor([2.0, 1.0, 3.0]), rtol=0.1)
    assert jeans[4].abs() < 0.2
    assert torch.equal(jeans[5:], dress[5:])
    assert mixture.axes.shape == (3, 4, CLOTHES)
    assert mixture.head_axes.shape == (3, 2, 2)


def test_people_of_whom_nothing_is_known_are_one_gaussian():
    mixture = SimpleNamespace(**fit_mixture(components(), CLOTHES, torch.zeros(len(PEOPLE), 0), NOTHING, CONFIG))
    assert mixture.log_weight.shape == (1, 1)
    assert torch.allclose(mixture.centre[0, 0], components().mean(0), atol=0.1)


def test_held_out_geometries_are_never_trained_on(people):
    paths = find_people(people)
    train_paths, held = split_people(paths, 0.2, seed=0)
    assert len(held) == 3
    assert set(train_paths).isdisjoint(held)
    assert sorted(train_paths + held) == paths
    assert split_people(paths, 0.2, seed=0) == (train_paths, held)
    assert split_people(paths, 0.2, seed=1)[1] != held
