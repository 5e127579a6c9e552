"""Additive, clamped compositing by hand (SPEC 4)."""

import math

import torch
from primdiffusion.render.image import composite

OPACITY = torch.tensor([0.2, 0.0, 0.5, 0.6, 0.9], dtype=torch.float64)
RGB = torch.eye(3, dtype=torch.float64)[[0, 1, 1, 2, 0]]
DISTANCE = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0], dtype=torch.float64)


def test_the_saturating_sample_counts_with_what_was_missing_and_later_ones_not_at_all():
    got = composite(OPACITY, OPACITY[:, None] * RGB, DISTANCE)
    torch.testing.assert_close(got.rgb, torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64))
    assert got.alpha == 1
    torch.testing.assert_close(got.depth.item(), 0.2 * 1 + 0.5 * 3 + 0.3 * 4)
    assert got.first_hit == 3


def test_a_ray_that_meets_nothing_is_black_and_infinitely_far():
    for samples in (0, 3):
        got = composite(torch.zeros(2, samples), torch.zeros(2, samples, 3), torch.rand(2, samples))
        assert got.rgb.abs().max() == 0
        assert got.alpha.tolist() == [0, 0]
        assert got.depth.tolist() == got.first_hit.tolist() == [math.inf, math.inf]


def test_a_thin_ray_has_a_depth_but_no_first_hit():
    got = composite(OPACITY[:1], OPACITY[:1, None] * RGB[:1], DISTANCE[:1])
    assert got.depth == 1
    assert got.first_hit == math.inf


def test_gradients_follow_the_formulas_of_the_specification():
    """Before saturation dL/da = <c - c_sat, g>; none at the saturating sample, whose part is fixed, or after it."""
    opacity, rgb = OPACITY.clone().requires_grad_(), RGB.clone().requires_grad_()
    g = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)
    (composite(opacity, opacity[:, None] * rgb, DISTANCE).rgb @ g).backward()
    saturated = 0.3 / 0.6
    torch.testing.assert_close(opacity.grad[[0, 2]], (RGB[[0, 2]] - RGB[3]) @ g)
    assert opacity.grad[3:].abs().max() == 0
    torch.testing.assert_close(rgb.grad[3], saturated * 0.6 * g)
    assert rgb.grad[4].abs().max() == 0


def test_rays_that_stay_thin_pass_the_gradient_of_colour_and_opacity():
    opacity = (OPACITY / 10).requires_grad_()
    got = composite(opacity, opacity[:, None] * RGB, DISTANCE)
    g = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)
    (got.rgb @ g + 2 * got.alpha).backward()
    torch.testing.assert_close(opacity.grad, RGB @ g + 2)


def test_an_empty_sample_has_the_gradient_of_one_that_is_barely_there():
    """Otherwise empty space could gain opacity, but never colour."""
    thin, empty = (OPACITY / 10).clone(), (OPACITY / 10).clone()
    thin[1], empty[1] = 1e-9, 0.0
    g = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)
    gradients = []
    for values in (thin, empty):
        opacity = values.requires_grad_()
        got = composite(opacity, opacity[:, None] * RGB, DISTANCE)
        (got.rgb @ g + 2 * got.alpha + got.depth).backward()
        gradients.append(opacity.grad)
    torch.testing.assert_close(gradients[0], gradients[1], atol=1e-7, rtol=0)
