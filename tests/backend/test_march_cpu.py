"""The fast marcher against the readable one in float64, over the scenes that break marchers."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from march_scenes import camera_at, one_box, random_boxes
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu import march_cpu
from primdiffusion.render.lattice import UNIFORM_MILLIMETRE, MarchSettings
from primdiffusion.render.march import march
from primdiffusion.render.reference import march_reference

FACE_STEP = 3.4e-4
"""The window's value at a face, by which a sample that rounding moves in or out of a box changes."""


def assert_agree(boxes: Primitives, camera: Camera, settings: MarchSettings = MarchSettings()) -> None:  # noqa: B008
    """All fields within 2e-5 plus one flipped face sample of the densest box, on average within 2e-6."""
    got = march_cpu(boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32), settings)
    expected = march_reference(boxes.to(dtype=torch.float32).to(dtype=torch.float64), camera, settings)
    densest = float(boxes.density.max()) if boxes.density.numel() else 0.0
    largest = 2e-5 + FACE_STEP * min(densest * settings.step, 1)
    for name in ("rgb", "alpha"):
        difference = (getattr(got, name).double() - getattr(expected, name)).abs()
        assert difference.max() < largest, name
        assert difference.mean() < 2e-6, name
    clear = expected.alpha > 1e-2
    assert torch.equal(torch.isinf(got.depth)[clear], torch.isinf(expected.depth)[clear])
    assert ((got.depth - expected.depth)[clear].abs() <= largest / expected.alpha[clear]).all()
    near_half = 2 * largest
    decided = (got.alpha - 0.5).abs() > near_half
    both = decided & torch.isfinite(expected.first_hit)
    assert torch.equal(torch.isinf(got.first_hit)[decided], torch.isinf(expected.first_hit)[decided])
    # A sum that stands at 0.5 to rounding may reach it one sample later.
    late = (got.first_hit - expected.first_hit)[both].abs() > 1e-6
    assert late.float().mean() < 0.01 if both.any() else True


@pytest.mark.parametrize("seed", range(6))
def test_agrees_on_overlapping_boxes_from_thin_to_saturating(seed):
    boxes = random_boxes(40, seed, density=10.0 * 3**seed)
    assert_agree(boxes, camera_at((0.2, 0.1, 0.6), fov=0.6, width=50, height=37))


@pytest.mark.parametrize("settings", [UNIFORM_MILLIMETRE, MarchSettings(0.006, (3, 1)), MarchSettings(0.05, (8, 4, 2))])
def test_agrees_at_other_settings(settings):
    assert_agree(random_boxes(20, 11, density=60.0), camera_at((0.2, 0.1, 0.6), fov=0.6), settings)


def test_agrees_with_the_camera_inside_boxes_and_boxes_across_its_plane():
    boxes = random_boxes(12, 12, density=15.0, smallest=0.05, largest=0.15)
    for position in ((0.01, 0.0, 0.02), (0.0, 0.1, 0.1), (0.15, 0.0, 0.0)):
        assert_agree(boxes, camera_at(position, fov=1.8, width=25, height=19))


def test_agrees_on_pictures_one_pixel_wide_or_high():
    boxes = random_boxes(30, 13)
    for width, height in ((1, 1), (1, 40), (40, 1), (17, 16), (16, 17)):
        assert_agree(boxes, camera_at((0.0, 0.1, 0.5), width=width, height=height))


def test_agrees_on_rays_along_the_faces_of_boxes():
    """Axis-parallel boxes seen along their axes, with faces in the pixel centres' planes: nothing may turn NaN."""
    row = torch.linspace(-0.2, 0.2, 9, dtype=torch.float64)
    boxes = Primitives(*(tensor.expand(9, *tensor.shape[1:]).clone() for tensor in vars(one_box(0.025, 30.0)).values()))
    boxes.position[:, 0] = row
    camera = camera_at((0.0, 0.0, 0.5), width=9, height=9)
    for shift in (0.0, 0.025):
        moved = dataclasses.replace(boxes, position=boxes.position + torch.tensor([shift, 0.0, 0.0]).double())
        got = march_cpu(moved.to(dtype=torch.float32), camera.to(dtype=torch.float32))
        assert torch.isfinite(got.rgb).all()
        assert_agree(dataclasses.replace(moved, position=moved.position + 1e-4), camera)


def test_agrees_on_far_needles_and_plates():
    boxes = random_boxes(30, 14, density=200.0)
    boxes.half_extent[::2, 0] = 0.3
    boxes.half_extent[::3, 2] = 0.002
    assert_agree(boxes, camera_at((2.0, 3.0, 5.0), fov=0.1, width=40, height=30))


def test_nothing_gives_an_empty_picture():
    camera = camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    nobody = random_boxes(3).to(dtype=torch.float32).map(lambda tensor: tensor[:0])
    away = dataclasses.replace(random_boxes(3).to(dtype=torch.float32), position=torch.full((3, 3), 5.0))
    for boxes in (nobody, away):
        for render in (march_cpu, march_reference):
            got = render(boxes, camera)
            assert got.rgb.shape == (20, 24, 3)
            assert got.alpha.max() == 0
            assert torch.isinf(got.depth).all()
            assert torch.isinf(got.first_hit).all()


def test_boxes_without_extent_draw_nothing_and_disturb_nothing():
    boxes, camera = random_boxes(8, 15).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    flat = boxes.map(torch.clone)
    flat.half_extent[[1, 5]] = torch.tensor([[0.0, 0.1, 0.1], [0.0, 0.0, 0.0]])
    kept = boxes.map(lambda tensor: tensor[[0, 2, 3, 4, 6, 7]])
    for render in (march_cpu, march_reference):
        assert torch.equal(render(flat, camera).rgb, render(kept, camera).rgb)


@pytest.mark.parametrize("render", [march_cpu, march_reference, march])
@pytest.mark.parametrize("name", ["position", "rotation", "half_extent", "rgb", "density"])
def test_nan_is_refused_by_name(render, name):
    boxes, camera = random_boxes(2).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    getattr(boxes, name).view(-1)[-1] = torch.nan
    with pytest.raises(ValueError, match=rf"primitives\.{name} holds NaN"):
        render(boxes, camera)


def test_negative_density_broken_shapes_and_cameras_are_refused():
    boxes, camera = random_boxes(2).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    with pytest.raises(ValueError, match="density falls to -1"):
        march(dataclasses.replace(boxes, density=boxes.density * 0 - 1), camera)
    with pytest.raises(ValueError, match="give a batch to `march`"):
        march_cpu(boxes.map(lambda tensor: tensor[None]), camera)
    with pytest.raises(ValueError, match=r"camera\.intrinsics"):
        march(boxes, dataclasses.replace(camera, intrinsics=camera.intrinsics * torch.nan))
    with pytest.raises(ValueError, match="0 x 20 pixels"):
        march(boxes, dataclasses.replace(camera, width=0))
    with pytest.raises(ValueError, match="strides"):
        MarchSettings(strides=(4, 3))


def test_the_fast_marcher_repeats_itself_bit_for_bit():
    boxes, camera = random_boxes(40, 17).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5), width=64, height=64)
    first, second = (march_cpu(boxes, camera.to(dtype=torch.float32)) for _ in range(2))
    assert torch.equal(first.rgb, second.rgb)


def test_march_takes_the_reference_where_gradients_or_float64_are_asked_for():
    boxes, camera = random_boxes(4, 18), camera_at((0.0, 0.0, 0.5))
    assert march(boxes, camera).rgb.dtype == torch.float64
    single, view = boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32)
    assert torch.equal(march(single, view).rgb, march_cpu(single, view).rgb)
    leaf = dataclasses.replace(single, density=single.density.clone().requires_grad_())
    assert march(leaf, view).rgb.requires_grad
    with torch.no_grad():
        assert torch.equal(march(leaf, view).rgb, march_cpu(single, view).rgb)


def test_threads_may_march_at_the_same_time():
    boxes, camera = random_boxes(40, 19).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    alone = march_cpu(boxes, camera).rgb
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda _: march_cpu(boxes, camera).rgb, range(8)))
    assert all(torch.equal(rgb, alone) for rgb in together)
