import pytest
import torch
from diffusion_people import CHANNELS, COMPONENTS, SMALL, random_prior
from primdiffusion.diffusion.conditioning import NOTHING, AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser, step_features
from primdiffusion.diffusion.schedule import linear
from primdiffusion.diffusion.unet import PAPER, PAPER_WITH_ATTENTION, SlabUNet, UNetConfig
from support.errors import refused

GRID = 8


@pytest.mark.parametrize(("config", "parameters"), [(PAPER, 84_846_776), (PAPER_WITH_ATTENTION, 129_996_856)])
def test_paper_network_has_the_released_size(config, parameters):
    with torch.device("meta"):
        network = SlabUNet(config)
    assert sum(p.numel() for p in network.parameters()) == parameters


def test_paper_network_has_the_released_names():
    with torch.device("meta"):
        names = SlabUNet().state_dict().keys()
    assert len(names) == 298
    assert {
        "time_embed.0.weight",
        "input_blocks.0.0.weight",
        "input_blocks.1.0.in_layers.2.weight",
        "input_blocks.3.0.op.weight",
        "input_blocks.4.0.skip_connection.weight",
        "middle_block.1.transformer_blocks.0.attn2.to_k.weight",
        "middle_block.1.transformer_blocks.0.ff.net.0.proj.weight",
        "output_blocks.2.1.conv.weight",
        "output_blocks.11.0.out_layers.3.bias",
        "out.2.bias",
    } <= set(names)


def test_small_paper_network_runs_learns_and_starts_at_zero():
    network = SlabUNet(
        UNetConfig(slab_channels=3, width=32, multipliers=(1, 2), blocks=1, attention_levels=(1,), heads=2)
    )
    x, t = torch.randn(2, 3, 16, 16), torch.tensor([3, 700])
    assert network(x, t).abs().max() == 0
    network(x, t).sum().backward()
    assert network.out[2].weight.grad.abs().max() > 0


def test_step_features_are_cosines_then_sines():
    features = step_features(torch.tensor([0, 1]), 8)
    assert torch.equal(features[0], torch.tensor([1.0, 1, 1, 1, 0, 0, 0, 0]))
    assert features[1, 0].item() == pytest.approx(torch.tensor(1.0).cos().item())
    assert features[1, 4].item() == pytest.approx(torch.tensor(1.0).sin().item())


@pytest.fixture
def prior():
    return random_prior((CHANNELS, GRID, GRID), COMPONENTS, 2, 0, asked=2).to(dtype=torch.float32)


def test_the_prior_follows_a_state_that_is_loaded_after_its_first_use():
    first, second = (
        PersonDenoiser(None, random_prior((CHANNELS, GRID, GRID), COMPONENTS, 2, seed), linear()) for seed in (0, 1)
    )
    x, t = torch.randn(2, CHANNELS, GRID, GRID, dtype=torch.float64), torch.tensor([300, 700])
    assert not torch.allclose(first(x, t), second(x, t))
    first.load_state_dict(second.state_dict())
    assert torch.equal(first.prior.centre, second.prior.centre)
    assert torch.allclose(first(x, t), second(x, t))


@pytest.mark.parametrize("config", [SMALL, None])
def test_untrained_denoiser_is_the_closed_form(prior, config):
    denoiser = PersonDenoiser(config, prior, linear()).eval()
    x, t = 3 * torch.randn(5, CHANNELS, GRID, GRID), torch.tensor([0, 100, 400, 800, 999])
    expected = prior.denoise(x, *linear().levels(t, x))
    assert torch.allclose(denoiser(x, t), expected, atol=1e-5)


def test_corrections_vanish_with_the_noise(prior):
    torch.manual_seed(0)
    denoiser = PersonDenoiser(SMALL, prior, linear()).eval()
    torch.nn.init.normal_(denoiser.local.outer.weight)
    x = prior.sample(4, torch.Generator().manual_seed(0))
    with torch.no_grad():
        moved = [
            (denoiser(x, t) - prior.denoise(x, *linear().levels(t, x))).abs().mean().item()
            for t in (torch.full((4,), 0), torch.full((4,), 500))
        ]
    assert moved[0] < 0.1 * moved[1]


def test_gradients_reach_every_weight(prior):
    torch.manual_seed(0)
    denoiser = PersonDenoiser(SMALL, prior, linear())
    for parameter in denoiser.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    denoiser(torch.randn(2, CHANNELS, GRID, GRID), torch.tensor([50, 600]), torch.eye(2)).square().sum().backward()
    idle = [name for name, p in denoiser.named_parameters() if p.grad is None or p.grad.abs().max() == 0]
    assert idle == []


def test_asking_for_nothing_is_the_same_as_not_asking(prior):
    torch.manual_seed(0)
    denoiser = PersonDenoiser(SMALL, prior, linear()).eval()
    for parameter in denoiser.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    x, t = torch.randn(2, CHANNELS, GRID, GRID), torch.tensor([50, 600])
    with torch.no_grad():
        assert torch.equal(denoiser(x, t), denoiser(x, t, torch.zeros(2, 2)))
        assert not torch.allclose(denoiser(x, t), denoiser(x, t, torch.eye(2)))


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
        ({"hair": "mohawk"}, ("mohawk", "bald, bob, long")),
        ({"beard": "full"}, ("beard", "sex, hair, height")),
        ({"height": 2.5}, ("height is 2.5", "1.3 to 2.1")),
        ({"height": "tall"}, ("height is 'tall'",)),
        ({"height": float("nan")}, ("height",)),
    ],
)
def test_what_a_model_does_not_know_is_rejected_with_what_it_knows(asked, words):
    with refused(ValueError, *words):
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
