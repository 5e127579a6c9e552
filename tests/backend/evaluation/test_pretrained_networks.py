"""Networks that others trained, for whoever has their weights: the layers, their names, what a wrong file says."""

import pytest
import torch
from primdiffusion.evaluation.pretrained_networks import (
    VGG16,
    VGG19,
    ClipVision,
    Inception,
    PictureFeatures,
    average_pool,
    load_clip_vision,
    load_inception,
)
from primdiffusion.files.regular_files import FileError
from safetensors.torch import save_file
from support.errors import refused
from torch import nn
from torch.nn import functional

OPENAI = {
    "layers": "resblocks",
    "self_attn": "attn",
    "norm1": "ln_1",
    "norm2": "ln_2",
    "linear1": "mlp.c_fc",
    "linear2": "mlp.c_proj",
}


def published(clip: ClipVision) -> dict[str, torch.Tensor]:
    """The weights under the names of OpenAI's file."""
    state = clip.state_dict().items()
    return {"visual." + ".".join(OPENAI.get(part, part) for part in name.split(".")): value for name, value in state}


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
    names = published(clip)
    assert names["visual.transformer.resblocks.11.attn.in_proj_weight"].shape == (2304, 768)
    assert names["visual.transformer.resblocks.0.mlp.c_fc.weight"].shape == (3072, 768)
    assert names["visual.positional_embedding"].shape == (50, 768)


def test_a_block_of_clip_is_attention_then_a_perceptron_each_after_a_norm(clip):
    weights = {
        name.split("resblocks.0.")[1]: value for name, value in published(clip).items() if "resblocks.0." in name
    }

    def linear(x, name):
        return functional.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def norm(x, name):
        return functional.layer_norm(x, (768,), weights[f"{name}.weight"], weights[f"{name}.bias"])

    x = torch.randn(1, 5, 768, generator=torch.Generator().manual_seed(0))
    projected = functional.linear(norm(x, "ln_1"), weights["attn.in_proj_weight"], weights["attn.in_proj_bias"])
    query, key, value = projected.view(1, 5, 3, 12, 64).movedim(1, 3).unbind(1)
    attended = torch.softmax(query @ key.mT / 8, -1) @ value
    after = x + linear(attended.transpose(1, 2).reshape(1, 5, 768), "attn.out_proj")
    inner = linear(norm(after, "ln_2"), "mlp.c_fc")
    expected = after + linear(inner * torch.sigmoid(1.702 * inner), "mlp.c_proj")
    assert torch.allclose(clip.transformer.layers[0](x), expected, atol=1e-5)


def test_features_are_one_row_a_picture_and_see_differences(inception, clip):
    pictures = torch.rand(2, 64, 64, 3, generator=torch.Generator().manual_seed(0))
    for network, width in ((inception, 2048), (clip, 512)):
        features = network(pictures)
        assert features.shape == (2, width)
        size = float(features.norm())
        assert float((network(pictures[1:]) - features[1:]).norm()) < 1e-4 * size
        assert float((features[0] - features[1]).norm()) > 1e-3 * size


def test_averages_at_the_edge_are_of_the_neighbours_that_there_are():
    assert torch.allclose(average_pool(torch.ones(1, 1, 5, 5)), torch.ones(1, 1, 5, 5))


def test_weights_come_from_files(inception, tmp_path):
    held = {name: value + 1 for name, value in inception.state_dict().items() if value.is_floating_point()}
    torch.save({**held, "fc.weight": torch.zeros(1008, 2048)}, tmp_path / "inception.pth")
    loaded = load_inception(tmp_path / "inception.pth")
    assert torch.equal(loaded.Conv2d_1a_3x3.conv.weight, inception.Conv2d_1a_3x3.conv.weight + 1)


def test_clip_is_found_in_a_file_with_the_text_network(clip, tmp_path):
    held = {name: value.half().contiguous() for name, value in published(clip).items()}
    text = {"transformer.resblocks.0.ln_1.weight": torch.zeros(512), "positional_embedding": torch.zeros(77, 512)}
    save_file(held | text, tmp_path / "clip.safetensors")
    loaded = load_clip_vision(tmp_path / "clip.safetensors").state_dict()
    assert all(torch.allclose(loaded[name], value, atol=1e-3) for name, value in clip.state_dict().items())


@pytest.mark.parametrize("load", [load_inception, load_clip_vision])
def test_a_file_of_another_network_is_named(load, tmp_path):
    save_file({"layer.weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    with refused(FileError, "other.safetensors"):
        load(tmp_path / "other.safetensors")


def test_names_of_layers_follow_torchvision():
    convolutions = [
        i for i, layer in enumerate(PictureFeatures(VGG16, ["relu5_3"]).features) if isinstance(layer, nn.Conv2d)
    ]
    assert convolutions == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    taps = ["relu1_2", "relu2_2", "relu3_2", "relu4_2", "relu5_2"]
    assert PictureFeatures(VGG19, taps)._taps == [3, 8, 13, 22, 31]
    shapes = [tuple(seen.shape) for seen in PictureFeatures(VGG19, taps)(torch.zeros(1, 3, 32, 48))]
    assert shapes == [(1, 64, 32, 48), (1, 128, 16, 24), (1, 256, 8, 12), (1, 512, 4, 6), (1, 512, 2, 3)]
