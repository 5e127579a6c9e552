"""The perceptual loss, on random weights in torchvision's layout."""

import pytest
import torch
from primdiffusion.evaluation.pretrained_networks import VGG16, VGG19, PictureFeatures, WeightsFileError
from primdiffusion.training.fit_perceptual import LAYERS, PerceptualLoss, load_perceptual


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A file as torchvision's: the whole network's features and a classifier."""
    torch.manual_seed(0)
    state = PictureFeatures(VGG19, ["relu5_4"]).state_dict()
    path = tmp_path_factory.mktemp("vgg") / "vgg19.pth"
    torch.save(state | {"classifier.0.weight": torch.zeros(3, 3)}, path)
    return path


def test_loss_is_the_weighted_mean_difference_of_features(weights):
    loss = load_perceptual(weights)
    image, target = torch.rand(2, 1, 16, 20, 3, generator=torch.Generator().manual_seed(1))
    state = torch.load(weights, weights_only=True)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    pair = (torch.cat([image, target]) - mean) / std
    x, terms = pair.movedim(-1, 1), []
    up_to_taps = ((0, 2), (5, 7), (10, 12), (14, 16, 19, 21), (23, 25, 28, 30))
    for weight, convolutions in zip((20, 5, 0.9, 0.5, 0.5), up_to_taps, strict=True):
        for number in convolutions:
            if number in (5, 10, 19, 28):
                x = torch.nn.functional.max_pool2d(x, 2)
            kernel, bias = (state[f"features.{number}.{kind}"] for kind in ("weight", "bias"))
            x = torch.nn.functional.conv2d(x, kernel, bias, padding=1).relu()
        terms.append(weight * (x[0] - x[1]).abs().mean())
    assert float(loss(image, target)) == pytest.approx(float(sum(terms)), rel=1e-5)


def test_gradients_reach_the_picture_and_no_weights(weights):
    loss = load_perceptual(weights)
    image = torch.rand(2, 16, 16, 3, requires_grad=True)
    target = torch.rand(2, 16, 16, 3, requires_grad=True)
    loss(image, target).backward()
    assert (image.grad.abs().amax((1, 2, 3)) > 0).all()
    assert target.grad is None
    assert not any(parameter.requires_grad for parameter in loss.parameters())


def test_equal_pictures_cost_nothing_and_noise_costs_more(weights):
    loss = load_perceptual(weights)
    target, noise = torch.rand(16, 16, 3), torch.randn(16, 16, 3)
    near, far = (loss(target + amount * noise, target) for amount in (0.01, 0.1))
    assert float(loss(target, target)) == 0 < float(near) < float(far)


def test_a_descent_on_the_loss_finds_the_target(weights):
    loss = load_perceptual(weights, LAYERS[:2], (1.0, 1.0))
    target = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(2))
    image = torch.full_like(target, 0.5).requires_grad_()
    optimiser = torch.optim.Adam([image], 0.05)
    before = float((0.5 - target).abs().mean())
    for _ in range(30):
        optimiser.zero_grad()
        loss(image, target).backward()
        optimiser.step()
    assert float((image.detach() - target).abs().mean()) < 0.6 * before


def test_only_the_layers_asked_for_are_computed(weights):
    assert len(load_perceptual(weights, ["relu2_2"], [1.0]).network.features) == 9


def test_a_file_of_another_network_is_refused(tmp_path):
    torch.save(PictureFeatures(VGG16, ["relu5_3"]).state_dict(), tmp_path / "vgg16.pth")
    with pytest.raises(WeightsFileError, match=r"vgg16\.pth has .*VGG19"):
        load_perceptual(tmp_path / "vgg16.pth")


def test_weights_that_are_not_finite_are_refused(weights, tmp_path):
    state = torch.load(weights, weights_only=True)
    state["features.0.bias"][0] = torch.nan
    torch.save(state, tmp_path / "nan.pth")
    with pytest.raises(WeightsFileError, match=r"features\.0\.bias.* has NaN"):
        load_perceptual(tmp_path / "nan.pth")


def test_wrong_requests_say_what_to_give(weights, tmp_path):
    with pytest.raises(FileNotFoundError, match="check the path"):
        load_perceptual(tmp_path / "none.pth")
    with pytest.raises(ValueError, match=r"no layer 'relu6_1': choose from relu1_1, relu1_2"):
        PerceptualLoss(["relu6_1"], [1.0])
    with pytest.raises(ValueError, match="2 layers and 1 weights"):
        PerceptualLoss(LAYERS[:2], [1.0])
    loss = load_perceptual(weights)
    with pytest.raises(ValueError, match="8 x 16 pixels are too small for VGG19"):
        loss(torch.rand(16, 8, 3), torch.rand(16, 8, 3))
    with pytest.raises(ValueError, match="give two of the same shape"):
        loss(torch.rand(16, 16, 3), torch.rand(16, 18, 3))
