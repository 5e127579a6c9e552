"""Networks that others trained, for whoever has their weights: the layers, their names, what a wrong file says."""

import pytest
import torch
from primdiffusion.evaluation.clip_vision import ClipVision, load_clip_vision
from primdiffusion.evaluation.inception import Inception, averaged, load_inception
from primdiffusion.picture_features import WeightsFileError
from safetensors.torch import save_file


@pytest.fixture(scope="module")
def inception() -> Inception:
    torch.manual_seed(0)
    return Inception()


@pytest.fixture(scope="module")
def clip() -> ClipVision:
    torch.manual_seed(0)
    return ClipVision()


def test_inception_has_the_published_layers(inception):
    # torchvision's inception_v3 has 27,161,264 parameters; without its classifier and auxiliary head 21,785,568.
    assert sum(parameter.numel() for parameter in inception.parameters()) == 21_785_568
    names = inception.state_dict()
    assert names["Mixed_5b.branch5x5_2.conv.weight"].shape == (64, 48, 5, 5)
    assert names["Mixed_6e.branch7x7dbl_5.bn.running_var"].shape == (192,)
    assert names["Mixed_7c.branch3x3dbl_3b.conv.weight"].shape == (384, 384, 3, 1)


def test_clip_has_the_published_layers(clip):
    # The vision network of OpenAI's ViT-B/32 has 87,849,216 parameters.
    assert sum(parameter.numel() for parameter in clip.parameters()) == 87_849_216
    names = clip.state_dict()
    assert names["transformer.resblocks.11.attn.in_proj_weight"].shape == (2304, 768)
    assert names["transformer.resblocks.0.mlp.c_fc.weight"].shape == (3072, 768)
    assert names["positional_embedding"].shape == (50, 768)


def test_features_are_one_row_a_picture_and_see_differences(inception, clip):
    pictures = torch.rand(2, 64, 64, 3, generator=torch.Generator().manual_seed(0))
    for network, width in ((inception, 2048), (clip, 512)):
        features = network(pictures)
        assert features.shape == (2, width)
        size = float(features.norm())
        assert float((network(pictures[1:]) - features[1:]).norm()) < 1e-4 * size
        assert float((features[0] - features[1]).norm()) > 1e-3 * size


def test_averages_at_the_edge_are_of_the_neighbours_that_there_are():
    assert torch.allclose(averaged(torch.ones(1, 1, 5, 5)), torch.ones(1, 1, 5, 5))


def test_weights_come_from_files(inception, tmp_path):
    held = {name: value + 1 for name, value in inception.state_dict().items() if value.is_floating_point()}
    torch.save({**held, "fc.weight": torch.zeros(1008, 2048)}, tmp_path / "inception.pth")
    loaded = load_inception(tmp_path / "inception.pth")
    assert torch.equal(loaded.Conv2d_1a_3x3.conv.weight, inception.Conv2d_1a_3x3.conv.weight + 1)


def test_clip_is_found_in_a_file_with_the_text_network(clip, tmp_path):
    held = {f"visual.{name}": value.half().contiguous() for name, value in clip.state_dict().items()}
    save_file({**held, "token_embedding.weight": torch.zeros(4, 4)}, tmp_path / "clip.safetensors")
    assert torch.allclose(load_clip_vision(tmp_path / "clip.safetensors").proj, clip.proj, atol=1e-3)


@pytest.mark.parametrize("load", [load_inception, load_clip_vision])
def test_a_file_of_another_network_is_named(load, tmp_path):
    save_file({"layer.weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(WeightsFileError, match=r"other\.safetensors has no '"):
        load(tmp_path / "other.safetensors")
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.pth")
