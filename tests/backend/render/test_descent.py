"""Descent on views of which each step draws some pixels, and the free sizes of boxes."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from march_scenes import sheet_frames
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.people.payloads import orbit_camera
from primdiffusion.primitives.primitives import Payload
from primdiffusion.render.descent import LARGEST_CHANGE, DescentSettings, descend, render_view
from primdiffusion.render.image import PosedView
from support.errors import refused

SIDE = 3
"""Boxes along a side of the sheet that is fitted."""
FRAMES = sheet_frames(SIDE)
STEPS = 60


def smooth_payload(seed: int) -> Payload:
    """Colours that change slowly over each box, dense in the middle."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(SIDE**2, 3, 2, 2, 2, generator=generator)
    rgb = torch.nn.functional.interpolate(coarse, size=(8, 8, 8), mode="trilinear", align_corners=True)
    ramp = torch.linspace(-1, 1, 8).abs()
    depth = torch.maximum(torch.maximum(ramp[:, None, None], ramp[:, None]), ramp)
    return Payload(rgb, (150 * (1 - depth)).expand(SIDE**2, 8, 8, 8).clone(), torch.ones(SIDE**2, 3))


@torch.no_grad()
def views_of(payload: Payload, count: int = 4, size: int = 33) -> list[PosedView]:
    views = []
    for number in range(count):
        camera = orbit_camera(np.zeros(3), 0.3, 40 * number - 60, 20 * math.sin(3 * number), math.radians(30), size)
        blank = PosedView(FRAMES, camera, torch.zeros(size, size, 4, dtype=torch.uint8))
        views.append(dataclasses.replace(blank, rgba=drawn(blank, payload)))
    return views


@torch.no_grad()
def drawn(view: PosedView, payload: Payload) -> torch.Tensor:
    seen = render_view(view, payload, 0.004)
    rgba = torch.cat([encode_srgb(seen.rgb.clamp(0, 1)), seen.alpha[..., None]], -1)
    return (255 * rgba).round().to(torch.uint8)


def errors(views: list[PosedView], payload: Payload) -> torch.Tensor:
    """Mean square error of each pixel over the views, sRGB-encoded in 0 ... 1."""
    pairs = [(drawn(view, payload).float() / 255, view.rgba.float() / 255) for view in views]
    return torch.stack([(one - other)[..., :3].square().mean(-1) for one, other in pairs]).mean(0)


def test_steps_on_a_quarter_of_the_pixels_fit_all_of_them():
    wanted, start = smooth_payload(1), smooth_payload(2)
    views = views_of(wanted)
    before = errors(views, start)
    fitted = descend(start, views, DescentSettings(steps=STEPS, stride=2, step=0.004))
    after = errors(views, fitted.payload)
    assert fitted.steps == STEPS
    for row in range(2):
        for column in range(2):
            assert after[row::2, column::2].mean() < 0.1 * before[row::2, column::2].mean()


def test_no_pixel_is_left_out():
    grey = smooth_payload(1)
    grey = Payload(torch.full_like(grey.rgb, 0.5), grey.density, grey.delta_scale)
    views = views_of(grey)
    for view in views:
        view.rgba[::2, ::2, :3] = 0
    fitted = descend(grey, views, DescentSettings(steps=STEPS, stride=2, step=0.004, density_rate=0, scale_rate=0))
    middle = slice(12, 21)
    brightness = drawn(views[1], fitted.payload)[middle, middle, :3].float().mean() / views[1].rgba[..., :3].max()
    assert 0.6 < brightness < 0.9  # three quarters of the pixels are grey


def test_linear_pictures_are_refused():
    view = views_of(smooth_payload(1), count=1)[0]
    with refused(ValueError, "sRGB"):
        descend(smooth_payload(1), [dataclasses.replace(view, rgba=view.rgba / 255)])


def test_boxes_of_wrong_sizes_find_theirs():
    wanted = smooth_payload(1)
    views = views_of(wanted)
    start = Payload(wanted.rgb, wanted.density, 0.7 * wanted.delta_scale)
    settings = DescentSettings(steps=STEPS, stride=2, step=0.004, colour_rate=0, density_rate=0)
    fitted = descend(start, views, settings).payload
    assert torch.equal(fitted.rgb, start.rgb)
    assert fitted.delta_scale.mean() == pytest.approx(1, abs=0.1)
    assert errors(views, fitted).mean() < 0.1 * errors(views, start).mean()


def test_sizes_have_a_limit():
    views = views_of(smooth_payload(1))
    start = smooth_payload(2)
    fitted = descend(start, views, DescentSettings(steps=5, scale_rate=50)).payload
    change = (fitted.delta_scale / start.delta_scale).log().abs()
    assert float(change.max()) == pytest.approx(math.log(LARGEST_CHANGE), rel=1e-5)


def test_the_same_seed_draws_the_same_pixels_and_another_seed_others():
    views, start = views_of(smooth_payload(1)), smooth_payload(2)
    once, again, other = (
        descend(start, views, DescentSettings(steps=3, stride=2, seed=seed)).payload for seed in (3, 3, 4)
    )
    assert torch.equal(once.rgb, again.rgb)
    assert not torch.equal(once.rgb, other.rgb)
