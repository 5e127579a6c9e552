"""Terms of stage 1's objective against numbers worked out by hand (SPEC 2)."""

import math

import pytest
import torch
from primdiffusion.training.fit_config import LossConfig
from primdiffusion.training.fit_losses import alpha_prior, loss_terms, rgb_loss, silhouette_loss, volume_loss

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
    with pytest.raises(ValueError, match="load_perceptual"):
        terms(weights)


def test_all_terms_teach():
    image = pictures(0.4).requires_grad_()
    alpha, half = torch.full((1, 2, 4, 4), 0.5, requires_grad=True), torch.full((1, 4, 3), 0.1, requires_grad=True)
    found = loss_terms(image, alpha, half, pictures(0.5), torch.ones(1, 2, 4, 4), WEIGHTS)
    torch.stack(list(found.values())).sum().backward()
    assert (image.grad < 0).all()  # too dark
    assert (alpha.grad < 0).all()  # too thin
    assert (half.grad > 0).all()  # smaller is cheaper
