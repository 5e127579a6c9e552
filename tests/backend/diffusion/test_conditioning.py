import pytest
import torch
from primdiffusion.diffusion.conditioning import NOTHING, AttributeVocabulary
from support.errors import refused

WORDS = AttributeVocabulary({"sex": ("female", "male"), "hair": ("bald", "bob", "long")}, {"height": (1.7, 0.1)})


def test_what_is_not_asked_for_is_zero():
    assert torch.equal(WORDS.encode({}), torch.zeros(7))
    assert WORDS.encode({"hair": "long"}).tolist() == [0, 0, 0, 0, 1, 0, 0]
    assert WORDS.encode({"sex": "female", "height": 1.8}).tolist() == pytest.approx([1, 0, 0, 0, 0, 1, 1])


def test_what_is_left_open_is_completed_and_what_is_asked_for_stays():
    asked = torch.stack([WORDS.encode({}), WORDS.encode({"hair": "bob", "height": 1.8})])
    drawn = WORDS.encode({"sex": "male", "hair": "long"}).expand(2, -1)
    expected = [{"sex": "male", "hair": "long"}, {"sex": "male", "hair": "bob", "height": 1.8}]
    assert torch.equal(WORDS.complete(asked, drawn), torch.stack([WORDS.encode(each) for each in expected]))


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"hair": "mohawk"}, "mohawk.*bald, bob, long"),
        ({"beard": "full"}, "beard.*sex, hair, height"),
        ({"height": 2.5}, r"height is 2.5.*1.3 to 2.1"),
        ({"height": "tall"}, "height is 'tall'"),
        ({"height": float("nan")}, "height"),
    ],
)
def test_what_a_model_does_not_know_is_rejected_with_what_it_knows(asked, words):
    with pytest.raises(ValueError, match=words):
        WORDS.encode(asked)
    with refused(ValueError, "nothing"):
        NOTHING.encode(asked)


def test_a_vocabulary_survives_json():
    assert AttributeVocabulary.from_json(WORDS.to_json()) == WORDS


@pytest.mark.parametrize("scalar", [[1e300, 0.1], [1.7, 0.0], [1.7, -1.0], [1.7, 1e300], [float("nan"), 0.1]])
def test_means_and_deviations_that_no_quantity_has_are_rejected(scalar):
    with refused(ValueError, "quantity"):
        AttributeVocabulary.from_json({"categories": {}, "scalars": {"height": scalar}})


def test_all_subsets_of_attributes_are_learnt():
    whole = WORDS.encode({"sex": "male", "hair": "bob", "height": 1.75}).expand(4000, -1)
    part = WORDS.forget(whole, 0.5, torch.Generator().manual_seed(0))
    kept = torch.stack([part[:, :2].sum(1), part[:, 2:5].sum(1), part[:, 5]], dim=1)
    assert set(kept.flatten().tolist()) == {0.0, 1.0}
    assert len({tuple(row) for row in kept.tolist()}) == 8
    assert 0.5 < (kept.sum(1) == 0).float().mean() < 0.7
    assert torch.equal(NOTHING.forget(torch.zeros(3, 0), 0.5, torch.Generator()), torch.zeros(3, 0))
