"""Terms of stage 1's objective against numbers worked out by hand (SPEC 2), the perceptual one on random weights."""

import math

import pytest
import torch
from primdiffusion.evaluation.pretrained_networks import VGG16, VGG19, PictureFeatures
from primdiffusion.files.regular_files import FileError
from primdiffusion.training.fit_config import LossConfig
from primdiffusion.training.fit_losses import (
    alpha_prior,
    load_perceptual,
    loss_terms,
    rgb_loss,
    silhouette_loss,
    volume_loss,
)
from support.errors import refused

WEIGHTS = LossConfig(rgb=1.0, silhouette=0.01, volume=0.001, alpha_prior=1.0)
"""The released code's, but for the perceptual loss."""


def pictures(colour: float, people: int = 1) -> torch.Tensor:
    return torch.full((people, 2, 4, 4, 3), colour)


def test_a_residual_of_16_grey_levels_costs_one():
    assert float(rgb_loss(pictures(100 / 255), pictures(116 / 255))) == pytest.approx(1.0)
    assert float(rgb_loss(pictures(0.0), pictures(1.0))) == pytest.approx((255 / 16) ** 2)


def test_the_silhouette_costs_the_mean_difference():
    alpha, mask = torch.tensor([[0.0, 0.25], [1.0, 1.0]]), torch.tensor([[0.0, 1.0], [1.0, 0.5]])
    assert float(silhouette_loss(alpha, mask)) == pytest.approx((0.75 + 0.5) / 4)


def test_volumes_count_in_cubic_decimetres_summed_over_boxes_and_averaged_over_people():
    half = torch.full((2, 1024, 3), 0.1)  # 0.1 m = 1 dm
    assert float(volume_loss(half)) == pytest.approx(1024)
    half[0] = torch.tensor([0.01, 0.02, 0.05])  # .1 * .2 * .5 = .01 dm^3
    assert float(volume_loss(half)) == pytest.approx((10.24 + 1024) / 2)


def test_volume_is_the_released_codes_product_of_100_by_reciprocal_scales():
    # SPEC 2: a box 15 mm from its neighbours has the scale 15000 / 15 and, SPEC 1, half extents of 2/3 of that
    half = torch.full((1, 1, 3), 2 / 3 * 0.015)
    assert float(volume_loss(half)) == pytest.approx((100 / (15000 / 15)) ** 3, rel=1e-5)


def test_the_alpha_prior_is_zero_at_nothing_and_at_all_and_largest_between():
    at = {alpha: float(alpha_prior(torch.tensor([[alpha]]))) for alpha in (0.0, 0.25, 0.5, 0.75, 1.0)}
    assert at[0.0] == pytest.approx(0.0, abs=1e-5)
    assert at[1.0] == pytest.approx(0.0, abs=1e-5)
    assert at[0.5] == pytest.approx(2 * math.log(0.6) + 2.20727, abs=1e-6)
    assert at[0.5] > at[0.25] == pytest.approx(at[0.75], abs=1e-6)


def terms(weights: LossConfig, **more) -> dict[str, torch.Tensor]:
    alpha, mask, half = torch.full((1, 2, 4, 4), 0.5), torch.ones(1, 2, 4, 4), torch.full((1, 4, 3), 0.1)
    return loss_terms(pictures(0.0), alpha, half, pictures(16 / 255), mask, weights, **more)


def test_terms_are_weighted_as_in_the_released_code():
    found = {name: float(value) for name, value in terms(WEIGHTS).items()}
    prior = 2 * math.log(0.6) + 2.20727
    assert found == pytest.approx({"rgb": 1.0, "silhouette": 0.005, "volume": 0.004, "alpha_prior": prior}, rel=1e-5)


def test_a_weight_of_zero_leaves_a_term_out():
    assert terms(LossConfig(silhouette=0.0, volume=0.0)).keys() == {"rgb"}


def test_the_perceptual_term_is_its_function_times_its_weight_and_needs_it(tmp_path):
    weights = LossConfig(perceptual=3.0, perceptual_weights=tmp_path)
    found = terms(weights, perceptual=lambda image, target: (target - image).mean())
    assert float(found["perceptual"]) == pytest.approx(3 * 16 / 255)
    with refused(ValueError, "load_perceptual"):
        terms(weights)


def test_all_terms_teach():
    image = pictures(0.4).requires_grad_()
    alpha, half = torch.full((1, 2, 4, 4), 0.5, requires_grad=True), torch.full((1, 4, 3), 0.1, requires_grad=True)
    found = loss_terms(image, alpha, half, pictures(0.5), torch.ones(1, 2, 4, 4), WEIGHTS)
    torch.stack(list(found.values())).sum().backward()
    assert (image.grad < 0).all()  # too dark
    assert (alpha.grad < 0).all()  # too thin
    assert (half.grad > 0).all()  # smaller is cheaper


@pytest.fixture(scope="module")
def vgg_file(tmp_path_factory):
    """A file as torchvision's: the whole network's features and a classifier."""
    torch.manual_seed(0)
    state = PictureFeatures(VGG19, ["relu5_4"]).state_dict()
    path = tmp_path_factory.mktemp("vgg") / "vgg19.pth"
    torch.save(state | {"classifier.0.weight": torch.zeros(3, 3)}, path)
    return path


def test_loss_is_the_weighted_mean_difference_of_features(vgg_file):
    loss = load_perceptual(vgg_file)
    image, target = torch.rand(2, 1, 16, 20, 3, generator=torch.Generator().manual_seed(1))
    state = torch.load(vgg_file, weights_only=True)
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


def test_gradients_reach_the_picture_and_no_weights(vgg_file):
    loss = load_perceptual(vgg_file)
    image = torch.rand(2, 16, 16, 3, requires_grad=True)
    target = torch.rand(2, 16, 16, 3, requires_grad=True)
    loss(image, target).backward()
    assert (image.grad.abs().amax((1, 2, 3)) > 0).all()
    assert target.grad is None
    assert not any(parameter.requires_grad for parameter in loss.parameters())


def test_a_file_of_another_network_is_rejected(tmp_path):
    torch.save(PictureFeatures(VGG16, ["relu5_3"]).state_dict(), tmp_path / "vgg16.pth")
    with refused(FileError, "vgg16.pth", "VGG19"):
        load_perceptual(tmp_path / "vgg16.pth")


def test_weights_that_are_not_finite_are_rejected(vgg_file, tmp_path):
    state = torch.load(vgg_file, weights_only=True)
    state["features.0.bias"][0] = torch.nan
    torch.save(state, tmp_path / "nan.pth")
    with refused(FileError, "features.0.bias", "NaN"):
        load_perceptual(tmp_path / "nan.pth")


def test_wrong_requests_say_what_to_give(vgg_file, tmp_path):
    with refused(FileNotFoundError, "path"):
        load_perceptual(tmp_path / "none.pth")
    loss = load_perceptual(vgg_file)
    with refused(ValueError, "8 x 16 pixels", "VGG19"):
        loss(torch.rand(16, 8, 3), torch.rand(16, 8, 3))
    with refused(ValueError, "shape"):
        loss(torch.rand(16, 16, 3), torch.rand(16, 18, 3))
