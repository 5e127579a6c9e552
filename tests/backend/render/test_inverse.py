"""Fitting voxels to pictures: it recovers what pictures show, leaves the rest alone and repeats."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.people.payloads import fitted_payloads, orbit_camera
from primdiffusion.primitives.primitives import Frames, Payload, Primitives
from primdiffusion.render.cpu.march import march_cpu
from primdiffusion.render.descent import LARGEST_CHANGE, DescentSettings, descend, render_view
from primdiffusion.render.image import PosedView
from primdiffusion.render.inverse import (
    InverseSettings,
    fit_colours,
    fit_payload,
)
from support.errors import refused

FULL = 200.0
SIDE = 3
"""Boxes along a side of the sheet that is fitted."""


def sheet_frames(side: int) -> Frames:
    """side x side overlapping boxes in a plane, all facing +z."""
    line = (torch.arange(side) - (side - 1) / 2) * 0.05
    y, x = torch.meshgrid(line, line, indexing="ij")
    position = torch.stack([x.flatten(), y.flatten(), torch.zeros(side**2)], dim=-1)
    return Frames(position, torch.eye(3).expand(side**2, 3, 3).clone(), torch.full((side**2, 3), 0.045))


FRAMES = sheet_frames(SIDE)


def random_payload(seed: int, smooth: bool = False) -> Payload:
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.rand(SIDE**2, 3, 8, 8, 8, generator=generator)
    density = FULL * torch.rand(SIDE**2, 8, 8, 8, generator=generator)
    if smooth:
        rgb, density = torch.full_like(rgb, 0.5), torch.full_like(density, FULL / 2)
    return Payload(rgb, density, torch.ones(SIDE**2, 3))


def cameras(count: int, turn: float = 0.0, size: int = 32) -> list[Camera]:
    return [
        orbit_camera(np.zeros(3), 0.3, 360 * (i + turn) / count, 25 * math.sin(3 * i), math.radians(20), size)
        for i in range(count)
    ]


def pictures(payload: Payload, views: list[Camera]) -> list[PosedView]:
    targets = []
    for camera in views:
        drawn = march_cpu(Primitives.place(FRAMES, payload), camera)
        targets.append(PosedView(FRAMES, camera, torch.cat([drawn.rgb, drawn.alpha[..., None]], -1)))
    return targets


def error(payload: Payload, targets: list[PosedView]) -> float:
    """Mean square error of colours over black and alpha."""
    squares = []
    for target in targets:
        drawn = march_cpu(Primitives.place(target.frames, payload), target.camera)
        squares.append(
            np.square(torch.cat([drawn.rgb, drawn.alpha[..., None]], -1).numpy() - target.rgba.numpy()).mean()
        )
    return float(np.mean(squares))


def test_pictures_that_were_not_shown_come_nearer():
    true, start = random_payload(1), random_payload(1, smooth=True)
    fitted = fit_payload(start, pictures(true, cameras(16)), FULL)
    unseen = pictures(true, cameras(5, turn=0.37))
    assert error(fitted, unseen) < 0.1 * error(start, unseen)


def test_fitted_values_are_bounded():
    fitted = fit_payload(random_payload(2, smooth=True), pictures(random_payload(3), cameras(6)), FULL)
    assert fitted.rgb.min() >= 0
    assert fitted.rgb.max() <= 1
    assert fitted.density.min() >= 0
    assert fitted.density.max() <= FULL
    assert torch.equal(fitted.delta_scale, torch.ones(SIDE**2, 3))


def test_boxes_that_no_picture_shows_stay_as_they_were():
    start = random_payload(4)
    away = dataclasses.replace(FRAMES, position=FRAMES.position + torch.tensor([0.0, 0.0, 50.0]))
    hidden = [dataclasses.replace(target, frames=away) for target in pictures(random_payload(5), cameras(3))]
    fitted = fit_payload(start, hidden, FULL)
    torch.testing.assert_close(fitted.rgb, start.rgb)
    torch.testing.assert_close(fitted.density, start.density)


def test_the_same_pictures_give_the_same_bits():
    start, targets = random_payload(6, smooth=True), pictures(random_payload(7), cameras(6))
    first, second = fit_payload(start, targets, FULL), fit_payload(start, targets, FULL)
    assert torch.equal(first.rgb, second.rgb)
    assert torch.equal(first.density, second.density)


def test_pull_and_smoothness_hold_the_voxels_back():
    start, targets = random_payload(8, smooth=True), pictures(random_payload(9), cameras(8))

    def moved(**settings: float) -> float:
        return float((fit_payload(start, targets, FULL, InverseSettings(**settings)).rgb - start.rgb).norm())

    free = moved(pull=0.0, smoothness=0.0)
    assert moved(pull=10.0, smoothness=0.0) < 0.5 * free
    assert moved(pull=0.0, smoothness=10.0) < 0.8 * free


def test_colours_of_several_are_those_of_each_alone_and_keep_the_density():
    density = random_payload(10)
    truths = [dataclasses.replace(density, rgb=random_payload(seed).rgb) for seed in (11, 12)]
    start = dataclasses.replace(density, rgb=torch.full_like(density.rgb, 0.5))
    targets = [pictures(true, cameras(12)) for true in truths]
    together = fit_colours([start, start], density, targets)
    for fitted, true in zip(together, truths, strict=True):
        assert torch.equal(fitted.density, density.density)
        unseen = pictures(true, cameras(4, turn=0.37))
        assert error(fitted, unseen) < 0.2 * error(start, unseen)
    alone = fit_colours([start], density, targets[1:])[0]
    torch.testing.assert_close(together[1].rgb, alone.rgb, atol=1e-4, rtol=0)


def test_input_that_cannot_be_fitted_is_named():
    start, targets = random_payload(1), pictures(random_payload(1), cameras(1))
    with refused(ValueError, "target"):
        fit_payload(start, [], FULL)
    with refused(ValueError, "finite"):
        dataclasses.replace(targets[0], rgba=targets[0].rgba * np.nan)
    with refused(ValueError, "camera"):
        dataclasses.replace(targets[0], rgba=targets[0].rgba[1:])
    with refused(ValueError, "linear"):
        fit_payload(start, [dataclasses.replace(targets[0], rgba=targets[0].rgba.byte())], FULL)
    with refused(ValueError, "human"):
        fit_payload(start.map(lambda field: field[None]), targets, FULL)
    with refused(ValueError, "cameras"):
        fit_colours([start, start], start, [targets, targets * 2])
    with refused(ValueError, "steps is 0"):
        InverseSettings(steps=0)


def test_a_mesh_without_textures_is_named():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    bare = TexturedPart(
        "body", corners, np.array([[0, 1, 2]], np.int32), np.zeros((1, 3, 2), np.float32),
        np.zeros((0, 0, 4), np.uint8), np.zeros((3, 1), np.int32), np.ones((3, 1)),
    )  # fmt: skip
    with refused(ValueError, "body"):
        fitted_payloads([TexturedMesh((bare,))], FRAMES, np.zeros(10), None)
    with refused(ValueError, "colouring"):
        fitted_payloads([], FRAMES, np.zeros(10), None)


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
    after = errors(views, fitted)
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
    brightness = drawn(views[1], fitted)[middle, middle, :3].float().mean() / views[1].rgba[..., :3].max()
    assert 0.6 < brightness < 0.9  # three quarters of the pixels are grey


def test_the_stronger_a_pull_the_nearer_the_fit_stays_to_its_start():
    wanted, start = smooth_payload(1), smooth_payload(2)
    views, far, wrong = views_of(wanted), [], []
    for pull in (0.0, 0.1, 10.0):
        fitted = descend(start, views, DescentSettings(steps=STEPS, step=0.004, pull=pull))
        far.append(float((encode_srgb(fitted.rgb) - encode_srgb(start.rgb)).square().mean()))
        wrong.append(float(errors(views, fitted).mean()))
    assert far[0] > 1.5 * far[1] > 10 * far[2]
    assert wrong[0] < wrong[1] < wrong[2] < float(errors(views, start).mean())


def test_linear_pictures_are_refused():
    view = views_of(smooth_payload(1), count=1)[0]
    with refused(ValueError, "sRGB"):
        descend(smooth_payload(1), [dataclasses.replace(view, rgba=view.rgba / 255)])


def test_boxes_of_wrong_sizes_find_theirs():
    wanted = smooth_payload(1)
    views = views_of(wanted)
    start = Payload(wanted.rgb, wanted.density, 0.7 * wanted.delta_scale)
    settings = DescentSettings(steps=STEPS, stride=2, step=0.004, colour_rate=0, density_rate=0)
    fitted = descend(start, views, settings)
    assert torch.equal(fitted.rgb, start.rgb)
    assert fitted.delta_scale.mean() == pytest.approx(1, abs=0.1)
    assert errors(views, fitted).mean() < 0.1 * errors(views, start).mean()


def test_sizes_have_a_limit():
    views = views_of(smooth_payload(1))
    start = smooth_payload(2)
    fitted = descend(start, views, DescentSettings(steps=5, scale_rate=50))
    change = (fitted.delta_scale / start.delta_scale).log().abs()
    assert float(change.max()) == pytest.approx(math.log(LARGEST_CHANGE), rel=1e-5)


def test_the_same_seed_draws_the_same_pixels_and_another_seed_others():
    views, start = views_of(smooth_payload(1)), smooth_payload(2)
    once, again, other = (descend(start, views, DescentSettings(steps=3, stride=2, seed=seed)) for seed in (3, 3, 4))
    assert torch.equal(once.rgb, again.rgb)
    assert not torch.equal(once.rgb, other.rgb)
