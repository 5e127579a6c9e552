"""What a sample shows of the attributes that were asked for."""

import dataclasses

import pytest
import torch
from primdiffusion.diffusion.denoiser import DenoiserConfig, PersonDenoiser
from primdiffusion.diffusion.reading import unfollowed, warnings_of
from primdiffusion.editing.vary import vary
from primdiffusion.human import generate
from tiny_model import model_of_two_kinds

MODEL = model_of_two_kinds()


@pytest.mark.parametrize("seed", range(4))
def test_a_combination_that_no_training_human_has_is_named(seed):
    asked = {"sex": "female", "outfit": "suit"}
    made = generate(MODEL, seed, 3, attributes=asked).provenance
    assert made["unfollowed"] in ({"sex": "male"}, {"outfit": "jeans"})
    (warning,) = warnings_of(made)
    ((name, shown),) = made["unfollowed"].items()
    assert f"{name} {asked[name]!r} ({shown!r} instead)" in warning
    assert len(warning) < 300


@pytest.mark.parametrize("asked", [{}, {"sex": "male"}, {"sex": "female", "outfit": "jeans"}])
def test_what_was_followed_is_not_named(asked):
    made = generate(MODEL, 1, 3, attributes=asked).provenance
    assert "unfollowed" not in made
    assert warnings_of(made) == []


def test_a_variant_that_stays_as_it_was_is_named():
    woman = generate(MODEL, 1, 3, attributes={"sex": "female"})
    made = vary(MODEL, woman, 0.05, 2, 3, attributes={"sex": "male"}).provenance["edits"][-1]
    assert made["unfollowed"] == {"sex": "female"}
    assert "sex 'male' ('female' instead)" in warnings_of(made)[0]


def test_a_model_without_kinds_reads_nothing():
    x0 = torch.zeros(2, *MODEL.codec.shape)
    for denoiser in (torch.nn.Identity(), without_kinds()):
        model = dataclasses.replace(MODEL, denoiser=denoiser)
        assert unfollowed(model, x0, {"sex": "female"}) == [{}, {}]


def without_kinds() -> PersonDenoiser:
    prior = dataclasses.replace(MODEL.denoiser.prior, kind=torch.zeros(1, 2, 0))
    return PersonDenoiser(DenoiserConfig(person=None, local=None), prior, MODEL.schedule)
