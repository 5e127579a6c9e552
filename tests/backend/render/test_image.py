"""sRGB and picture files."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.render.image import Rendering, composite, depth_to_png
from support.errors import refused

KNOWN = {0.0: 0.0, 0.0031308: 0.04044994, 0.2140411: 0.5, 0.5: 0.7353570, 1.0: 1.0}


def rendering(rgb: tuple[float, ...], alpha: float, depth: float = 1.0) -> Rendering:
    """A 1 x 2 picture: the given pixel, then nothing."""
    return Rendering(
        rgb=torch.tensor([[rgb, (0.0, 0.0, 0.0)]]),
        alpha=torch.tensor([[alpha, 0.0]]),
        depth=torch.tensor([[depth, math.inf]]),
        first_hit=torch.tensor([[depth, math.inf]]),
    )


def pixels(path) -> np.ndarray:
    return np.asarray(Image.open(path))


@pytest.mark.parametrize("convert", [np.asarray, torch.tensor])
def test_encoding_gives_the_standards_values_and_decoding_takes_them_back(convert):
    linear, encoded = convert(list(KNOWN)), convert(list(KNOWN.values()))
    np.testing.assert_allclose(np.asarray(encode_srgb(linear)), np.asarray(encoded), atol=1e-6)
    every = convert(np.linspace(0, 1, 1001).tolist())
    assert type(encode_srgb(every)) is type(every)
    np.testing.assert_allclose(np.asarray(decode_srgb(encode_srgb(every))), np.asarray(every), atol=2e-7)


def test_conversion_keeps_the_dtype():
    for dtype in (np.float32, np.float64):
        assert decode_srgb(encode_srgb(np.ones(3, dtype))).dtype == dtype
    assert encode_srgb(torch.ones(3)).dtype == torch.float32


def test_gradients_are_finite_at_black():
    for convert in (encode_srgb, decode_srgb):
        linear = torch.tensor([0.0, -0.1, 1e-9, 0.5], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(convert, linear)


def test_a_saved_rendering_holds_straight_colour_and_alpha(tmp_path):
    """Half covered by linear 0.8 red: premultiplied 0.4; the file must say 0.8 encoded, and alpha 128."""
    rendering((0.4, 0.0, 0.1), 0.5).save(tmp_path / "a.png")
    got = pixels(tmp_path / "a.png")
    assert got.shape == (1, 2, 4)
    assert got[0, 0].tolist() == [round(255 * 0.9063317), 0, round(255 * 0.4845292), 128]
    assert got[0, 1].tolist() == [0, 0, 0, 0]


def test_over_a_background_colours_mix_in_linear_light(tmp_path):
    rendering((0.25, 0.0, 0.0), 0.5).save(tmp_path / "a.png", background=(0.5, 1.0, 0.0))
    assert pixels(tmp_path / "a.png")[0].tolist() == [[188, 188, 0], [188, 255, 0]]


def test_a_name_of_another_format_is_refused_and_nothing_written(tmp_path):
    with refused(ValueError, "a.jpg does not end in .png"):
        rendering((0.25, 0.0, 0.0), 0.5).save(tmp_path / "a.jpg")
    assert not list(tmp_path.iterdir())


def test_written_pictures_can_be_read_by_others(tmp_path):
    """Temporary files are private by default; the finished picture must have the usual permissions."""
    rendering((0.25, 0.0, 0.0), 0.5).save(tmp_path / "a.png")
    (tmp_path / "b").touch()
    assert (tmp_path / "a.png").stat().st_mode == (tmp_path / "b").stat().st_mode


def test_depth_is_brighter_where_nearer_and_black_where_empty(tmp_path):
    alpha = torch.tensor([[1.0, 1.0, 1.0, 0.0]])
    depth = torch.tensor([[1.0, 2.0, 3.0, math.inf]])
    depth_to_png(tmp_path / "d.png", depth, alpha)
    near, middle, far, nothing = pixels(tmp_path / "d.png")[0].astype(int).sum(-1)
    assert near > middle > far > nothing == 0
    depth_to_png(tmp_path / "d.png", torch.full((1, 4), math.inf), 0 * alpha)
    assert pixels(tmp_path / "d.png").max() == 0


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
