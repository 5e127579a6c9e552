"""Measures of the chain from mesh to sample: on pictures, payloads and colours whose answers are known."""

import chain
import numpy as np
import pytest
import torch
from figure_metrics import compare_detail, detail_energy, figure_psnr
from primdiffusion.evaluation.metrics import overlap
from primdiffusion.primitives.primitives import K
from scipy import ndimage


def figure(side=64):
    """A noisy square on grey, and its mask."""
    picture = torch.full((side, side, 3), 0.5)
    mask = torch.zeros(side, side, dtype=torch.bool)
    mask[8:-8, 8:-8] = True
    picture[mask] = torch.rand(int(mask.sum()), 3, generator=torch.Generator().manual_seed(0))
    return picture, mask


def blurred(picture, sigma):
    return torch.from_numpy(ndimage.gaussian_filter(picture.numpy(), (sigma, sigma, 0)))


def test_a_blur_takes_detail_energy_away_and_noise_correlation():
    picture, mask = figure()
    soft = compare_detail(blurred(picture, 1.0), mask, picture, mask)
    softer = compare_detail(blurred(picture, 2.0), mask, picture, mask)
    assert softer.energy < soft.energy < 1
    noise = torch.rand(picture.shape, generator=torch.Generator().manual_seed(1))
    unlike = compare_detail(noise, mask, picture, mask)
    assert unlike.energy == pytest.approx(1, abs=0.3)
    assert abs(unlike.correlation) < 0.1


def test_scaling_contrast_scales_detail_energy_by_its_square_and_leaves_the_correlation():
    picture, mask = figure()
    detail = compare_detail(0.5 * picture, mask, picture, mask)
    assert detail == pytest.approx((0.25, 1), rel=1e-5)
    assert detail_energy(0.5 * picture, mask) == pytest.approx(0.25 * detail_energy(picture, mask))


def test_errors_far_from_the_figure_do_not_count_in_its_psnr():
    picture, mask = figure()
    far, near = picture.clone(), picture.clone()
    far[0, 0] += 0.5
    near[7, 30] += 0.5
    assert float(figure_psnr(far, picture, mask)) == float(figure_psnr(picture, picture, mask))
    assert float(figure_psnr(near, picture, mask)) < float(figure_psnr(picture, picture, mask))
    whole = picture + 0.1
    assert float(figure_psnr(whole, picture, mask)) == pytest.approx(20, abs=1e-3)
    with pytest.raises(ValueError):
        figure_psnr(picture, picture, torch.zeros_like(mask))


def test_compare_of_shifted_squares_gives_the_overlap_by_hand():
    true, drawn = torch.zeros(32, 32, 4), torch.zeros(32, 32, 4)
    true[8:24, 8:24] = 1
    drawn[8:24, 12:28] = 1
    measured = chain.compare(drawn, true)
    assert measured["iou"] == pytest.approx(12 / 20)
    assert overlap(true[..., 3] > 0.5, drawn[..., 3] > 0.5) == pytest.approx(12 / 20)


def test_lab_of_known_colours():
    lab = chain.lab_of_linear(np.array([[1.0, 1, 1], [0, 0, 0], [1, 0, 0]]))
    np.testing.assert_allclose(lab, [[100, 0, 0], [0, 0, 0], [53.24, 80.09, 67.20]], atol=0.03)


def test_rest_std_is_measured_region_by_region():
    chart = chain.default_anchors().chart
    rest = torch.ones(2, 5, K)
    rest[..., chart == chain.CHARTS.index("head")] = -3.0
    spread = chain.rest_std(rest.unflatten(-1, (32, 32)))
    assert spread["head"] == pytest.approx(3)
    assert spread["torso"] == pytest.approx(1)
